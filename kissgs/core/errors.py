"""Errors raised by kissgs; this tree contains every error that a user's input can cause.

KissgsError
├─ InvalidSceneError        a scene file, or the given arrays, are not a usable Gaussian scene
├─ InvalidContainerError    the bytes are not a valid SOG-XT or SOG container
├─ InvalidViewsError        cameras or photographs that cannot be used: COLMAP, transforms.json, images
├─ UnsupportedError         valid input beyond a limit or a feature that kissgs does not have
├─ RemoteError              a kissgs service cannot be reached, or refuses the request
├─ RunnerError              a cluster cannot be reached, or work on it, or in another process, was lost
├─ OutputError              the result could not be written: it exists already, no space, no permission
└─ Cancelled                the caller stopped the work through its progress callback
   └─ StopSearch            the caller ended the search for a goal and accepts the best result so far

The message is one sentence for the user: the problem, its place and the remedy.
``code`` is stable: the command line's ``--json`` output and the service use it.
Any other exception that leaves kissgs is a bug.
"""


class KissgsError(Exception):
    """Base class of all errors above."""

    code = "kissgs-error"


class InvalidSceneError(KissgsError):
    """A scene file, or the given arrays, are not a usable Gaussian scene."""

    code = "invalid-scene"


class InvalidContainerError(KissgsError):
    """The bytes are not a valid SOG-XT or SOG container."""

    code = "invalid-container"


class InvalidViewsError(KissgsError):
    """Cameras or photographs that cannot be used."""

    code = "invalid-views"


class UnsupportedError(KissgsError):
    """Valid input beyond a limit, or a feature that kissgs does not have."""

    code = "unsupported"


class RemoteError(KissgsError):
    """A kissgs service cannot be reached, or refuses the request.

    Attributes:
        retry_after: seconds after which a retry may succeed; None if it cannot succeed or the time is unknown.
        unreachable: whether there was no answer at all.
        problem: code of the service's problem document; empty if it sent none.
    """

    code = "remote"
    retry_after: float | None = None
    unreachable: bool = False
    problem: str = ""


class RunnerError(KissgsError):
    """A cluster cannot be reached, or work on it or in another process was lost or crashed."""

    code = "runner"


class OutputError(KissgsError):
    """The result could not be written."""

    code = "output"


class Cancelled(KissgsError):
    """The caller stopped the work; no output was written."""

    code = "cancelled"


class StopSearch(Cancelled):
    """Raised by a progress callback to end a search for a goal with the best result so far.

    The work is cancelled if no result meets the goal yet or if there is no search, and completed if the search is over.
    """

    code = "enough"
