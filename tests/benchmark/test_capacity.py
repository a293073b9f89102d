"""Simulated clusters. Oracles: schedules and queues with known solutions, and bounds that hold for every schedule."""

import itertools
import math

import numpy as np
import pytest

from kissgs.benchmark import capacity
from kissgs.benchmark.capacity import JobCosts, Node, makespan, needed_nodes, queue_waits, simulate_jobs, simulate_scene
from kissgs.benchmark.streaming_costs import StreamingCosts, measure_costs
from kissgs.settings import Settings
from kissgs.streaming import build

NODE = Node(cpus=4, network_bytes=1e9, dollars=0.5)
COSTS = StreamingCosts(
    gaussians=1_000_000,
    partition_seconds=1e-6,
    merge_seconds=18e-6,
    camera_seconds=0.0,
    file_seconds=11e-6,
    container_seconds=10e-6,
    source_bytes=248.0,
    file_bytes=11.0,
)


def test_items_of_equal_length_fill_the_slots_in_rounds():
    for count, slots in itertools.product((0, 1, 5, 12, 13), (1, 3, 4, 20)):
        assert makespan([2.0] * count, slots) == 2.0 * math.ceil(count / slots)


def test_items_start_in_order_where_a_slot_is_free_first():
    assert makespan([5, 1, 1, 1, 4], 2) == 7  # 5 on one slot; 1, 1, 1 and 4 on the other
    assert makespan([4, 5, 1, 1, 1], 2) == 6


@pytest.mark.parametrize(("slots", "load"), [(1, 0.5), (1, 0.8), (3, 0.7)])
def test_waits_of_a_queue_are_those_of_erlang(slots, load):
    """Mean wait of a queue with exponential times (Erlang C)."""
    random = np.random.default_rng(5)
    count, mean = 400_000, 2.0
    arrivals = np.cumsum(random.exponential(mean / (slots * load), count))
    waits = queue_waits(arrivals, random.exponential(mean, count), slots)
    offered = slots * load
    last = offered**slots / math.factorial(slots) / (1 - load)
    waiting = last / (sum(offered**k / math.factorial(k) for k in range(slots)) + last)
    assert waits.mean() == pytest.approx(waiting * mean / (slots - offered), rel=0.06)
    assert np.mean(waits > 0) == pytest.approx(waiting, rel=0.03)


def test_a_scene_is_within_the_bounds_of_every_schedule():
    for gaussians, nodes in itertools.product((100_000, 20_000_000, 10**9), (1, 4, 64)):
        run = simulate_scene(COSTS, NODE, nodes, gaussians)
        work = gaussians * COSTS.merge_seconds
        assert run.seconds["merge"] >= work / (nodes * NODE.cpus)
        assert run.seconds["merge"] >= min(gaussians, build.CHUNK / 2) * COSTS.merge_seconds
        assert run.seconds["partition"] == pytest.approx(gaussians * (1e-6 + 3 * 248e-9))
        assert run.dollars == pytest.approx(nodes * 0.5 * run.total_seconds / 3600)
        slower = simulate_scene(COSTS, Node(cpus=4, network_bytes=1e7, dollars=0.5), nodes, gaussians)
        assert slower.total_seconds > run.total_seconds


def test_more_nodes_are_faster_until_the_partition_remains():
    runs = [simulate_scene(COSTS, NODE, nodes, 10**8) for nodes in (1, 4, 16, 64, 10_000)]
    assert [run.limit for run in (runs[0], runs[-1])] == ["processors", "partition"]
    assert all(b.total_seconds <= a.total_seconds for a, b in itertools.pairwise(runs))
    assert simulate_scene(COSTS, Node(cpus=4, network_bytes=1e6, dollars=0), 1, 10**6).limit in ("network", "partition")


def test_the_first_image_takes_the_coarsest_level_and_the_manifest_of_all_leaves():
    """512 leaves of 10 levels gave 535,211 bytes; 64 chunks have four leaves each now."""
    expected = 535_211 * 256 / 512 + 40_960 * COSTS.file_bytes
    assert simulate_scene(COSTS, NODE, 1, 20_971_520).first_bytes == pytest.approx(expected, rel=0.03)


def test_jobs_beyond_the_processors_wait_and_more_nodes_end_it(monkeypatch):
    monkeypatch.setattr(capacity, "JOBS", 4000)
    costs = JobCosts(seconds=60.0, upload_bytes=248e6)
    per_day = 86_400 / 60 * NODE.cpus * 3.0  # three nodes' worth
    full = simulate_jobs(costs, NODE, 2, per_day)
    assert full.busy > 1
    assert full.longest_wait > 3600
    run = needed_nodes(costs, NODE, per_day, 60.0)
    assert 3 < run.nodes < 7
    assert run.longest_wait <= 60 < simulate_jobs(costs, NODE, run.nodes - 1, per_day).longest_wait
    assert run == simulate_jobs(costs, NODE, run.nodes, per_day)
    assert run.upload_bytes == pytest.approx(per_day / 86_400 * 248e6)


def test_costs_are_measured():
    said, events = list[str](), []
    costs = measure_costs(
        1,
        Settings.from_preset("fast"),
        3000,
        announce=said.append,
        progress=lambda *event: events.append((*said, event)),
    )
    assert [event[-1][::2] for event in events] == [("measure", "sample scene"), ("measure", "3,000 Gaussians")]
    assert all(len(event) == 2 for event in events)  # announced before any work
    assert costs.gaussians == 3000
    assert costs.source_bytes == pytest.approx(4 * (17 + 9), rel=0.01)
    assert costs.camera_seconds == 0.0
    assert min(costs.partition_seconds, costs.merge_seconds, costs.file_seconds, costs.container_seconds) > 0
    assert 5 < costs.file_bytes < 100
