"""The containers that ``compress`` writes: what each can hold, how its files are made, and which a name asks for."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from kissgs.core.errors import UnsupportedError
from kissgs.core.progress import Progress
from kissgs.core.splats import Cleaned, Splats
from kissgs.planning.container_model import EVEN_LEVELS, ContainerModel
from kissgs.planning.encoded import Encoded
from kissgs.planning.encoding_plan import EncodingPlan
from kissgs.settings import EncodeSettings
from kissgs.sog import encode as sog
from kissgs.sog.container_model import SOG
from kissgs.sog.decode import decode as decode_sog
from kissgs.sogxt import encode as sogxt
from kissgs.sogxt import names
from kissgs.sogxt.decode import decode as decode_sogxt

ContainerName = Literal["sog-xt", "sog"]
"""SOG-XT, the default, or SOG of version 2, which other viewers open."""

ENDINGS: dict[str, ContainerName] = {".zip": "sog-xt", ".sog": "sog"}
"""Container of a file by its ending."""

MODELS: dict[ContainerName, ContainerModel] = {"sog-xt": EVEN_LEVELS, "sog": SOG}
"""Model of each container for the planner."""

DECODERS = {"sog-xt": decode_sogxt, "sog": decode_sog}
"""Decoder of each container."""

FILES: dict[ContainerName, tuple[str, ...]] = {"sog-xt": names.FILES, "sog": sog.FILES}
"""Names of all files that a container may have."""


def ending_of(container: ContainerName) -> str:
    """Return the ending of a container's files."""
    return next(ending for ending, name in ENDINGS.items() if name == container)


def named_container(requested: str | None, destination: Path | None) -> ContainerName:
    """Return the container to write: the requested one, else that of the destination's ending, else SOG-XT.

    Raises:
        UnsupportedError: there is no such container, or the ending asks for another one.
    """
    by_ending = None if destination is None else ENDINGS.get(destination.suffix.lower())
    if requested is None:
        return by_ending or "sog-xt"
    for name in MODELS:
        if requested == name:
            if by_ending not in (None, name):
                raise UnsupportedError(
                    f"{destination} is not the name of a {name} container: end it in {ending_of(name)}"
                )
            return name
    raise UnsupportedError(f"there is no container {requested!r}; choose one of {', '.join(MODELS)}")


def write_files(
    container: ContainerName,
    plan: EncodingPlan,
    splats: Splats,
    settings: EncodeSettings,
    *,
    cleaned: Cleaned,
    compacted: int,
    finetune_steps: int,
    threads: int,
    progress: Progress,
) -> Encoded:
    """Make the files of a plan for a container.

    The other parameters are those of :func:`kissgs.sogxt.encode.write_files`.

    Raises:
        UnsupportedError: the container cannot hold the plan.
    """
    if container == "sog":
        return sog.write_files(plan, splats, settings, threads=threads, progress=progress)
    return sogxt.write_files(
        plan,
        splats,
        settings,
        cleaned=cleaned,
        compacted=compacted,
        finetune_steps=finetune_steps,
        threads=threads,
        progress=progress,
    )
