"""Simulated clusters as tables for the terminal. This module only formats."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Group, RenderableType
from rich.table import Column, Table
from rich.text import Text

from kissgs.benchmark.capacity import JobRun, Node, SceneRun
from kissgs.benchmark.streaming_costs import StreamingCosts
from kissgs.streaming.time_left import duration


def capacity_tables(
    costs: StreamingCosts, node: Node, scenes: Sequence[SceneRun], jobs: Sequence[JobRun]
) -> RenderableType:
    """Return tables of the measured costs, of large scenes on clusters of several sizes, and of days with many jobs."""
    return Group(
        Text("CPU seconds of a million Gaussians", style="bold"),
        _costs(costs),
        Text.assemble(
            ("\nOne streamed scene", "bold"),
            f": wall time, cost and limit, by nodes of {node.cpus} processors, {node.network_bytes * 8e-9:g} Gbit/s "
            f"and {node.dollars:g} $ an hour",
        ),
        _scenes(scenes),
        Text.assemble(
            ("\nA service", "bold"), f": jobs of {costs.gaussians:,} Gaussians, of which 95 % wait less than a minute"
        ),
        _jobs(jobs, node),
    )


def _costs(costs: StreamingCosts) -> Table:
    names = ("partition", "merge", "files, all levels", "one container")
    table = Table(*map(_right, names), box=None, pad_edge=False)
    levels = 2.0  # Gaussians of all levels for each of the finest
    per_million = (
        costs.partition_seconds,
        costs.merge_seconds,
        levels * costs.file_seconds,
        costs.container_seconds,
    )
    table.add_row(*(f"{value * 1e6:.1f}" for value in per_million))
    return table


def _scenes(runs: Sequence[SceneRun]) -> Table:
    nodes = list(dict.fromkeys(run.nodes for run in runs))
    table = Table(
        _right("Gaussians"),
        *(_right(f"{count} node{'s' if count > 1 else ''}") for count in nodes),
        _right("first image"),
        box=None,
        pad_edge=False,
    )
    for count in dict.fromkeys(run.gaussians for run in runs):
        own = [run for run in runs if run.gaussians == count]
        cells = [f"{duration(run.total_seconds)}, {run.dollars:.2f} $\n{run.limit}" for run in own]
        table.add_row(f"{count:,}", *cells, f"{own[0].first_bytes / 1e6:.2f} MB")
    return table


def _jobs(runs: Sequence[JobRun], node: Node) -> Table:
    heads = (
        "jobs a day",
        "nodes",
        "busy",
        "wait, 50 %",
        "95 %",
        "$ per 1,000",
        "service,\nCPUs",
        "uploads",
        "database",
    )
    table = Table(*map(_right, heads), box=None, pad_edge=False)
    for run in runs:
        table.add_row(
            f"{run.jobs_per_day:,.0f}",
            f"{run.nodes:,}",
            f"{run.busy:.0%}",
            f"{run.median_wait:.0f} s",
            f"{run.longest_wait:.0f} s",
            f"{run.nodes * node.dollars * 24 / run.jobs_per_day * 1000:.2f}",
            f"{run.front_cpus:.2f}",
            f"{run.upload_bytes / 1e6:,.0f} MB/s",
            f"{run.transactions:,.0f}/s",
        )
    return table


def _right(name: str) -> Column:
    return Column(name, justify="right")
