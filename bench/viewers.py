"""Quality of files as others' viewers draw them: Spark and the PlayCanvas engine, in real Chromium, with software GL.

    python bench/viewers.py fox.ply balanced.sog other.sog --views fox -o fox.csv

Each drawing of a file is compared with the drawing of the scene by the same renderer: a viewer, with its own settings,
or kissgs.render. Row "scene.ply" compares the viewer with kissgs.render. "reordered.ply" is the scene with its rows
shuffled: what the order of Gaussians alone changes. Needs Chromium, and what scripts/setup dev installs. NAME.csv gets
a contact sheet, NAME.png, beside it.
"""

from __future__ import annotations

import csv
import io
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from helpers.viewers import chromium, opened

from bench.common import head, parser_with_views, positive, row, run
from kissgs import Camera, KissgsError, Splats, Views, clean, load
from kissgs.core.context import Context
from kissgs.core.positions import with_origin
from kissgs.evaluation.cameras import evaluation_views
from kissgs.evaluation.evaluate import in_scene_frame, render_clamped
from kissgs.evaluation.html import heat_map, rms_difference
from kissgs.evaluation.results import MAX_VIEW_PSNR
from kissgs.io.files import atomic_file
from kissgs.io.ply import write_ply
from kissgs.rendering.images import Label, contact_sheet, png
from kissgs.rendering.metrics import psnr, ssim

READ = {"spark": ("compressed.ply", "ply", "sog", "spz", "splat"), "playcanvas": ("compressed.ply", "ply", "sog")}
"""Endings of the files that each viewer reads, longer ones first."""
METRICS = "PSNR", "SSIM", "worst view"
FULL_ERROR = 30
"""Error of the brightest colour in the contact sheet, levels of an 8-bit image."""

Images = list[np.ndarray]
"""An image for each camera, ``(H, W, 3)``, 0 to 1."""


@dataclass(frozen=True, slots=True)
class Drawn:
    """A file, what kissgs reads from it, and its images by renderer; renderers that cannot read it are left out."""

    name: str
    data: bytes
    splats: Splats
    images: dict[str, Images] = field(default_factory=dict)


def main() -> None:
    """Print the table; write it, and the contact sheet beside it."""
    parser = parser_with_views(__doc__)
    parser.add_argument("scene", type=Path)
    parser.add_argument("files", nargs="+", type=Path)
    parser.add_argument("--size", nargs=2, type=positive, default=(480, 360), metavar=("W", "H"), help="of images")
    parser.add_argument("--cameras", type=positive, default=6, help="largest number of cameras")
    parser.add_argument("-o", "--output", type=Path, metavar="NAME.csv", help="table")
    given = parser.parse_args()
    if given.output is not None and given.output.suffix == ".png":
        parser.error("--output names the table, such as NAME.csv; the contact sheet lies beside it as NAME.png")
    scene = clean(load(given.scene))[0]
    shuffled = scene.select(np.random.Generator(np.random.PCG64(0)).permutation(len(scene)))
    files = [Drawn("scene.ply", as_ply(scene), scene), Drawn("reordered.ply", as_ply(shuffled), shuffled)]
    files += [
        Drawn(path.name, path.read_bytes(), with_origin(clean(load(path))[0], scene.origin)) for path in given.files
    ]
    draw(files, chosen_cameras(scene, given.views, given.cameras, given.size))
    table = list(rows(files))
    head(*map(str, table[0]))
    for cells in table[1:]:
        row(*cells)
    if given.output:
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows(table)
        sheet = given.output.with_suffix(".png")
        for path, data in ((given.output, text.getvalue().encode()), (sheet, sheet_of(files))):
            with atomic_file(path, overwrite=True) as file:
                file.write(data)


def as_ply(splats: Splats) -> bytes:
    """Return the bytes of a ``.ply``."""
    file = io.BytesIO()
    write_ply(file, splats)
    return file.getvalue()


def chosen_cameras(scene: Splats, views: Views | None, count: int, size: Sequence[int]) -> list[Camera]:
    """Return drawn cameras that look at the scene from outside, or ones spread over the capture's held-out views.

    Other drawn cameras have Gaussians beside or around them, which each viewer draws, cuts or omits in its own way. A
    capture's images have the width of ``size`` and keep their aspect ratio.
    """
    if views is None:
        drawn = [view for view in evaluation_views(scene).test if view.name.endswith("far")]
        return [view.camera.resized(*size) for view in drawn[:count]]
    moved = in_scene_frame(scene, views)
    cameras = [view.camera for view in moved.test or moved.train]
    spread = [cameras[n] for n in np.unique(np.linspace(0, len(cameras) - 1, count).astype(int))]
    return [each.resized(size[0], round(size[0] * each.height / each.width)) for each in spread]


def draw(files: Sequence[Drawn], cameras: Sequence[Camera]) -> None:
    """Draw all files with all renderers, over black."""
    for drawn in files:
        drawn.images["kissgs"] = [render_clamped(drawn.splats, each, np.zeros(3), Context(0)) for each in cameras]
    x, y, z = files[0].splats.origin
    in_world = [camera.relative_to((-x, -y, -z)) for camera in cameras]
    try:
        with chromium() as browser:
            for name, endings in READ.items():
                with opened(name, browser, "?defaults") as (viewer, _):
                    for drawn in files:
                        ending = next((each for each in endings if drawn.name.endswith(f".{each}")), None)
                        if ending:
                            drawn.images[name] = viewer.draw(drawn.data, ending, in_world)[1]
    except pytest.skip.Exception as error:
        raise KissgsError(str(error)) from error


def rows(files: Sequence[Drawn]) -> Iterator[list[str | int]]:
    """Yield the head of the table, then a row for each file."""
    scene = files[0]
    yield ["file", "bytes", "share", *(f"{name} {metric}" for name in scene.images for metric in METRICS)]
    for drawn in files:
        cells: list[str | int] = [drawn.name, len(drawn.data), f"{len(drawn.data) / len(scene.data):.4f}"]
        for name, own in scene.images.items():
            wanted = scene.images["kissgs"] if drawn is scene else own
            images = drawn.images.get(name)
            cells += ["", "", ""] if images is None or images is wanted else quality(images, wanted)
        yield cells


def quality(images: Images, wanted: Images) -> list[str]:
    """Return the mean PSNR, the mean SSIM and the PSNR of the worst view, as text."""
    pairs = list(zip(images, wanted, strict=True))
    psnrs = [min(psnr(one, other), MAX_VIEW_PSNR) for one, other in pairs]
    return [f"{np.mean(psnrs):.2f}", f"{np.mean([ssim(one, other) for one, other in pairs]):.4f}", f"{min(psnrs):.2f}"]


def sheet_of(files: Sequence[Drawn]) -> bytes:
    """Return a PNG, of half the size, with a row for each camera and renderer: the scene, each file, and its error."""
    images, labels = list[np.ndarray](), list[Label]()
    for camera in range(len(files[0].images["kissgs"])):
        for name, own in files[0].images.items():
            images.append(as_bytes(own[camera]))
            labels.append(Label(f"{name}: scene"))
            for drawn in files[2:]:
                image = drawn.images[name][camera] if name in drawn.images else np.zeros_like(own[camera])
                difference = rms_difference(image.astype(np.float32), own[camera].astype(np.float32))
                images += [as_bytes(image), heat_map(difference, FULL_ERROR)]
                labels += [Label(f"{name}: {drawn.name}"), Label(f"error, 0 to {FULL_ERROR}")]
    small = [np.asarray(Image.fromarray(each).reduce(2)) for each in images]
    return png(contact_sheet(small, labels, columns=1 + 2 * len(files[2:])))


def as_bytes(image: np.ndarray) -> np.ndarray:
    """Return an image of 0 to 1 as 8-bit levels."""
    return np.rint(255 * image).astype(np.uint8)


if __name__ == "__main__":
    run(main)
