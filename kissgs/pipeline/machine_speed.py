"""Expected time of an encoding on this machine, from its speed as ``kissgs warmup`` has measured it."""

from __future__ import annotations

import json
import os
from pathlib import Path

from kissgs.core.errors import OutputError
from kissgs.core.threads import processors
from kissgs.io.atomic import atomic_file, reason_of
from kissgs.settings import Preset

ENCODE_SECONDS = {
    Preset.FAST: (0.5, 0.0, 6e-6),
    Preset.BALANCED: (1.5, 5.0, 40e-6),
    Preset.SMALL: (1.5, 5.0, 80e-6),
    Preset.PAPER: (1.0, 0.0, 140e-6),
}
"""Seconds of an encoding by preset, measured on two processors: a fixed part; one that all scenes of more than
:data:`FULL_RENDERINGS` Gaussians have, for renderings; one per Gaussian."""

FULL_RENDERINGS = 20_000
"""Number of Gaussians from which renderings take about the same time; with fewer, they take in proportion less."""

SPEEDS = (1e-3, 1e3)
"""Slowest and fastest speed of a processor that is believed, in units of :func:`save_speed`."""

REFERENCE_PROCESSORS, MOST_PROCESSORS = 2, 8
"""Processors of that machine, and the number beyond which an encoding is taken to become no faster."""


def encode_seconds(preset: Preset, count: int, threads: int = 0) -> float:
    """Return the expected wall time of an encoding of ``count`` Gaussians without training, seconds.

    ``threads`` is the number of threads; 0 means one per processor.
    """
    used = min(threads or processors(), processors(), MOST_PROCESSORS)
    return _reference_seconds(preset, count) / (_speed_per_processor() * used)


def _reference_seconds(preset: Preset, count: int) -> float:
    fixed, renderings, each = ENCODE_SECONDS[preset]
    return fixed + renderings * min(count / FULL_RENDERINGS, 1.0) + each * count


def save_speed(seconds: float, preset: Preset, count: int) -> None:
    """Save the speed of this machine, which encoded ``count`` Gaussians in ``seconds`` with all its processors.

    Raises:
        OutputError: the file cannot be written.
    """
    speed = _reference_seconds(preset, count) / seconds
    try:
        path = _speed_file()
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"cannot write {path}: {reason_of(error)}") from error
    except RuntimeError as error:  # this user has no home
        raise OutputError("there is no folder for caches; name one by XDG_CACHE_HOME") from error
    with atomic_file(path, overwrite=True) as file:
        file.write(json.dumps({"speed_per_processor": speed / min(processors(), MOST_PROCESSORS)}).encode())


def _speed_per_processor() -> float:
    """Return the speed that was saved, of the reference machine if none was or the file is damaged."""
    try:
        speed = float(json.loads(_speed_file().read_bytes())["speed_per_processor"])
    except (OSError, RuntimeError, ValueError, TypeError, KeyError, OverflowError):
        return 1 / REFERENCE_PROCESSORS
    return speed if SPEEDS[0] <= speed <= SPEEDS[1] else 1 / REFERENCE_PROCESSORS


def _speed_file() -> Path:
    """Return the file of the speed, in the user's folder for caches."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "kissgs" / "speed.json"
