"""Steps that turn a scene into a streamed scene: partition, levels of a chunk, one file, the manifest."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from kissgs._version import __version__
from kissgs.cameras.captures.transforms_json import camera_as_dict, read_cameras
from kissgs.cameras.views import black
from kissgs.cameras.virtual.samples import MAX_VIEWS, default_view_count, sensitivity_cameras
from kissgs.core.array_types import Float32
from kissgs.core.context import Context, Progress, silent
from kissgs.core.positions import STREAMED_REMEDY, WORLD, Cuts, cuts_without_coarse, recorded, visible_sizes
from kissgs.core.sensitivity import Sensitivity
from kissgs.core.splats import Splats, clean, concatenate, sampled_rows
from kissgs.formats import ContainerName
from kissgs.io.containers import write_container
from kissgs.pipeline.encoding import VIEW_UNCERTAINTY, model_of, write_files
from kissgs.pipeline.scene_files import reading_notes
from kissgs.planning.planner import plan_encoding, visible_gaussians
from kissgs.rendering.camera import Camera
from kissgs.rendering.sensitivity import WeightedCameras, measure_sensitivity
from kissgs.settings import EncodeSettings
from kissgs.sogxt import FORMAT_NAME
from kissgs.streaming import work_folder as scratch
from kissgs.streaming.levels import Environment, chunk_levels, times_to_halve
from kissgs.streaming.work_folder import ContainerFile, Layout

# Settings of the files of a level.

COARSER_DB = 6.0  # decibels by which coarser levels are encoded less accurately, with rate-distortion planning
COARSER_STEPS = 1.6  # of levels of SH degree 0, in units of the finest level's, without rate-distortion planning


def file_settings(settings: EncodeSettings, level: int, sh_degree: int) -> EncodeSettings:
    """Return the settings of the files of a level. Classes of steps would have an order of their own within each leaf,
    which costs 5 % of the bytes. Merging has a larger error than the finest level's encoding, so coarser levels are
    less accurate (docs/method/streaming.md)."""
    settings = settings.model_copy(update={"step_classes": 1})
    if level == 0:
        return settings
    if settings.rate_distortion:
        return settings.model_copy(update={"quality_offset_db": settings.quality_offset_db - COARSER_DB})
    changes = {"means_tolerance": min(1.0, 2 * settings.means_tolerance)}
    if sh_degree > 0:
        changes["gaussians_per_codebook_entry"] = min(4096.0, 2 * settings.gaussians_per_codebook_entry)
    else:
        steps = ("opacity_step", "scale_step", "quat_step", "sh0_step")
        changes |= {name: COARSER_STEPS * getattr(settings, name) for name in steps}
    return settings.model_copy(update=changes)


# Sensitivity of the files of a streamed scene.
#
# All cameras see the whole scene: the Gaussians of the file as they are, those of other chunks from a coarse level.

VIEWS_PER_CHUNK, MOST_VIEWS = 2, 1024
"""Least number of cameras per chunk, because a large scene needs more than the default, which falls with its size; and
the largest number of all cameras, whose choice would take hours."""

MIN_SIZE = 64  # smallest side of the images in which coarse levels are measured, pixels
REACH = 1.3  # size of the image in which a sampled Gaussian counts as seen, in units of the image's


def measure_file(
    splats: Splats,
    others: Splats,
    cameras: Sequence[Camera],
    level: int,
    settings: EncodeSettings,
    threads: int,
    progress: Progress = silent,
) -> Sensitivity:
    """Measure the sensitivity of the Gaussians of a file; ``others`` stand for the rest of the scene. A level of half
    the Gaussians is meant for images of half the size."""
    size = max(MIN_SIZE, settings.sensitivity_view_size >> level)
    shown = [_shown(camera, splats) for camera in cameras]
    best = sorted(np.argsort(np.negative(shown), kind="stable")[:MAX_VIEWS])  # else each file would take more and more
    seeing = [cameras[n].at_most(size) for n in best if shown[n] > 0]
    if not seeing:
        return Sensitivity.none(len(splats), splats.sh_degree)
    uncertainty = VIEW_UNCERTAINTY[False] if settings.view_uncertainty is None else settings.view_uncertainty
    whole, weighted = concatenate([splats, others]), WeightedCameras(seeing, [1.0] * len(seeing), black())
    found = measure_sensitivity(whole, weighted, view_uncertainty=uncertainty, threads=threads, progress=progress)
    arrays = [field.name for field in fields(Sensitivity) if field.name != "view_uncertainty"]
    own = replace(found, **{name: getattr(found, name)[: len(splats)] for name in arrays})
    share = np.float32(len(seeing) / len(cameras))  # the mean is over the images of all cameras
    for values in (own.position_hessian, own.shape_hessian, own.color_weight, own.prior):
        values *= share
    return own


def _shown(camera: Camera, splats: Splats) -> float:
    """Return how large sampled Gaussians in the image, or a little outside, appear in it; 0 if there is none."""
    points = splats.means[:: max(1, len(splats) // 4096)].astype(np.float64) @ camera.viewmat[:3, :3].T
    points += camera.viewmat[:3, 3]
    ahead = points[points[:, 2] > 0]
    pixels = ahead[:, :2] / ahead[:, 2:] * camera.K[[0, 1], [0, 1]]
    inside = (np.abs(pixels) < REACH / 2 * np.array([camera.width, camera.height])).all(axis=1)
    return float(np.square(camera.K[0, 0] / ahead[inside, 2]).sum())


# The steps. Every one reads and writes files of the work folder, and the last file that it writes marks it as done. So
# interrupted work goes on where it was, and steps may run in any process that sees the folder.

Blocks = Callable[[], Iterable[Splats]]  # function that reads the scene from its beginning, some Gaussians at a time
CHUNK = 400_000  # largest number of Gaussians in a chunk, but for the scatter of estimated medians

LEAF, MOST_ENTRIES = 32_768, 4096
"""Largest number of Gaussians in a leaf; and about that of leaves times levels, because the manifest takes about 105
bytes for each level of each leaf, before the first image: large scenes have larger leaves."""

UNEVEN = 1.1  # ratio of the largest to the mean size of chunks: their cuts are medians of a sample
COARSEST = 50_000  # Gaussians at most in the coarsest level, which with the manifest makes the first image


def partition(
    work: Path,
    blocks: Blocks,
    count: int,
    container: ContainerName,
    settings: EncodeSettings,
    progress: Progress = silent,
) -> Layout:
    """Split a scene of ``count`` Gaussians before cleaning into chunks, one file of rows each, in two passes."""
    done = visible_count = 0
    origin = WORLD

    def visible_blocks() -> Iterator[tuple[Splats, dict[str, int]]]:
        """Yield what is visible of each block, and the numbers of Gaussians that were changed or left out."""
        nonlocal done
        for block in blocks():
            splats, cleaned = clean(block)
            visible = visible_gaussians(splats, settings)
            yield splats.select(visible), {**cleaned.as_dict(), "invisible": len(splats) - len(visible)}
            done += len(block)
            progress("partition", done / (2 * count))

    def places_and_sizes() -> Iterator[Float32[np.ndarray, "n 4"]]:
        nonlocal visible_count
        for splats, _ in visible_blocks():
            visible_count += len(splats)
            yield np.column_stack([splats.means, visible_sizes(splats.scales).astype(np.float32)])

    sample = sampled_rows(places_and_sizes(), count)
    environment = Environment.of(sample[:, :3], visible_count)
    sample = sample[~environment.contains(sample[:, :3])]
    cuts = Cuts.of(sample[:, :3], times_to_halve(count, CHUNK))
    if container == "sog":  # which has a range of each axis
        cuts = cuts_without_coarse(sample, cuts, count)
    for part in (scratch.ENVIRONMENT, *range(cuts.chunks)):
        scratch.gaussians_file(work, part).unlink(missing_ok=True)
    notes: tuple[str, ...] = ()
    far_count, counts, sh_degree, changed = 0, np.zeros(cuts.chunks, np.int64), 0, Counter[str]()
    antialiased = False
    for splats, removed in visible_blocks():
        notes = tuple(dict.fromkeys([*notes, *reading_notes(splats)]))
        changed.update(removed)
        sh_degree, antialiased = splats.sh_degree, splats.antialiased
        far = environment.contains(splats.means)
        scratch.append_rows(scratch.gaussians_file(work, scratch.ENVIRONMENT), scratch.to_rows(splats.select(far)))
        far_count, splats, origin = far_count + int(far.sum()), splats.select(~far), splats.origin
        chunks = cuts.chunk_of(splats.means)
        rows = scratch.to_rows(splats)
        for chunk in np.unique(chunks):
            some = rows[chunks == chunk]
            scratch.append_rows(scratch.gaussians_file(work, int(chunk)), some)
            counts[chunk] += len(some)
    total = int(counts.sum())
    levels = 1 + times_to_halve(total, COARSEST)
    parts = 1 << (max(1, MOST_ENTRIES // (levels * cuts.chunks)).bit_length() - 1)  # chunks are halved until it fits
    layout = Layout(
        container=container,
        source_count=count,
        sh_degree=sh_degree,
        counts=tuple(map(int, counts)),
        depth=cuts.depth,
        levels=levels,
        leaf=max(LEAF, math.ceil(UNEVEN * total / (cuts.chunks * parts))),
        environment=far_count,
        changed=dict(changed),
        notes=notes,
        origin=origin,
        antialiased=antialiased,
    )
    scratch.sync(scratch.gaussians_file(work, scratch.ENVIRONMENT))
    for chunk in layout.filled:
        scratch.sync(scratch.gaussians_file(work, chunk))
    return layout


def make_levels(work: Path, layout: Layout, chunk: int, threads: int, progress: Progress = silent) -> None:
    """Merge a chunk into its levels, one file of rows each; ``progress`` receives "merge"."""
    chunk_splats = scratch.read_gaussians(work, layout, [chunk])
    levels, leaves = chunk_levels(chunk_splats, layout.levels, layout.leaf, threads, progress)
    for level, merged in enumerate(levels):
        scratch.write_rows(scratch.gaussians_file(work, chunk, level), scratch.to_rows(merged))
    scratch.write_json(scratch.leaves_file(work, chunk), leaves)
    scratch.gaussians_file(work, chunk).unlink(missing_ok=True)


def make_cameras(work: Path, layout: Layout, settings: EncodeSettings, threads: int) -> None:
    """Choose the cameras that sensitivity is measured with, and write them to a file."""
    coarsest = concatenate(
        [
            scratch.read_gaussians(work, layout, layout.filled, layout.levels - 1),
            scratch.read_gaussians(work, layout, [scratch.ENVIRONMENT]),
        ]
    )
    total = sum(layout.counts) + layout.environment
    least = min(MOST_VIEWS, VIEWS_PER_CHUNK * len(layout.filled))
    views = settings.sensitivity_views or max(default_view_count(total, captured=False), least)
    size = settings.sensitivity_view_size
    cameras, view = sensitivity_cameras(coarsest, None, Context(threads), count=views, size=size)
    scratch.write_json(work / scratch.VIEW, view)  # before the cameras, which mark this step as done
    scratch.write_json(work / scratch.CAMERAS, [camera_as_dict(camera) for camera in cameras.cameras])


def make_file(
    work: Path, layout: Layout, settings: EncodeSettings, file: ContainerFile, threads: int, progress: Progress = silent
) -> None:
    """Write a container; ``settings`` are those of the finest level, ``progress`` receives stages of the encoder."""
    if file.name == scratch.ENVIRONMENT:
        splats = scratch.read_gaussians(work, layout, [scratch.ENVIRONMENT])
        counts = [len(splats)]
    else:
        splats = scratch.read_gaussians(work, layout, file.chunks, file.level)
        counts = [count for chunk in file.chunks for count in scratch.read_leaves(work, chunk)["counts"][file.level]]
    groups = np.repeat(np.arange(len(counts)), counts).astype(np.uint16)
    settings = file_settings(settings, file.level, layout.sh_degree)
    stored: dict[str, Any] = {"counts": [0] * len(counts), "note": ""}
    if len(visible_gaussians(splats, settings)):  # merging may have made all of them invisible
        sensitivity = None
        if settings.rate_distortion:
            rest = [chunk for chunk in layout.filled if chunk not in file.chunks]
            others = [scratch.read_gaussians(work, layout, rest, layout.context)]
            if file.name != scratch.ENVIRONMENT:
                others.append(scratch.read_gaussians(work, layout, [scratch.ENVIRONMENT]))
            cameras = [view.camera for view in read_cameras(work / scratch.CAMERAS)]
            sensitivity = measure_file(splats, concatenate(others), cameras, file.level, settings, threads, progress)
            del others
        context = Context(threads, progress=progress)
        plan = plan_encoding(
            splats,
            settings,
            context,
            sensitivity=sensitivity,
            container=model_of(layout.container),
            groups=groups,
            keep_costs=False,
        )
        del sensitivity, splats
        encoded = write_files(layout.container, plan, settings, context)
        write_container(encoded.files, work / scratch.OUT / layout.path(file.name), overwrite=True)
        rows = np.bincount(groups[encoded.order], minlength=len(counts)).tolist()
        stored = {"counts": rows, "note": encoded.coarse}
    scratch.write_json(scratch.rows_file(work, file.name), stored)
    if file.level != layout.context:
        for chunk in file.chunks:
            scratch.gaussians_file(work, chunk, file.level).unlink(missing_ok=True)


def coarse_note(work: Path, layout: Layout) -> str:
    """Return the note of the first file of the finest level whose positions are coarse; else an empty string."""
    notes = (scratch.read_counts(work, file.name)["note"] for file in layout.files() if not file.level)
    note = next(filter(None, notes), "")
    return note.removesuffix(f": {STREAMED_REMEDY}") if layout.container == "sog" else note


def make_manifest(work: Path, layout: Layout) -> None:
    """Write the manifest: a tree over space, whose leaves name their rows in the files of each level."""
    lods: dict[tuple[int, int], dict[int, dict[str, int]]] = {}
    filenames, totals = list[str](), [0] * layout.levels
    leaves_of = {chunk: scratch.read_leaves(work, chunk) for chunk in layout.filled}
    for file in layout.files():
        offset = 0
        own = [(chunk, leaf) for chunk in file.chunks for leaf in range(len(leaves_of[chunk]["bounds"]))]
        for leaf_of_chunk, count in zip(own, scratch.read_counts(work, file.name)["counts"], strict=True):
            if count:
                rows = {"file": len(filenames), "offset": offset, "count": count}
                lods.setdefault(leaf_of_chunk, {})[file.level] = rows
            offset += count
        if offset:
            filenames.append(layout.entry(file.name))
        totals[file.level] += offset
    leaves = []
    for chunk, own_leaves in leaves_of.items():
        for leaf, (corners, errors) in enumerate(zip(own_leaves["bounds"], own_leaves["errors"], strict=True)):
            if (chunk, leaf) in lods:  # some Gaussian of it is visible
                low, high = ([float(f"{value:.7g}") for value in corner] for corner in corners)
                levels = {str(level): rows for level, rows in sorted(lods[chunk, leaf].items())}
                leaves.append({"bound": {"min": low, "max": high}, "lods": levels, "errors": errors})
    view = json.loads((work / scratch.VIEW).read_bytes()) if (work / scratch.VIEW).exists() else None
    has_environment = (work / scratch.OUT / layout.path(scratch.ENVIRONMENT)).exists()
    document = {
        "version": 1,
        **({"format": FORMAT_NAME} if layout.container == "sogxt" else {}),
        "asset": {"generator": f"kissgs {__version__}"},
        **({"kissgs": facts} if (facts := recorded(layout.origin, view)) else {}),
        "count": totals[0],
        "counts": totals,
        "lodLevels": layout.levels,
        "lodErrors": True,
        **({"environment": layout.entry(scratch.ENVIRONMENT)} if has_environment else {}),
        "filenames": filenames,
        "tree": _node(leaves),
    }
    scratch.write_json(work / scratch.OUT / layout.manifest, document)


def _node(leaves: list[dict[str, Any]]) -> dict[str, Any]:
    """Return a leaf, or a node with two halves of the leaves."""
    if len(leaves) == 1:
        return leaves[0]
    middle = len(leaves) // 2
    children = [_node(leaves[:middle]), _node(leaves[middle:])]
    low, high = (
        [pick(pair) for pair in zip(*(child["bound"][end] for child in children), strict=True)]
        for end, pick in (("min", min), ("max", max))
    )
    return {"bound": {"min": low, "max": high}, "children": children}
