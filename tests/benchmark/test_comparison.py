"""Oracle: measurements that nobody made, with known medians; the library's own functions for those that are made."""

import json
import math
import statistics
import sys

import pytest
from helpers.benchmark_rows import many, measured, run

import kissgs
from kissgs import UnsupportedError
from kissgs.benchmark import comparison, roundtrip
from kissgs.benchmark.comparison import Plan, compare, growth
from kissgs.benchmark.external_codecs import PeerResult
from kissgs.benchmark.results import Run, at_equal_psnr
from kissgs.cli.bench_tables import bench_tables
from kissgs.cli.console import output
from kissgs.settings import Settings

QUICK = {"sensitivity_views": 4, "sensitivity_view_size": 60}


def text(what, width=120):
    console = output()
    console.width = width
    with console.capture() as captured:
        console.print(what)
    return captured.get()


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    path = tmp_path_factory.mktemp("bench") / "tiny.ply"
    kissgs.save(kissgs.sample_scene(300, sh_degree=1), path)
    return path


def test_times_are_medians_and_memory_is_the_most():
    seconds = [3.0, 1.0, 9.0]
    stages = [{"a": 1.0, "b": 5.0}, {"a": 7.0}, {"a": 2.0, "b": 4.0}]
    runs = [run(s, memory=int(1e6 * s), stages=each) for s, each in zip(seconds, stages, strict=True)]
    took = Run.typical(runs)
    assert (took.encode_seconds, took.encode_cpu_seconds) == (statistics.median(seconds), 6.0)
    assert took.stage_seconds == {"a": 2.0, "b": 4.0}, "a stage that a run has not is one of no time"
    assert took.peak_memory == 9_000_000
    assert Run.typical(runs[:1]) == runs[0]


def test_bytes_that_differ_between_repeats_are_told():
    steady = measured("fast", 100, 30.0, runs=(run(size=100), run(size=100)))
    other = measured("small", 100, 30.0, runs=(run(size=100), run(size=101)))
    assert (steady.steady, other.steady) == (True, False)
    told = text(bench_tables([steady, other], []))
    assert "small is not the same every time: 100, 101 bytes" in told
    assert "fast is not" not in told


def test_bytes_at_equal_psnr_lie_on_the_curve():
    rows = many(photo=True)
    found = {(equal.peer, equal.figure): equal for equal in at_equal_psnr(rows)}
    assert set(found) == {(peer, figure) for peer in ("sog", "spz") for figure in ("original", "photographs")}
    expected = math.exp((math.log(700) + math.log(1600)) / 2)  # half-way from 40 to 46 dB
    assert found["sog", "original"].bytes == pytest.approx(expected)
    assert found["sog", "original"].ratio == pytest.approx(expected / 2000)
    assert found["spz", "original"].ratio is None
    told = text(bench_tables(rows, list(found.values())))
    assert f"at the PSNR of .sog to the original (43.00 dB): balanced 1,058 bytes, {expected / 2000:.3f} of" in told
    assert "at the PSNR of .spz to photographs (20.00 dB): beyond the curve of balanced" in told


SIZES = [measured(f"preset{n}", 1, 30.0, gaussians=size) for size in (10**5, 10**6, 10**7) for n in range(4)]


@pytest.mark.parametrize("rows", [many(photo=True), SIZES])
def test_tables_fit_the_page(rows):
    lines = text(bench_tables(rows, []), width=300).splitlines()
    assert max(map(len, map(str.rstrip, lines))) <= 120


def test_what_is_measured_is_what_compress_gives(scene, monkeypatch):
    """Peers are stood in for: a quick one and one that takes its time."""
    calls = []

    def peer(path, format, *, pictures, **_):
        calls.append((format, pictures))
        seconds = 61.0 if format == "sog" else 1.0
        took = {"encode_seconds": seconds, "decode_seconds": 0.1, "encode_cpu_seconds": 1.0, "decode_cpu_seconds": 0.1}
        row = measured(format, 500, 40.0, external=True)
        pictured = row.pictures if pictures else None
        about = {"gaussians": 300, "kept": 300, "bytes": 500, "peak_memory": 5}
        return PeerResult(format=format, **about, **took, errors=row.errors, pictures=pictured)

    monkeypatch.setattr(comparison, "measure_peer", peer)
    settings = [Settings.from_preset("fast"), Settings.from_preset("balanced", **QUICK)]
    told = []
    rows = compare(
        scene,
        Plan(
            presets=settings,
            curved=settings[1:],
            fidelities=[-4.0],
            peers=["sog", "spz"],
            command=[sys.executable],
            repeats=2,
            pictures=True,
        ),
        progress=lambda stage, fraction, note="": told.append(note),
    )
    assert told == ["fast", "balanced", "balanced", "sog", "spz"]
    assert [(row.name, len(row.runs)) for row in rows] == [
        *(("fast", 2), ("balanced", 2), ("balanced at -4", 1), (".sog", 1), (".spz", 2)),
    ]
    assert calls == [("sog", True), ("spz", True), ("spz", False)]
    assert all(row.steady for row in rows)
    for row, made in zip(
        rows, [*settings, Settings.from_preset("balanced", quality_offset_db=-4.0, **QUICK)], strict=False
    ):
        result = kissgs.compress(scene, settings=made)
        assert row.bytes == len(result.to_zip())
        assert row.file_bytes == result.report.file_bytes
        assert set(row.took.stage_seconds) == set(result.report.seconds)
        found = kissgs.evaluate(kissgs.load(scene), kissgs.decompress(result.to_zip()))
        assert row.psnr("original") == found.mean.candidate_vs_reference.psnr
        assert row.psnr("photographs") is None
    entry = json.loads(json.dumps(rows[0].as_dict()))
    assert (entry["encoder"], entry["quality_offset_db"], entry["bytes"]) == ("fast", None, rows[0].bytes)
    assert entry["encode_seconds"] == statistics.median(each["encode_seconds"] for each in entry["runs"])
    assert entry["report"]["container_bytes"] == rows[0].bytes


def test_a_peer_that_fails_ends_nothing(scene, monkeypatch):
    def fails(*_, **__):
        raise UnsupportedError("out of splats")

    monkeypatch.setattr(comparison, "measure_peer", fails)
    monkeypatch.setattr(comparison, "isolated_roundtrip", roundtrip.roundtrip)
    plan, told = Plan(presets=[Settings.from_preset("fast")], peers=["spz"], command=[sys.executable]), []
    assert [row.name for row in compare(scene, plan, failed=told.append)] == ["fast"]
    assert told == ["out of splats"]
    with pytest.raises(UnsupportedError, match="out of splats"):
        compare(scene, plan)


def test_growth_measures_the_scene_at_other_sizes(scene):
    rows = growth(scene, [100, 500], Plan(presets=[Settings.from_preset("fast")]))
    assert [(row.scene, row.gaussians) for row in rows] == [("tiny.ply", 100), ("tiny.ply", 500)]
    assert rows[0].pictures is None
    assert "fast, 500" in text(bench_tables(rows, []))
