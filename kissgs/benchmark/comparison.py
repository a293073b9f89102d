"""Presets and other tools on one scene: bytes, times, memory and likeness, each measured in a process of its own."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from kissgs.benchmark.bd_rate import at_fidelity
from kissgs.benchmark.external_codecs import SPLAT_TRANSFORM, PeerResult, check_peer, measure_peer
from kissgs.benchmark.render_speed import resampled
from kissgs.benchmark.results import Measured, Run
from kissgs.benchmark.roundtrip import isolated_roundtrip
from kissgs.cameras.views import Views
from kissgs.core.errors import KissgsError
from kissgs.core.progress import Progress, silent
from kissgs.pipeline.scene_files import load, save
from kissgs.settings import Settings

PATIENCE = 60.0
"""Seconds: what takes a peer longer is not repeated."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """What to measure.

    Attributes:
        presets: as they are, each ``repeats`` times.
        curved: presets that weigh bits, once at every quality_offset_db.
        fidelities: settings of that name.
        peers: formats.
        command: how to start splat-transform.
        sog_iterations: of ``.sog``'s SH clustering; None leaves the tool's default.
        repeats: 1 or more.
        pictures: whether they are compared.
        views: a capture, whose cameras weigh bits and whose held-out views are compared.
        threads: 0 means one per processor.
    """

    presets: Sequence[Settings]
    curved: Sequence[Settings] = ()
    fidelities: Sequence[float] = ()
    peers: Sequence[str] = ()
    command: Sequence[str] = SPLAT_TRANSFORM
    sog_iterations: int | None = None
    repeats: int = 1
    pictures: bool = False
    views: Views | None = None
    threads: int = 0


def compare(
    scene: Path, plan: Plan, *, failed: Callable[[str], None] | None = None, progress: Progress = silent
) -> list[Measured]:
    """Measure all that is planned on one scene: presets, then points of curves, then peers.

    Args:
        scene: a ``.ply``.
        plan: what.
        failed: told of a peer that fails, which then ends nothing: all else has taken long to find.
        progress: receives "measure", with what is measured as a note.

    Raises:
        InvalidSceneError: the scene, or what a peer made of it, cannot be read.
        UnsupportedError: a peer is missing, or fails and there is nobody to tell; a measurement was killed.
    """
    for peer in plan.peers:
        check_peer(peer, plan.command)
    points = [(at_fidelity(settings, value), value) for settings in plan.curved for value in plan.fidelities]
    jobs: list[tuple[str, Callable[[], Measured]]] = [
        *((settings.preset, lambda s=settings: _preset(scene, s, None, plan)) for settings in plan.presets),
        *((at.preset, lambda at=at, value=value: _preset(scene, at, value, plan)) for at, value in points),
        *((peer, lambda peer=peer: _peer(scene, peer, plan)) for peer in plan.peers),
    ]
    rows = []
    for done, (name, job) in enumerate(jobs):
        progress("measure", done / len(jobs), name)
        try:
            rows.append(job())
        except KissgsError as error:
            if failed is None or name not in plan.peers:
                raise
            failed(str(error))
    return rows


def growth(scene: Path, counts: Sequence[int], plan: Plan, *, progress: Progress = silent) -> list[Measured]:
    """Compare on the scene made larger or smaller (:func:`kissgs.benchmark.render_speed.resampled`), at each count."""
    splats = load(scene, threads=plan.threads, progress=progress)
    rows = []
    with tempfile.TemporaryDirectory(prefix="kissgs-bench-") as folder:
        for count in counts:
            path = Path(folder, scene.name).with_suffix(".ply")
            save(resampled(splats, count), path, overwrite=True)
            rows += compare(path, plan, progress=progress)
    return rows


def _preset(scene: Path, settings: Settings, quality_offset_db: float | None, plan: Plan) -> Measured:
    """Pictures of equal containers are equal, so they are taken once; points of a curve are about bytes, not times."""
    repeats = plan.repeats if quality_offset_db is None else 1
    results = [
        isolated_roundtrip(
            *(scene, settings), pictures=plan.pictures and not number, views=plan.views, threads=plan.threads
        )
        for number in range(repeats)
    ]
    first = results[0]
    return Measured(
        scene=scene.name,
        encoder=str(settings.preset),
        quality_offset_db=quality_offset_db,
        gaussians=first.report.source_count,
        file_bytes=first.report.file_bytes,
        runs=tuple(map(Run.of, results)),
        errors=first.errors,
        pictures=first.pictures,
        details=first.as_dict(),
    )


def _peer(scene: Path, peer: str, plan: Plan) -> Measured:
    """As often as presets, if it is quick."""

    def measure(pictures: bool) -> PeerResult:
        iterations = plan.sog_iterations if peer == "sog" else None
        return measure_peer(
            *(scene, peer),
            command=plan.command,
            sh_iterations=iterations,
            pictures=pictures,
            views=plan.views,
        )

    first = measure(plan.pictures)
    quick = first.encode_seconds + first.decode_seconds <= PATIENCE
    results = [first, *(measure(False) for _ in range(1, plan.repeats if quick else 1))]
    return Measured(
        scene=scene.name,
        encoder=peer,
        gaussians=first.gaussians,
        file_bytes={peer: first.bytes},
        runs=tuple(map(Run.of, results)),
        errors=first.errors,
        pictures=first.pictures,
        details=first.as_dict(),
    )
