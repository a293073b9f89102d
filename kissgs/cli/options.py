"""From what a user types to settings, captures and devices."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast, get_args

from kissgs.core.errors import UnsupportedError

if TYPE_CHECKING:
    from kissgs.cameras.views import Views
    from kissgs.settings import Settings

Values = dict[str, Any]
THOUSANDS = {"k": 1e3, "m": 1e6}


def chosen(
    preset: str,
    changes: list[str] | None,
    *,
    group: str = "encode",
    budget: Values | None = None,
    finetune: str | None = None,
    **options: float | str | None,
) -> Settings:
    """A preset with ``NAME=VALUE`` changes; options of their own, where they are given, override these.

    Args:
        preset: its name.
        changes: of settings of ``group``, or of another one as ``GROUP.NAME=VALUE``.
        group: "encode", "compact" or "finetune".
        budget: settings of "compact".
        finetune: a number of steps, or "auto" for that of the preset.
        options: settings of ``group``; None is not given.

    Raises:
        UnsupportedError: no such preset or setting, or a value that is not possible.
    """
    from kissgs.settings import Settings

    values: dict[str, Values] = {"compact": {}, "encode": {}, "finetune": {}}
    for change in changes or []:
        name, equals, value = change.partition("=")
        if not equals:
            raise UnsupportedError(f"--set {change!r}: write NAME=VALUE, for example --set means_bits=16")
        of, dot, inner = name.strip().partition(".")
        if dot and of not in values:
            raise UnsupportedError(f"--set {change!r}: there are settings of compact, encode and finetune")
        values[of if dot else group][inner if dot else of] = None if value.strip() == "auto" else value.strip()
    values["compact"].update(budget or {})
    values[group].update({name: value for name, value in options.items() if value is not None})
    values["finetune"].update(_tuning(finetune))
    if group == "encode" and options.get("seed") is not None:
        for other in ("compact", "finetune"):
            values[other].setdefault("seed", options["seed"])
    return Settings.from_preset(preset, compact=values["compact"], finetune=values["finetune"], **values["encode"])


FINETUNE = "--finetune"


def spelled_out(words: list[str]) -> list[str]:
    """A command line on which ``--finetune`` without a number means ``--finetune auto``: typer has no such options."""
    told = list[str]()
    for n, word in enumerate(words):
        if word == "--":
            return told + words[n:]
        told.append(word)
        following = words[n + 1] if n + 1 < len(words) else ""
        if word == FINETUNE and not (following.isdecimal() or following == "auto"):
            told.append("auto")
    return told


def _tuning(steps: str | None) -> Values:
    if steps is None:
        return {}
    if steps != "auto" and not steps.isdecimal():
        raise UnsupportedError(f"{FINETUNE} {steps}: write a number of steps, or nothing for that of the preset")
    return {"enabled": True} if steps == "auto" else {"enabled": True, "steps": steps}


def count_of(text: str) -> int:
    """Of Gaussians: 200000, 200,000, 200k, 1.5M.

    Raises:
        UnsupportedError: it is none.
    """
    word = text.strip().lower()
    if re.fullmatch(r"[0-9]{1,3}(,[0-9]{3})+|[0-9]+", word):
        return int(word.replace(",", ""))
    if re.fullmatch(r"[0-9]+(\.[0-9]+)?[km]", word):
        return round(float(word[:-1]) * THOUSANDS[word[-1]])
    raise UnsupportedError(
        f"{text!r} is no number of Gaussians; write 200000, 200k or 1.5M, or a share with --ratio 0.2"
    )


def budget_of(text: str) -> Values:
    """A budget in one word: a count such as 200k, a share such as 20%, a loss such as 0.2dB; auto: what a goal needs.

    Raises:
        UnsupportedError: it is none of these.
    """
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
            f"--compact {text}: say how many Gaussians to keep (200k), which share (20%), or how much PSNR may be "
            "lost (0.2dB); or auto, with a goal"
        ) from error


def open_views(
    path: Path | None, *, scale: int | None = None, images: Path | None = None, resolution: int | None = None
) -> Views | None:
    """The capture at ``path``; None where none is given, and then nothing may be said about its photographs."""
    if path is None:
        for name, value in (("--scale", scale), ("--images", images), ("--resolution", resolution)):
            if value is not None:
                raise UnsupportedError(f"{name} is about the photographs of a capture; say which with --views")
        return None
    from kissgs.cameras.captures.load import load_views

    return load_views(path, scale=scale, images=images, resolution=resolution)


def device_of(name: str) -> Literal["cpu", "cuda"]:
    """The value of ``--device``, if it is one."""
    return cast(Literal["cpu", "cuda"], choice("--device", name, Literal["cpu", "cuda"]))


def choice(option: str, value: str, allowed: Any) -> str:  # noqa: ANN401  a Literal has no type of its own
    """The value of an option that is one of ``allowed``, a Literal."""
    names = get_args(allowed)
    if value not in names:
        raise UnsupportedError(f"{option} {value}: choose {', '.join(names[:-1])} or {names[-1]}")
    return value
