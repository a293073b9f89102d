"""Points of rate-distortion curves in a CSV file, their means over scenes, bytes at equal quality, and ranks."""

from __future__ import annotations

import codecs
import csv
import math
import sys
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from kissgs import KissgsError

MEAN = "_mean"
"""Name of the mean over the scenes of a data set, in place of a scene's."""

METRICS = {"psnr": "PSNR", "ssim": "SSIM", "lpips": "LPIPS"}
NUMBERS = "bytes", *METRICS, "seconds", "cpu_seconds"

Curve = Sequence[tuple[float, float]]
"""Points (quality, bytes) in any order; more quality is better."""

Cell = Annotated[float | None, BeforeValidator(lambda cell: None if cell == "" else cell)]


class Point(BaseModel):
    """A file of a scene, and the quality of what it shows; None where that was not measured."""

    model_config = ConfigDict(frozen=True)

    series: str  # how it was made
    dataset: str
    scene: str
    tier: str  # name of the number of Gaussians, such as L
    bytes: Annotated[float, Field(gt=0, allow_inf_nan=False)]
    psnr: Cell
    ssim: Cell
    lpips: Cell
    seconds: Cell = None  # wall time of this step
    cpu_seconds: Cell = None  # of all threads
    stages: Annotated[str, Field(pattern=r"^([^=]+=\d+(\.\d+)?( |$))*$")] = (
        ""  # wall times of its parts: "order=1.5 codebook=20.1"
    )
    key: str = ""  # stands for input, views and settings

    @property
    def place(self) -> tuple[str, str, str, str]:
        """Names of what the point is of; a later point of the same place replaces it."""
        return self.series, self.dataset, self.scene, self.tier

    def value(self, metric: str) -> float | None:
        """Return one of :data:`METRICS`; None if it was not measured, or is not finite."""
        value: float | None = getattr(self, metric)
        return value if value is not None and math.isfinite(value) else None

    def quality(self, metric: str) -> float | None:
        """Return one of :data:`METRICS` so that more is better."""
        value = self.value(metric)
        return -value if value is not None and metric == "lpips" else value


def read_points(path: Path) -> list[Point]:
    """Read points from a CSV file whose head names at least the columns before ``seconds``.

    Raises:
        KissgsError: the file is not such a table; OSError if it cannot be read.
    """
    found = dict[tuple[str, ...], Point]()
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            for number, row in enumerate(csv.DictReader(file, strict=True), 2):
                point = _point(row, f"line {number} of {path}")
                found[point.place] = point
    except (UnicodeDecodeError, csv.Error) as error:
        raise KissgsError(f"{path} is no table of points ({error}); give a CSV file in UTF-8") from error
    return list(found.values())


def _point(row: Mapping[str | None, object], where: str) -> Point:
    try:
        if None in row or None in row.values():
            raise KissgsError(f"{where} has another number of cells than the head; correct it")
        return Point.model_validate(row)
    except ValidationError as error:
        problem = error.errors()[0]
        reason = f"{problem['loc'][0]}: {problem['msg'].lower()}"
        raise KissgsError(f"{where} is no point of a curve ({reason}); correct it") from error


def resumed_points(path: Path) -> list[Point]:
    """Read the points of a run, if there are any, without the last line if its writing was interrupted."""
    data = path.read_bytes() if path.exists() else b""
    whole = data[: data.rfind(b"\n") + 1]
    if len(whole) < len(data):
        sys.stderr.write(f"the last line of {path} is incomplete and dropped\n")
        with path.open("r+b") as file:
            file.truncate(len(whole))
    head = whole.removeprefix(codecs.BOM_UTF8).partition(b"\n")[0].strip()
    if head and head != ",".join(Point.model_fields).encode():
        raise KissgsError(f"{path} has other columns than this version writes; rename it")
    return read_points(path) if whole else []


def append_point(path: Path, point: Point) -> None:
    """Add a point to a CSV file, which is made if there is none."""
    with path.open("a", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(Point.model_fields))
        if file.tell() == 0:
            writer.writeheader()
        writer.writerow(point.model_dump())


def means(points: Sequence[Point], missing: list[str] | None = None) -> list[Point]:
    """Return the means of each series and tier over the scenes of a data set, of bytes too. Means that are given stay,
    and where a scene of the data set is missing there is none, since means over other scenes say nothing; a sentence
    about that is added to ``missing``."""
    scenes, groups = defaultdict[str, set[str]](set), defaultdict[tuple[str, str, str], list[Point]](list)
    given = [point for point in points if point.scene == MEAN]
    for point in points:
        if point.scene != MEAN:
            scenes[point.dataset].add(point.scene)
            groups[point.series, point.dataset, point.tier].append(point)
    known = {(point.series, point.dataset, point.tier) for point in given}
    for place, group in groups.items():
        absent = sorted(scenes[place[1]] - {point.scene for point in group})
        if absent and missing is not None:
            missing.append(f"no mean of {place[0]}, {place[1]} {place[2]}: there is no point of {', '.join(absent)}")
        if place not in known and not absent:
            values: dict[str, float | None] = {name: _mean([getattr(each, name) for each in group]) for name in NUMBERS}
            own = {"scene": MEAN, "stages": "", "key": ""}
            given.append(Point.model_validate({**group[0].model_dump(), **own, **values}))
    return given


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if len(known) == len(values) else None


def bytes_at(curve: Curve, quality: float) -> float | None:
    """Return the bytes at this quality, their logarithm interpolated linearly; None beyond the ends of the curve."""
    finite = sorted((value, math.log(size)) for value, size in curve if math.isfinite(value))
    if not finite or not finite[0][0] <= quality <= finite[-1][0]:
        return None
    x, y = zip(*finite, strict=True)
    return float(np.exp(np.interp(quality, x, y)))


def pareto(curve: Curve) -> Curve:
    """Return the points, by bytes, that are better than all smaller ones."""
    front = list[tuple[float, float]]()
    for quality, size in sorted(curve, key=lambda point: (point[1], -point[0])):
        if not front or quality > front[-1][0]:
            front.append((quality, size))
    return front


def reduction(reference: Point, curve: Sequence[Point], metric: str) -> str:
    """Return how many times fewer bytes than the reference a series takes at the reference's quality, as the paper
    writes it: "228"; "77*" where already the smallest point is better, so that it is at least that; "-" if the quality
    is never reached; empty if it is not measured."""
    wanted = reference.quality(metric)
    front = pareto([(value, point.bytes) for point in curve if (value := point.quality(metric)) is not None])
    if wanted is None or not front:
        return ""
    better = wanted < front[0][0]
    size = front[0][1] if better else bytes_at(front, wanted)
    if size is None:
        return "-"
    factor = reference.bytes / size
    return f"{factor:.0f}{'*' * better}" if round(factor) >= 10 else f"{factor:.1f}{'*' * better}"


def ranks(points: Mapping[str, Point]) -> dict[str, float]:
    """Return the rank of each, 1 is best: half of it by bytes, half by the metrics that all have. Equal ones share the
    mean of their ranks."""
    measured = [name for name in METRICS if all(point.quality(name) is not None for point in points.values())]
    columns = [("bytes", 0.5), *((name, 0.5 / len(measured)) for name in measured)]
    total = dict.fromkeys(points, 0.0)
    for column, weight in columns:
        values = {name: -each.bytes if column == "bytes" else each.quality(column) for name, each in points.items()}
        for name, value in values.items():
            better = sum(other > value for other in values.values())  # type: ignore[operator]
            equal = sum(other == value for other in values.values())
            total[name] += weight * (better + (equal + 1) / 2)
    return total
