"""Connection of a process to a Ray cluster that runs, or to one that it starts on this machine."""

from __future__ import annotations

import os
import socket

import ray

from kissgs.core.errors import RunnerError

CONNECT_SECONDS = 5.0
"""Maximum seconds for a connection to the head's port."""

OBJECT_STORE_BYTES = 80 << 20
"""Size of the object store of a cluster that is started here: nearly the smallest; nothing is kept there."""


class NoCluster(Exception):
    """The address is "auto", and there is no cluster on this machine."""


def connect(address: str) -> None:
    """Connect this process to a cluster."""
    given = address if address != "auto" else os.environ.get("RAY_ADDRESS", "")
    if "://" in given:
        raise RunnerError(
            f"{given} is an address for Ray's client; give HOST:PORT of the cluster's head, on a machine of the cluster"
        )
    if given:
        _check_port(given)
    try:
        ray.init(address=given or "auto", log_to_driver=False, configure_logging=False)
    except ConnectionError as error:
        if given:
            raise RunnerError(_refused(given, error)) from error
        raise NoCluster from error
    except Exception as error:  # among them RuntimeError for another version of Ray or Python
        raise RunnerError(_refused(given or "of this machine", error)) from error


def start_here(folder: str) -> None:
    """Start a cluster on this machine, with its files in ``folder``, which ends with this process."""
    try:
        ray.init(
            address="local",
            include_dashboard=False,
            object_store_memory=OBJECT_STORE_BYTES,
            log_to_driver=False,
            configure_logging=False,
            _temp_dir=folder,
        )
    except Exception as error:
        raise RunnerError(f"Ray cannot be started on this machine: {first_line(error)}") from error


def _check_port(address: str) -> None:
    host, colon, port = address.rpartition(":")
    if not colon or not port.isdecimal():
        raise RunnerError(f"{address} is no address of a Ray cluster; give HOST:PORT of its head, usually port 6379")
    try:
        socket.create_connection((host.strip("[]"), int(port)), CONNECT_SECONDS).close()
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise RunnerError(f"no Ray cluster answers at {address}: {reason}; is its head running there?") from error


def _refused(address: str, error: Exception) -> str:
    return (
        f"cannot join the Ray cluster {address}: {first_line(error)}; this machine must be one of its nodes "
        f"(ray start --address={address} --num-cpus=0), and have its token if it has one (RAY_AUTH_MODE=token)"
    )


def first_line(error: BaseException) -> str:
    """Return the first line of an error's message, for the middle of a sentence."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0].rstrip(".")[:300]
