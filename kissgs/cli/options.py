"""Arguments and options that several commands share, as typer types."""

from __future__ import annotations

import functools
import glob
import inspect
import os
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, cast, get_args, get_type_hints

import typer

from kissgs.core.errors import UnsupportedError
from kissgs.formats import ENDINGS, SCENE_ENDINGS

if TYPE_CHECKING:
    from kissgs.cameras.views import Views
    from kissgs.formats import ContainerName
    from kissgs.io.scene_format import ReadOptions
    from kissgs.settings import Settings


@dataclass(frozen=True, kw_only=True)
class SceneOptions:
    """Options of every command that reads scenes: :func:`reads_scenes` adds them, ``kissgs --help`` explains them."""

    level: Annotated[int | None, typer.Option(min=0, hidden=True)] = None
    max_gaussians: Annotated[int | None, typer.Option(min=0, hidden=True)] = None
    raw_axes: Annotated[bool, typer.Option("--raw-axes", hidden=True)] = False
    antialiased: Annotated[bool | None, typer.Option("--antialiased/--classic", hidden=True)] = None
    threads: Annotated[int, typer.Option(min=0, hidden=True)] = 0
    quiet: Annotated[bool, typer.Option("--quiet", "-q", hidden=True)] = False

    def reading(self, origin: str | None = None) -> ReadOptions:
        """Return the options of reading scenes; ``origin`` is the value of ``--origin``."""
        from kissgs.io.scene_format import ReadOptions

        return ReadOptions(
            max_gaussians=self.max_gaussians,
            level=self.level or 0,
            raw_axes=self.raw_axes,
            origin=origin_of(origin),
            antialiased=self.antialiased,
        )


def reads_scenes(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command the options of :class:`SceneOptions`, which it takes as its argument ``common``."""
    shared = inspect.signature(SceneOptions).parameters
    hints = get_type_hints(command, include_extras=True) | get_type_hints(SceneOptions, include_extras=True)

    @functools.wraps(command)
    def with_options(**given: Any) -> None:  # noqa: ANN401
        command(common=SceneOptions(**{name: given.pop(name) for name in shared}), **given)

    own = {name: found for name, found in inspect.signature(command).parameters.items() if name != "common"}
    parameters = [found.replace(annotation=hints[name]) for name, found in {**own, **shared}.items()]
    with_options.__annotations__ = {name: hints[name] for name in (*own, *shared)}
    vars(with_options)["__signature__"] = inspect.Signature(parameters)
    return with_options


SCENE_OPTIONS = """Every command that reads scenes also takes:

[cyan]--level[/] N  Level of detail of a streamed scene; 0, the default, is the finest.

[cyan]--max-gaussians[/] N  Refuse files with more Gaussians. Default: 20 million in compressed formats, whose
files can declare far more than they hold.

[cyan]--raw-axes[/]  Take the axes of .spz as those of a .ply, as splat-transform writes and reads them.
Default: y up.

[cyan]--antialiased/--classic[/]  Take the scene as trained with antialiasing, or as a classic one. Default: as the
file is marked.

[cyan]--threads[/] N  Number of threads; 0, the default, for one per processor. The output does not depend on it.

[cyan]--quiet[/], [cyan]-q[/]  Print only errors.
"""

SEE_SCENE_OPTIONS = (
    "Also: --level, --max-gaussians, --raw-axes, --antialiased/--classic, --threads, --quiet; see 'kissgs --help'."
)

ScenesArgument = Annotated[
    list[str], typer.Argument(metavar="FILE…", help="Files or glob patterns; '-' reads standard input.")
]
FilesArgument = Annotated[list[str], typer.Argument(metavar="FILE…", help="Files or glob patterns.")]
ContainerOption = Annotated[
    str | None,
    typer.Option(
        metavar="NAME",
        help="Container: sogxt, or sog for other viewers. Default: sog if --output ends in .sog, else sogxt.",
    ),
]
PresetOption = Annotated[
    str, typer.Option("--preset", "-p", help="Trade-off of speed, size and quality: fast, balanced, small or paper.")
]
SetOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set", metavar="NAME=VALUE", help="Change another setting; repeatable. List: docs/reference/settings.md."
    ),
]
ResearchOption = Annotated[list[str] | None, typer.Option("--set", metavar="NAME=VALUE", hidden=True)]
SeedOption = Annotated[int | None, typer.Option(help="Seed of all random choices; same seed, same result. Default: 0.")]
ForceOption = Annotated[bool, typer.Option("--force", "-f", help="Overwrite existing output files.")]
JsonOption = Annotated[
    bool, typer.Option("--json", help="Print a JSON report: an object for one file, a list for several.")
]
OriginOption = Annotated[
    str | None,
    typer.Option(
        metavar="auto",
        help="auto: make positions relative to the middle of the scene, where they have fine steps, and record it: for "
        "scenes far from the origin. Default: as in the file.",
    ),
]
ViewsOption = Annotated[
    Path | None,
    typer.Option(
        "--views",
        metavar="DATA",
        help="Capture to work and evaluate with, cameras and optionally photographs: a folder with a COLMAP model or a "
        "transforms.json. Default: virtual cameras.",
    ),
]
ForceViewsOption = Annotated[
    bool, typer.Option("--force-views", help="Accept --views whose photographs do not show the scene.")
]
ScaleOption = Annotated[
    int | None,
    typer.Option(min=1, help="Downscaling factor of the photographs of --views: 4 reads the folder images_4."),
]
ImagesOption = Annotated[
    Path | None, typer.Option(help="Folder of the photographs of --views, if it is not the capture's own.")
]
SplitOption = Annotated[
    str, typer.Option(help="Views of --views to use: test (held-out), train or all.", show_default=True)
]
RenderDeviceOption = Annotated[str, typer.Option(help="Device of the rasteriser: cpu or cuda.")]
PsnrOption = Annotated[
    float | None,
    typer.Option(metavar="DB", help="Find the smallest container with at least this PSNR to the scene's renderings."),
]
TargetSizeOption = Annotated[
    str | None,
    typer.Option(metavar="SIZE", help="Find the best container of at most this size, such as 800kB or 2.5MB."),
]
MaxPsnrDropOption = Annotated[
    float | None,
    typer.Option(metavar="DB", help="Find the smallest container that loses at most this PSNR, such as 0.1."),
]
MaxSsimDropOption = Annotated[
    float | None,
    typer.Option(
        metavar="SSIM",
        help="Find the smallest container that loses at most this SSIM, such as 0.003.",
    ),
]
TimeOption = Annotated[
    str | None,
    typer.Option(
        "--time",
        metavar="TIME",
        help="Time for each scene, such as 30s, 2min or 1h: the best that is found in it. With a goal, which comes "
        "first, it bounds the search. --evaluate takes longer.",
    ),
]
CompactOption = Annotated[
    str | None,
    typer.Option(
        metavar="BUDGET",
        help="First reduce the number of Gaussians, see 'kissgs compact': to a count (200k), a share (20%) or a "
        "PSNR drop (0.2dB); 100% keeps all; auto searches the number that serves a goal best, which is the default "
        "with held-out photographs, and without --views where it is fine-tuned.",
    ),
]
FinetuneOption = Annotated[
    str | None,
    typer.Option(
        metavar="[STEPS]",
        help="Fine-tune the quantised values on the photographs of --views, or on renderings of the scene: fewer "
        "bytes at equal PSNR, a minute or two more. Default number of steps: that of the preset; 0: never. "
        "Default with a goal, if photographs are held out or there is no --views.",
    ),
]
EvaluateOption = Annotated[
    bool, typer.Option("--evaluate", help="Decode the result, and measure PSNR and SSIM of its renderings.")
]
CHECKPOINT = ".checkpoint.npz"
"""Ending of checkpoints beside their outputs."""

CheckpointOption = Annotated[
    bool, typer.Option("--checkpoint", help="Save the state of training next to the scene, and resume from it.")
]
DeviceOption = Annotated[
    str, typer.Option(help="Device of training: cpu (reproducible) or cuda (results vary slightly).")
]
RayOption = Annotated[
    str | None,
    typer.Option(
        "--ray",
        metavar="[HOST:PORT]",
        help="Compress the scenes on the nodes of a Ray cluster: all machines must see scenes, outputs and --views at "
        "the same paths, on shared storage. Default address: RAY_ADDRESS, a cluster on this machine, or a new one that "
        "uses its processors. Needs the extra ray; docs/guide/many-machines.md.",
    ),
]


# ``CompressOptions``: options of ``kissgs compress``, read and checked.


@dataclass(frozen=True, kw_only=True)
class CompressOptions:
    """Options that apply to each scene of one ``kissgs compress``, checked."""

    settings: Settings
    reading: ReadOptions
    container: ContainerName
    cache: bool
    evaluate: bool
    views: Path | None
    force_views: bool
    checkpoint: bool
    force: bool
    threads: int
    device: Literal["cpu", "cuda"]
    quiet: bool


# Conversion of command line options to settings, captures and devices.

Values = dict[str, Any]
THOUSANDS = {"k": 1e3, "m": 1e6}


def chosen(
    preset: str,
    changes: list[str] | None,
    *,
    group: str = "encode",
    budget: Values | None = None,
    finetune: str | None = None,
    time: str | None = None,
    **options: float | str | None,
) -> Settings:
    """Return the settings of a preset with ``NAME=VALUE`` or ``GROUP.NAME=VALUE`` changes, which ``options`` override.

    Changes may be values that belong to the preset. ``group`` is that of changes without one; ``options`` are settings
    of encode.
    """
    from kissgs.settings import Settings

    values: dict[str, Values] = {"compact": {}, "encode": {}, "finetune": {}}
    for change in changes or []:
        name, equals, value = change.partition("=")
        if not equals:
            raise UnsupportedError(f"--set {change!r}: write NAME=VALUE, for example --set max_encodes=5")
        of, dot, inner = name.strip().partition(".")
        if not dot and of in ("preset", "time_limit", *values):
            raise UnsupportedError(f"--set {change!r}: write GROUP.NAME=VALUE, or --preset and --time")
        if dot and of not in values:
            raise UnsupportedError(
                f"--set {change!r}: unknown group {of!r}; the groups are compact, encode and finetune"
            )
        values[of if dot else group][inner if dot else of] = None if value.strip() == "auto" else value.strip()
    values["compact"].update(budget or {})
    values["encode"].update({name: value for name, value in options.items() if value is not None})
    values["finetune"].update(_finetune_values(finetune))
    groups = {"compact": values["compact"], "finetune": values["finetune"]}
    made = Settings.research if changes else Settings.from_preset
    return made(preset, time_limit=time, **groups, **values["encode"])


FINETUNE, RAY = "--finetune", "--ray"

OPTIONAL_VALUES = {FINETUNE: r"[0-9]+|auto", RAY: r"auto|[^\s/]+:[0-9]+|ray://\S+"}
"""Options whose value may be left out, and what a value looks like."""


def with_default_values(words: list[str]) -> list[str]:
    """Insert ``auto`` after each ``--finetune`` and ``--ray`` without a value: typer has no optional values."""
    result = list[str]()
    for n, word in enumerate(words):
        if word == "--":
            return result + words[n:]
        result.append(word)
        following = words[n + 1] if n + 1 < len(words) else ""
        if word in OPTIONAL_VALUES and not re.fullmatch(OPTIONAL_VALUES[word], following):
            if words[0] == "compress" and word == RAY and _is_host(following):
                raise UnsupportedError(f"--ray takes HOST:PORT, such as head:6379, not {following:.100}")
            result.append("auto")
    return result


def _is_host(word: str) -> bool:
    """Whether a word that follows ``--ray`` is rather meant as a machine without a port, or as a URL, than as a scene.

    It is if no file has the name, and it is not that of a file that may be missing.
    """
    if word.startswith("-") or not word or glob.has_magic(word) or os.path.lexists(word):
        return False
    return "://" in word or ("/" not in word and Path(word).suffix.lower() not in (*ENDINGS, *SCENE_ENDINGS, ".json"))


def _finetune_values(steps: str | None) -> Values:
    if steps is None:
        return {}
    if steps != "auto" and not steps.isdecimal():
        raise UnsupportedError(f"{FINETUNE} {steps}: give a number of steps, or none for that of the preset")
    if steps == "auto":
        return {"enabled": True}
    return {"enabled": True, "steps": steps} if int(steps) else {"enabled": False}


def count_of(text: str) -> int:
    """Parse a number of Gaussians: 200000, 200,000, 200k, 1.5M."""
    word = text.strip().lower()
    if re.fullmatch(r"[0-9]{1,3}(,[0-9]{3})+|[0-9]+", word):
        return int(word.replace(",", ""))
    if re.fullmatch(r"[0-9]+(\.[0-9]+)?[km]", word):
        return round(float(word[:-1]) * THOUSANDS[word[-1]])
    raise UnsupportedError(
        f"{text!r} is no number of Gaussians; give 200000, 200k or 1.5M, or a share with --ratio 0.2"
    )


def share_of(text: str) -> float:
    """Parse a share: 0.2 or 20%."""
    word = text.strip()
    try:
        return float(word.removesuffix("%")) * (0.01 if word.endswith("%") else 1.0)
    except ValueError as error:
        raise UnsupportedError(f"--ratio {text}: give a share such as 0.2 or 20%") from error


def budget_of(text: str) -> Values:
    """Parse a budget: a count such as 200k, a share such as 20%, a PSNR drop such as 0.2dB, or auto with a goal."""
    word = text.strip().lower().replace(" ", "")
    if word == "auto":
        return {"auto_count": True}
    for ending, name, unit in (("%", "ratio", 0.01), ("db", "max_psnr_drop", 1.0)):
        number = word.removesuffix(ending)
        if word.endswith(ending) and re.fullmatch(r"[0-9]*\.?[0-9]+", number):
            return {name: float(number) * unit}
    try:
        return {"count": count_of(word)}
    except UnsupportedError as error:
        raise UnsupportedError(
            f"--compact {text}: give a number of Gaussians (200k), a share (20%), a PSNR drop (0.2dB), or auto with a "
            "goal"
        ) from error


def open_views(path: Path | None, *, scale: int | None = None, images: Path | None = None) -> Views | None:
    """Load the capture at ``path``; return None if there is none, and refuse options of its photographs then."""
    if path is None:
        for name, value in (("--scale", scale), ("--images", images)):
            if value is not None:
                raise UnsupportedError(f"{name} only applies to the photographs of a capture; give one with --views")
        return None
    from kissgs.cameras.captures.load import load_views

    return load_views(path, scale=scale, images=images)


def device_of(name: str) -> Literal["cpu", "cuda"]:
    """Check the value of ``--device``."""
    return cast(Literal["cpu", "cuda"], choice("--device", name, Literal["cpu", "cuda"]))


def origin_of(name: str | None) -> Literal["auto"] | None:
    """Check the value of ``--origin``."""
    return None if name is None else cast(Literal["auto"], choice("--origin", name, Literal["auto"]))


def refuse_without_training(settings: Settings, *, checkpoint: bool, device: str) -> None:
    """Raise UnsupportedError if ``--checkpoint`` or ``--device`` is given where nothing could train."""
    trains = settings.finetune.enabled or (settings.compact.enabled and settings.compact.trains) or settings.aims
    if trains or not (checkpoint or device != "cpu"):
        return
    remedy = "leave them out, these settings take no training steps"
    if not settings.compact.enabled:
        remedy = "add --compact or --finetune"
    elif settings.compact.method == "merge":
        remedy = "leave them out, the method merge does not train"
    raise UnsupportedError(f"--checkpoint and --device only apply to training: {remedy}")


def choice(option: str, value: str, allowed: Any) -> str:  # noqa: ANN401  a Literal has no type of its own
    """Check that the value of an option is one of ``allowed``, a Literal."""
    names = get_args(allowed)
    if value not in names:
        others = ", ".join(names[:-1])
        known = f"{others} or {names[-1]}" if others else names[-1]
        raise UnsupportedError(f"{option} {value}: choose {known}")
    return value
