"""Plot of simulated clusters: large scenes over the number of nodes, and nodes over the number of jobs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from kissgs.benchmark.capacity import JobRun, Node, SceneRun
from kissgs.benchmark.plots import MARKERS, new_figure


def capacity_plot(node: Node, scenes: Sequence[SceneRun], jobs: Sequence[JobRun], path: Path) -> None:
    """Plot the wall time of each scene over the number of nodes, and what a service needs over its jobs a day.

    Args:
        node: one of the nodes.
        scenes: streamed scenes on clusters.
        jobs: days of a service.
        path: file to write, ``.svg``, ``.png`` or ``.pdf``; overwritten.

    Raises:
        OutputError: the file cannot be written.
        UnsupportedError: matplotlib is not installed, or the format is unknown.
    """
    with new_figure(path, 10, 4.8) as figure:
        left, right = figure.subplots(1, 2)
        for marker, count in zip(MARKERS, dict.fromkeys(run.gaussians for run in scenes), strict=False):
            own = [run for run in scenes if run.gaussians == count]
            nodes, minutes = [run.nodes for run in own], [run.total_seconds / 60 for run in own]
            (line,) = left.plot(nodes, minutes, marker=marker, label=f"{count / 1e6:,.0f} million Gaussians")
            serial = [(run.seconds["partition"] + run.seconds["cameras"]) / 60 for run in own]
            left.plot(nodes, serial, linestyle=":", color=line.get_color())
        left.set(xscale="log", yscale="log", xlabel=f"nodes of {node.cpus} processors", ylabel="minutes")
        left.set_xticks(sorted({run.nodes for run in scenes}), [str(n) for n in sorted({run.nodes for run in scenes})])
        left.plot([], [], linestyle=":", color="black", label="of these, one process")
        per_day = [run.jobs_per_day for run in jobs]
        right.plot(per_day, [run.nodes * node.cpus for run in jobs], marker="o", label="processors for jobs")
        right.plot(per_day, [run.front_cpus for run in jobs], marker="s", label="processors of the service")
        right.plot(per_day, [run.upload_bytes / 1e6 for run in jobs], marker="^", label="uploads, MB/s")
        right.plot(per_day, [run.transactions for run in jobs], marker="D", label="transactions per second")
        right.set(xscale="log", yscale="log", xlabel="jobs a day")
        for axes in (left, right):
            axes.minorticks_off()
            axes.grid(alpha=0.3)
            axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=2, fontsize="small", frameon=False)
