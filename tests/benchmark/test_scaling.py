"""Scenes at several sizes: reference are the sample scenes themselves, and processes that end themselves."""

import os
import shutil
import signal
import sys
import tempfile
import threading
import time
from collections import namedtuple
from functools import partial

import pytest
from helpers.benchmark_rows import measured

import kissgs
from kissgs import UnsupportedError
from kissgs.benchmark import scaling
from kissgs.benchmark.comparison import BenchmarkPlan
from kissgs.benchmark.isolation import isolated
from kissgs.benchmark.results import Measurement
from kissgs.benchmark.scaling import FailedMeasurement, check_space, measure_scaling
from kissgs.settings import Settings

PLAN = BenchmarkPlan(presets=[Settings.from_preset("fast")], errors=False)


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """Return the folder of temporary files, empty at first."""
    path = tmp_path / "temporary"
    path.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(path))
    return path


@pytest.fixture
def same_process(monkeypatch):
    """Make scenes in this process, which is faster."""
    monkeypatch.setattr(scaling, "isolated", lambda work, what: work())


@pytest.mark.quick(0)
def test_sample_scenes_are_measured_one_at_a_time_and_removed(folder):
    announced, notes, sizes = [], [], []
    rows = measure_scaling(
        1, [300, 100], PLAN, announce=announced.append, progress=lambda *event: notes.append(event[2])
    )
    for row in rows:
        sizes.append([path.stat().st_size for path in folder.rglob("*.ply")])
        assert (row.scene, row.name, row.errors) == ("sample, degree 1", "fast", None)
        expected = kissgs.compress(kissgs.sample_scene(row.gaussians, sh_degree=1), settings=PLAN.presets[0])
        assert row.bytes == len(expected.to_zip())
        assert row.float32_bytes == kissgs.sample_scene(row.gaussians, sh_degree=1).nbytes
        run = row.median_run
        assert set(run.stage_cpu_seconds) == set(run.stage_seconds) == set(run.stage_peak_memory) - {"decode"}
        assert run.peak_memory == max(run.stage_peak_memory.values())
    assert [len(each) for each in sizes] == [1, 1]
    assert 300 * (23 + 3) * 4 < sizes[0][0] < 300 * (23 + 3) * 4 + 2000, "the announced size is that of the file"
    assert "up to 300 Gaussians, 0.0 MB" in announced[0]
    assert str(folder) in announced[0]
    assert notes == ["scene of 300", "fast, 300", "scene of 100", "fast, 100"]
    assert list(folder.iterdir()) == []


def test_a_failure_is_a_row_and_the_others_are_measured(monkeypatch, same_process):
    def planned(path, plan):
        def fails():
            raise UnsupportedError("the measurement was killed")

        def runs_out():
            raise MemoryError("Unable to allocate 9 GiB")

        return [("fast", partial(measured, "fast", 9, 30.0)), ("small", fails), ("spz", runs_out)]

    monkeypatch.setattr(scaling, "measurements", planned)
    plan = BenchmarkPlan(presets=(), external_codecs=["spz"], splat_transform=[sys.executable])
    rows = list(measure_scaling(0, [10, 20], plan))
    assert [type(row) for row in rows] == [Measurement, FailedMeasurement, FailedMeasurement] * 2
    assert rows[4].as_dict() == {
        "scene": "sample, degree 0",
        "codec": "small",
        "gaussians": 20,
        "failure": "the measurement was killed",
    }
    assert (rows[5].codec, rows[5].failure) == ("spz", "not enough memory: Unable to allocate 9 GiB")


def test_a_scene_that_cannot_be_made_is_a_row(tmp_path, same_process):
    rows = list(measure_scaling(tmp_path / "none.ply", [10], PLAN))
    assert [(row.scene, row.codec, row.gaussians) for row in rows] == [("none.ply", "fast", 10)]
    assert "there is no such file" in rows[0].failure


def test_a_full_disk_is_refused_before_the_first_scene(folder, monkeypatch):
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage(10**10, 10**10 - 10**6, 10**6))
    assert check_space(folder, 14_000, 0, converted=False) == 14_000 * 17 * 4
    with pytest.raises(
        UnsupportedError, match=r"14,000 Gaussians of degree 0 need 3 MB in .* has 1 MB free; measure fewer"
    ):
        check_space(folder, 14_000, 0, converted=True)
    with pytest.raises(UnsupportedError, match="TMPDIR"):
        next(measure_scaling(3, [100, 10**6], PLAN))
    assert list(folder.iterdir()) == []


@pytest.mark.quick(0)
def test_a_killed_process_is_an_error():
    with pytest.raises(UnsupportedError, match=r"s\.ply: the measurement was killed, most likely for lack of memory"):
        isolated(partial(os._exit, 1), "s.ply")


@pytest.mark.quick(0)
def test_an_interrupt_does_not_wait_for_the_process(monkeypatch):
    """A signal that arrives during the work ends both processes: the work takes ten minutes."""

    class Interrupt(BaseException):
        pass

    def interrupt(number, frame):
        raise Interrupt

    old = signal.signal(signal.SIGUSR1, interrupt)
    timer = threading.Timer(3, os.kill, (os.getpid(), signal.SIGUSR1))
    timer.start()
    try:
        begin = time.monotonic()
        with pytest.raises(Interrupt):
            isolated(partial(time.sleep, 600), "sleep")
        assert time.monotonic() - begin < 300
    finally:
        timer.cancel()
        signal.signal(signal.SIGUSR1, old)


def peaks():
    """Return the peak of this process at its start, with 64 MB held, and after these are free and the peak is reset."""
    from kissgs.core.timing import peak_memory, reset_peak_memory

    first = peak_memory()
    held = b"x" * 2**26
    second = peak_memory()
    del held
    reset_peak_memory()
    return first, second, peak_memory()


@pytest.mark.quick(0)
@pytest.mark.skipif(sys.platform != "linux", reason="other systems cannot reset the peak")
def test_the_peak_of_a_process_is_its_own_and_can_begin_anew():
    held = b"x" * 2**29
    first, second, third = isolated(peaks, "peaks")
    assert first < len(held), "Linux counts the memory of the parent in getrusage"
    assert second >= first + 2**25
    assert third <= second - 2**25


@pytest.mark.skipif(sys.platform != "linux", reason="other systems cannot reset the peak")
def test_the_peak_of_a_stage_is_its_own():
    from kissgs.benchmark.stage_resources import StageResources

    events = []
    clock = StageResources(lambda *event: events.append(event))
    clock("large", 0.0)
    held = b"x" * 2**28
    clock("large", 1.0, "a note")
    del held
    clock("small", 0.0)
    clock.stop()
    assert events == [("large", 0.0), ("large", 1.0, "a note"), ("small", 0.0)]
    assert clock.peak_memory["large"] >= clock.peak_memory["small"] + 2**27
    assert all(seconds >= 0 for seconds in clock.cpu_seconds.values())
