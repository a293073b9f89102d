"""Options that several commands share, in groups, and the conversion of their values."""

from __future__ import annotations

import functools
import glob
import inspect
import os
import re
from collections.abc import Callable
from dataclasses import dataclass, is_dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_type_hints

from typer import Argument, Option

from kissgs.cli.files import is_folder
from kissgs.core.context import Device
from kissgs.core.errors import UnsupportedError
from kissgs.formats import ENDINGS, SCENE_ENDINGS

if TYPE_CHECKING:
    from kissgs.cameras.views import Views
    from kissgs.io.scene_format import ReadOptions
    from kissgs.settings import Settings

# Values of options: typer calls these functions with the words that a user has given.

Values = dict[str, Any]


def one_of(option: str, *allowed: str) -> Callable[[str], Any]:
    """Return a function that checks that the value of an option is one of these."""

    def check(value: str) -> str:
        if value not in allowed:
            *others, last = allowed
            raise UnsupportedError(f"{option} {value}: choose {', '.join(others)}{' or ' * bool(others)}{last}")
        return value

    return check


def steps_of(text: str) -> Values:
    """Parse the value of ``--finetune``: a number of steps, or auto for that of the preset; 0 turns it off."""
    if text == "auto":
        return {"enabled": True}
    if not text.isdecimal():
        raise UnsupportedError(f"--finetune {text}: give a number of steps, or none for that of the preset")
    return {"enabled": True, "steps": text} if int(text) else {"enabled": False}


def count_of(text: str) -> int:
    """Parse a number of Gaussians: 200000, 200,000, 200k, 1.5M."""
    word = text.strip().lower()
    if re.fullmatch(r"[0-9]{1,3}(,[0-9]{3})+|[0-9]+", word):
        return int(word.replace(",", ""))
    if re.fullmatch(r"[0-9]+(\.[0-9]+)?[km]", word):
        return round(float(word[:-1]) * {"k": 1e3, "m": 1e6}[word[-1]])
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
    """Parse the value of ``--compact``: 200k Gaussians, a share of 20%, a PSNR drop of 0.2dB, or auto with a goal."""
    word = text.strip().lower().replace(" ", "")
    if word == "auto":
        return {"auto_count": True}
    if found := re.fullmatch(r"([0-9]*\.?[0-9]+)(%|db)", word):
        return {"ratio": float(found[1]) * 0.01} if found[2] == "%" else {"max_psnr_drop": float(found[1])}
    try:
        return {"count": count_of(word)}
    except UnsupportedError as error:
        raise UnsupportedError(
            f"--compact {text}: give a number of Gaussians (200k), a share (20%), a PSNR drop (0.2dB), or auto with a "
            "goal"
        ) from error


# Single arguments and options.


def output_option(help: str, *, metavar: str = "PATH") -> Any:  # noqa: ANN401  as typer.Option
    """Declare ``--output``, of which each command says something else."""
    return Option("--output", "-o", metavar=metavar, help=help)


ScenesArgument = Annotated[
    list[str], Argument(metavar="FILE…", help="Files or glob patterns; '-' reads standard input.")
]
FilesArgument = Annotated[list[str], Argument(metavar="FILE…", help="Files or glob patterns.")]
PresetOption = Annotated[
    str, Option("--preset", "-p", help="Trade-off of speed, size and quality: fast, balanced or paper.")
]
ForceOption = Annotated[bool, Option("--force", "-f", help="Overwrite existing output files.")]
JsonOption = Annotated[bool, Option("--json", help="Print a JSON report: an object for one file, a list for several.")]
OriginOption = Annotated[
    Literal["auto"] | None,
    Option(
        metavar="auto",
        parser=one_of("--origin", "auto"),
        help="auto: make positions relative to the middle of the scene, where they have fine steps, and record it: for "
        "scenes far from the origin. Default: as in the file.",
    ),
]
ViewsOption = Annotated[
    Path | None,
    Option(
        "--views",
        metavar="DATA",
        help="Capture to work and evaluate with, cameras and optionally photographs: a folder with a COLMAP model or a "
        "transforms.json. Default: virtual cameras.",
    ),
]


# Groups of options: dataclasses, whose fields become options of the commands that take one as an argument.

PANELS = {
    "Output": ("output", "container", "unpacked", "to", "html", "save_camera", "evaluate", "force", "as_json"),
    "Goal": ("preset", "quality", "max_psnr_drop", "psnr", "target_size", "time", "count", "ratio"),
    "Method": ("method", "compact", "finetune", "changes"),
    "Photographs": ("views", "force_views", "scale", "images"),
    "Input": ("origin",),
    "Machine": ("server", "quiet", "checkpoint", "device", "cache", "ray"),
}
"""Titles under which the help of a command shows its options, by the names of their parameters."""

PANEL_OF = {name: panel for panel, names in PANELS.items() for name in names}


def with_option_groups(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command the options of each dataclass among its parameters, in the place of that parameter, and all of its
    options a panel of the help."""
    hints = get_type_hints(command, include_extras=True)
    groups: dict[str, Any] = {name: hint for name, hint in hints.items() if is_dataclass(hint)}
    options = dict[str, inspect.Parameter]()
    for name, parameter in inspect.signature(command).parameters.items():
        if name in groups:
            hints |= get_type_hints(groups[name], include_extras=True)
            options |= inspect.signature(groups[name]).parameters
        else:
            options[name] = parameter.replace(kind=parameter.KEYWORD_ONLY)

    @functools.wraps(command)
    def with_options(**given: Any) -> None:  # noqa: ANN401
        for name, group in groups.items():
            given[name] = group(**{field: given.pop(field) for field in inspect.signature(group).parameters})
        command(**given)

    for name in options.keys() & PANEL_OF.keys():
        vars(hints[name].__metadata__[0])["rich_help_panel"] = PANEL_OF[name]
    annotated = [option.replace(annotation=hints[name]) for name, option in options.items()]
    with_options.__annotations__ = {name: hints[name] for name in options}
    vars(with_options)["__signature__"] = inspect.Signature(annotated)
    return with_options


@dataclass(frozen=True, kw_only=True)
class SceneOptions:
    """Options of every command that reads scenes; ``kissgs --help`` explains them."""

    level: Annotated[int | None, Option(min=0, hidden=True)] = None
    max_gaussians: Annotated[int | None, Option(min=0, hidden=True)] = None
    raw_axes: Annotated[bool, Option("--raw-axes", hidden=True)] = False
    antialiased: Annotated[bool | None, Option("--antialiased/--classic", hidden=True)] = None
    threads: Annotated[int, Option(min=0, hidden=True)] = 0
    quiet: Annotated[bool, Option("--quiet", "-q", hidden=True)] = False

    def reading(self, origin: Literal["auto"] | None = None) -> ReadOptions:
        """Return the options of reading scenes."""
        from kissgs.io.scene_format import ReadOptions

        return ReadOptions(
            max_gaussians=self.max_gaussians,
            level=self.level or 0,
            raw_axes=self.raw_axes,
            origin=origin,
            antialiased=self.antialiased,
        )


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


@dataclass(frozen=True, kw_only=True)
class EncodingOptions:
    """Options of ``kissgs compress`` and ``kissgs remote compress``."""

    container: Annotated[
        str | None,
        Option(
            metavar="NAME",
            help="Container: sogxt, or sog for other viewers. Default: sog if --output ends in .sog, else sogxt.",
        ),
    ] = None
    preset: PresetOption = "balanced"
    changes: Annotated[
        list[str] | None,
        Option("--set", metavar="NAME=VALUE", help="Change another setting, see 'kissgs settings'; repeatable."),
    ] = None
    quality: Annotated[
        str | None,
        Option(
            metavar="NAME",
            parser=one_of("--quality", "same", "high", "good"),
            help="Find the smallest container that looks the same as the scene, or has high or good quality: limits on "
            "the losses of PSNR, SSIM and detail.",
        ),
    ] = None
    max_psnr_drop: Annotated[
        float | None,
        Option(metavar="DB", help="Find the smallest container that loses at most this PSNR, such as 0.1."),
    ] = None
    target_size: Annotated[
        str | None, Option(metavar="SIZE", help="Find the best container of at most this size, such as 800kB or 2.5MB.")
    ] = None
    psnr: Annotated[
        float | None,
        Option(metavar="DB", help="Find the smallest container with at least this PSNR to the scene's renderings."),
    ] = None
    compact: Annotated[
        Values | None,
        Option(
            metavar="BUDGET",
            parser=budget_of,
            help="First reduce the number of Gaussians, see 'kissgs compact': to a count (200k), a share (20%) or a "
            "PSNR drop (0.2dB); 100% keeps all; auto searches the number that serves a goal best, which is the default "
            "with held-out photographs, and without --views where it is fine-tuned.",
        ),
    ] = None
    finetune: Annotated[
        Values | None,
        Option(
            metavar="[STEPS]",
            parser=steps_of,
            help="Fine-tune the quantised values on the photographs of --views, or on renderings of the scene: fewer "
            "bytes at equal PSNR, a minute or two more. Default number of steps: that of the preset; 0: never. "
            "Default with a goal, if photographs are held out or there is no --views.",
        ),
    ] = None
    evaluate: Annotated[
        bool, Option("--evaluate", help="Decode the result, and measure PSNR and SSIM of its renderings.")
    ] = False
    origin: OriginOption = None

    def settings(self, *, time: str | None = None) -> Settings:
        """Return the settings that these options stand for."""
        return chosen(
            self.preset,
            self.changes,
            compact=self.compact,
            finetune=self.finetune,
            time=time,
            **{name: getattr(self, name) for name in ("psnr", "target_size", "max_psnr_drop", "quality")},
        )


@dataclass(frozen=True, kw_only=True)
class TrainingOptions:
    """Options of the commands that train."""

    views: ViewsOption = None
    force_views: Annotated[
        bool, Option("--force-views", help="Accept --views whose photographs do not show the scene.")
    ] = False
    checkpoint: Annotated[
        bool, Option("--checkpoint", help="Save the state of training next to the scene, and resume from it.")
    ] = False
    device: Annotated[
        Device,
        Option(
            metavar="NAME",
            parser=one_of("--device", "cpu", "cuda"),
            help="Device of training: cpu (reproducible) or cuda (results vary slightly).",
        ),
    ] = "cpu"

    def refuse_without_training(self, settings: Settings) -> None:
        """Raise UnsupportedError if ``--checkpoint`` or ``--device`` is given where nothing could train."""
        trains = (
            settings.finetune.enabled or (settings.compact.enabled and settings.compact.trains) or settings.time_only
        )
        if trains or not (self.checkpoint or self.device != "cpu"):
            return
        remedy = "leave them out, these settings take no training steps"
        if not settings.compact.enabled:
            remedy = "add --compact or --finetune"
        elif settings.compact.method == "merge":
            remedy = "leave them out, the method merge does not train"
        raise UnsupportedError(f"--checkpoint and --device only apply to training: {remedy}")


@dataclass(frozen=True, kw_only=True)
class CaptureOptions:
    """Options of the commands that render and can compare with photographs."""

    views: ViewsOption = None
    scale: Annotated[
        int | None, Option(min=1, help="Downscaling factor of the photographs of --views: 4 reads the folder images_4.")
    ] = None
    images: Annotated[
        Path | None, Option(help="Folder of the photographs of --views, if it is not the capture's own.")
    ] = None
    device: Annotated[
        Device,
        Option(metavar="NAME", parser=one_of("--device", "cpu", "cuda"), help="Device of the rasteriser: cpu or cuda."),
    ] = "cpu"

    def open(self, scene: Path) -> Views | None:
        """Load the capture of a scene; return None if there is none, and refuse options of its photographs then."""
        if self.views is None:
            for name, value in (("--scale", self.scale), ("--images", self.images)):
                if value is not None:
                    raise UnsupportedError(
                        f"{name} only applies to the photographs of a capture; give one with --views"
                    )
        return open_views(self.views, scene, scale=self.scale, images=self.images)


# Settings and captures that options stand for.


def chosen(
    preset: str,
    changes: list[str] | None,
    *,
    group: str = "encode",
    compact: Values | None = None,
    finetune: Values | None = None,
    time: str | None = None,
    **encode: float | str | None,
) -> Settings:
    """Return the settings of a preset with changes as for ``--set``, of ``group`` by default; the others override."""
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
    for name, given in (("compact", compact or {}), ("encode", encode), ("finetune", finetune or {})):
        values[name] |= {key: value for key, value in given.items() if value is not None}
    made = Settings.research if changes else Settings.from_preset
    return made(preset, time_limit=time, compact=values["compact"], finetune=values["finetune"], **values["encode"])


OPTIONAL_VALUES = {"--finetune": r"[0-9]+|auto", "--ray": r"auto|[^\s/]+:[0-9]+|ray://\S+"}
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
            if words[0] == "compress" and word == "--ray" and _is_host(following):
                raise UnsupportedError(f"--ray takes HOST:PORT, such as head:6379, not {following:.100}")
            result.append("auto")
    return result


def _is_host(word: str) -> bool:
    """Whether a word after ``--ray`` is rather meant as a machine without a port, or as a URL, than as a scene."""
    if word.startswith("-") or not word or glob.has_magic(word) or os.path.lexists(word):
        return False
    return "://" in word or ("/" not in word and Path(word).suffix.lower() not in (*ENDINGS, *SCENE_ENDINGS, ".json"))


def open_views(
    path: Path | None, scene: str | Path, *, scale: int | None = None, images: Path | None = None
) -> Views | None:
    """Load the capture at ``path``, if there is one; of a folder of captures, the one named as the scene, or as the
    nearest of three folders above it."""
    if path is None:
        return None
    from kissgs.cameras.captures.load import capture_of, load_views

    file = None if str(scene) == "-" else Path(scene).absolute()
    capture = capture_of(path, file)
    views = load_views(capture, scene=file, scale=scale, images=images)
    if capture == path:
        return views
    return replace(views, note="; ".join(filter(None, [f"the capture is {capture}", views.note])))


def open_common_views(path: Path | None) -> Views | None:
    """Load the capture at ``path`` before any work, so that it is refused once and not for each scene; return None if
    there is none, or it may be a folder of captures."""
    from kissgs.cameras.captures.load import is_capture, load_views

    return None if path is None or (is_folder(path) and not is_capture(path)) else load_views(path)
