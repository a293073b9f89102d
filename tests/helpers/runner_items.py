"""Functions of work items for the tests of the runners; their processes import this module by name."""

import hashlib
import os
import signal
import time
from pathlib import Path

import kissgs


def count(arguments, progress):
    """Report the numbers below ``numbers`` as stages, and write the process's id to the file ``pid`` if given."""
    if "pid" in arguments:
        Path(arguments["pid"]).write_text(str(os.getpid()))
    for number in range(arguments["numbers"]):
        progress(f"stage {number}", number / arguments["numbers"], f"note {number}")
        time.sleep(arguments.get("seconds_between", 0.0))
    return {"numbers": arguments["numbers"], "folder": str(Path.cwd())}


def record(arguments, progress):
    """Write the times of start and end to a file of this process in the folder ``times``."""
    start = time.monotonic()
    time.sleep(arguments["seconds_between"])
    path = Path(arguments["times"]) / str(os.getpid())
    path.with_suffix(".part").write_text(f"{start} {time.monotonic()}")
    path.with_suffix(".part").rename(path)
    return {}


def leave_a_file(arguments, progress):
    """Write a file to the current folder, report it, and wait for ``seconds_between`` if given."""
    Path("file").write_text(arguments["text"])
    progress("written", 1.0, "")
    time.sleep(arguments.get("seconds_between", 0.0))
    return {"folder": str(Path.cwd())}


def refuse(arguments, progress):
    raise kissgs.InvalidSceneError("this is no scene")


def fail(arguments, progress):
    raise LookupError("a bug")


def crash(arguments, progress):
    os.kill(os.getpid(), signal.SIGSEGV)


def allocate(arguments, progress):
    return {"bytes": len(bytearray(arguments["bytes"]))}


def fail_with(arguments, progress):
    ballast = bytearray(arguments["bytes"])
    raise RuntimeError(arguments["message"], len(ballast))


def load_kernels(arguments, progress):
    """Load a kernel, and what numba loads for the first one, when only so many bytes are left."""
    import resource

    from kissgs.core.numba_kernels import kernels
    from kissgs.rendering.cpu import sensitivity

    assert sensitivity
    used = int(Path("/proc/self/statm").read_text().split()[5]) * resource.getpagesize()
    ballast = bytearray(resource.getrlimit(resource.RLIMIT_DATA)[0] - used - arguments["left"])
    kernels[0].load()
    return {"ballast": len(ballast)}


def write_slowly(arguments, progress):
    """Add a line to the file ``starts``, then wait, in the first start for long, and write ``output`` atomically."""
    from kissgs.io.files import atomic_file

    with Path(arguments["starts"]).open("a") as file:
        file.write(f"{os.getpid()}\n")
    first = len(Path(arguments["starts"]).read_text().splitlines()) == 1
    progress("wait", 0.0, "first" if first else "again")
    time.sleep(600 if first else 0.1)
    with atomic_file(Path(arguments["output"])) as file:
        file.write(arguments["text"].encode())
    return {"bytes": len(arguments["text"])}


def variables(arguments, progress):
    """Return the variables of the environment."""
    return {"environment": dict(os.environ)}


def digest(arguments, progress):
    """Write a checkpoint, report progress, in the first start for long, and write the SHA-256 of ``scene``."""
    with Path(arguments["starts"]).open("a") as file:
        file.write("start\n")
    first = len(Path(arguments["starts"]).read_text().splitlines()) == 1
    Path(".checkpoint.part").write_text("a checkpoint")
    Path(".checkpoint.part").rename("checkpoint")
    Path("made").mkdir()
    Path("made/half").write_text("not complete")
    for step in range(6000 if first else 1):
        progress("digest", step / 6000, "")
        time.sleep(0.1)
    Path("made/half").unlink()
    Path("made/digest").write_text(hashlib.sha256(Path("scene").read_bytes()).hexdigest())
    return {"folder": str(Path.cwd())}
