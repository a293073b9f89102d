"""Errors raised by kissgs. Every error that a user's input can cause is in this tree.

KissgsError
├─ InvalidSceneError        a scene file, or the arrays handed in, are not a usable Gaussian scene
├─ InvalidContainerError    the bytes are not a valid SOG-XT container
├─ InvalidViewsError        cameras or photographs that cannot be used: COLMAP, transforms.json, images
├─ UnsupportedError         valid input beyond a limit or a feature that kissgs does not have
├─ RemoteError              a kissgs service cannot be reached, or refuses what it was asked
├─ OutputError              the result could not be written: it exists already, no space, no permission
└─ Cancelled                the caller stopped the work through its progress callback
   └─ StopSearch            its search for a goal: what was found so far will do

The message is one sentence for the user: what is wrong, where, and how to mend it.
``code`` is stable: the command line's ``--json`` output and the service use it.
Any other exception that leaves kissgs is a bug.
"""


class KissgsError(Exception):
    """Base class of all errors above."""

    code = "kissgs-error"


class InvalidSceneError(KissgsError):
    """A scene file, or the arrays handed in, are not a usable Gaussian scene."""

    code = "invalid-scene"


class InvalidContainerError(KissgsError):
    """The bytes are not a valid SOG-XT container."""

    code = "invalid-container"


class InvalidViewsError(KissgsError):
    """Cameras or photographs that cannot be used."""

    code = "invalid-views"


class UnsupportedError(KissgsError):
    """Valid input beyond a limit, or a feature that kissgs does not have."""

    code = "unsupported"


class RemoteError(KissgsError):
    """A kissgs service cannot be reached, or refuses what it was asked.

    Attributes:
        retry_after: seconds after which the same may succeed; None if it never will, or nobody knows.
        unreachable: whether nobody has answered at all.
    """

    code = "remote"
    retry_after: float | None = None
    unreachable: bool = False


class OutputError(KissgsError):
    """The result could not be written."""

    code = "output"


class Cancelled(KissgsError):
    """The caller stopped the work; nothing was written."""

    code = "cancelled"


class StopSearch(Cancelled):
    """Raised from a progress callback: a search for a goal ends with the best that it has found.

    Where nothing that meets the goal has been found yet, or nothing is searched for, the work is cancelled; where the
    search is over already, it is finished.
    """

    code = "enough"
