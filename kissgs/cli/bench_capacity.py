"""``kissgs bench capacity``."""

from __future__ import annotations

from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from kissgs.cli.arguments import PresetOption, SetOption
from kissgs.cli.bench_arguments import JsonOption, ThreadsOption
from kissgs.cli.bench_scenes import BenchInputs, BenchOutput, announce, open_inputs, report
from kissgs.cli.options import chosen
from kissgs.core.errors import UnsupportedError

if TYPE_CHECKING:
    from kissgs.benchmark.capacity import Node
    from kissgs.settings import Settings

NODES = (1, 4, 16, 64)
GAUSSIANS = (1_000_000, 10_000_000, 100_000_000, 1_000_000_000)
JOBS_PER_DAY = (1_000, 10_000, 100_000, 1_000_000)

WAIT_SECONDS = 60.0
"""Longest wait of 95 % of the jobs for which nodes are counted."""


def capacity(
    scene: Annotated[
        list[str] | None, typer.Argument(metavar="FILE", help="Scene to measure. Default: a sample scene.")
    ] = None,
    gaussians: Annotated[int, typer.Option(min=1, help="Number of Gaussians of the sample scene.")] = 1_048_576,
    degree: Annotated[int, typer.Option(min=0, max=3, help="Degree of the sample scene.")] = 3,
    preset: PresetOption = "balanced",
    changes: SetOption = None,
    cpus: Annotated[int, typer.Option(min=1, help="Processors of a node.")] = 16,
    network: Annotated[float, typer.Option(min=0.001, help="Gbit/s between a node and the storage.")] = 5.0,
    dollars: Annotated[float, typer.Option(min=0.0, help="Dollars for an hour of a node.")] = 0.6,
    plot: Annotated[Path | None, typer.Option(metavar="FILE", help="Plot the results as .svg, .png or .pdf.")] = None,
    threads: ThreadsOption = 0,
    as_json: JsonOption = False,
) -> None:
    """Measure what a Gaussian costs here, and simulate what clusters do with large scenes and many jobs."""
    inputs = open_inputs(scene or [], None, threads, plot)
    if len(inputs.scenes) > 1:
        raise UnsupportedError("bench capacity measures one scene; give one FILE")
    settings = chosen(preset, changes)
    from kissgs.benchmark.capacity import Node

    node = Node(cpus=cpus, network_bytes=network * 1e9 / 8, dollars=dollars)
    report(_measure(inputs, degree, gaussians, settings, node), as_json, plot)


def _measure(inputs: BenchInputs, degree: int, gaussians: int, settings: Settings, node: Node) -> BenchOutput:
    from kissgs.benchmark.capacity import JobCosts, needed_nodes, simulate_scene
    from kissgs.benchmark.capacity_plot import capacity_plot
    from kissgs.benchmark.streaming_costs import measure_costs
    from kissgs.cli.capacity_tables import capacity_tables
    from kissgs.cli.console import progress_bar

    with progress_bar(False) as progress:
        costs = measure_costs(
            inputs.scenes[0] if inputs.scenes else degree,
            settings,
            gaussians,
            inputs.threads,
            announce=announce,
            progress=progress,
        )
        progress("simulate", 0.0)
        scenes = [simulate_scene(costs, node, nodes, count) for count in GAUSSIANS for nodes in NODES]
        job = JobCosts(
            seconds=costs.container_seconds * costs.gaussians, upload_bytes=costs.source_bytes * costs.gaussians
        )
        jobs = [needed_nodes(job, node, per_day, WAIT_SECONDS) for per_day in JOBS_PER_DAY]
    return BenchOutput(
        rows=[
            {"costs": costs.as_dict(), "node": asdict(node)},
            *({**asdict(run), "limit": run.limit} for run in scenes),
            *(asdict(run) for run in jobs),
        ],
        table=capacity_tables(costs, node, scenes, jobs),
        draw=partial(capacity_plot, node, scenes, jobs),
    )
