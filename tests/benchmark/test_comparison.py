"""Reference: synthetic measurements with known medians; ``kissgs.compress`` and ``kissgs.evaluate`` for real ones."""

import json
import math
import statistics
import sys

import pytest
from helpers.benchmark_rows import many, measured, run

import kissgs
from kissgs import UnsupportedError
from kissgs.benchmark import comparison, roundtrip
from kissgs.benchmark.comparison import BenchmarkPlan, compare
from kissgs.benchmark.external_codecs import ExternalResult
from kissgs.benchmark.results import Run, at_equal_psnr
from kissgs.benchmark.scaling import measure_scaling
from kissgs.cli.bench_tables import bench_tables
from kissgs.cli.console import output
from kissgs.cli.scaling_tables import scaling_tables
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


def test_times_are_medians_and_memory_is_the_maximum():
    seconds = [3.0, 1.0, 9.0]
    stages = [{"a": 1.0, "b": 5.0}, {"a": 7.0}, {"a": 2.0, "b": 4.0}]
    runs = [run(s, memory=int(1e6 * s), stages=each) for s, each in zip(seconds, stages, strict=True)]
    typical = Run.median_of(runs)
    assert (typical.encode_seconds, typical.encode_cpu_seconds) == (statistics.median(seconds), 6.0)
    assert typical.stage_seconds == {"a": 2.0, "b": 4.0}, "a stage that a run does not have takes no time"
    assert typical.peak_memory == 9_000_000
    assert Run.median_of(runs[:1]) == runs[0]


def test_bytes_that_differ_between_runs_are_reported():
    same = measured("fast", 100, 30.0, runs=(run(size=100), run(size=100)))
    other = measured("small", 100, 30.0, runs=(run(size=100), run(size=101)))
    assert (same.reproducible, other.reproducible) == (True, False)
    table = text(bench_tables([same, other], []))
    assert "small differs between runs: 100, 101 bytes" in table
    assert "fast differs" not in table


def test_bytes_at_equal_psnr_are_on_the_rate_curve():
    rows = many(photo=True)
    found = {(equal.reference, equal.target): equal for equal in at_equal_psnr(rows)}
    assert set(found) == {(external, target) for external in (".sog", ".spz") for target in ("original", "photographs")}
    expected = math.exp((math.log(700) + math.log(1600)) / 2)  # half-way from 40 to 46 dB
    assert found[".sog", "original"].bytes == pytest.approx(expected)
    assert found[".sog", "original"].ratio == pytest.approx(expected / 2000)
    assert found[".spz", "original"].ratio is None
    table = text(bench_tables(rows, list(found.values())))
    assert f"at the PSNR of .sog to the original (43.00 dB): balanced 1,058 bytes, {expected / 2000:.3f} of" in table
    assert "at the PSNR of .spz to photographs (20.00 dB): beyond the curve of balanced" in table


def test_containers_are_compared_at_equal_psnr():
    """A preset in another container is a reference for the curve of the preset, and the other way round."""
    rows = [row for row in many() if row.codec in ("fast", "balanced")]
    rows += [measured("balanced", 800, 41.5, container="sog"), measured("fast", 1100, 37.0, container="sog")]
    (found,) = at_equal_psnr(rows)
    assert (found.reference, found.preset, found.container) == ("balanced .sog", "balanced", "sogxt")
    expected = math.exp(0.75 * math.log(700) + 0.25 * math.log(1600))  # a quarter of the way from 40 to 46 dB
    assert found.bytes == pytest.approx(expected)
    assert found.ratio == pytest.approx(expected / 800)
    rows.append(measured("balanced", 1700, 46.5, container="sog", quality_offset_db=6.0))
    back = next(equal for equal in at_equal_psnr(rows) if equal.container == "sog")
    assert (back.reference, back.bytes) == ("balanced", None), "40 dB is below the curve of .sog"
    table = text(bench_tables(rows, at_equal_psnr(rows)))
    assert f"at the PSNR of balanced .sog to the original (41.50 dB): balanced {expected:,.0f} bytes" in table
    assert "balanced .sog at 6" in table


SCALING = [measured(f"preset{n}", 1, 30.0, gaussians=size) for size in (10**5, 10**6, 10**7) for n in range(4)]


@pytest.mark.parametrize("rows", [many(photo=True), SCALING])
def test_tables_fit_into_120_columns(rows):
    lines = text(bench_tables(rows, []), width=300).splitlines()
    assert max(map(len, map(str.rstrip, lines))) <= 120


@pytest.mark.quick(0)
def test_measurements_agree_with_compress_and_evaluate(scene, monkeypatch):
    """Two fake external codecs take their part: a fast one, and one that is too slow to be repeated."""
    calls = []

    def fake_codec(path, format, *, evaluate, **_):
        calls.append((format, evaluate))
        seconds = 61.0 if format == "sog" else 1.0
        times = {"encode_seconds": seconds, "decode_seconds": 0.1, "encode_cpu_seconds": 1.0, "decode_cpu_seconds": 0.1}
        row = measured(format, 500, 40.0, external=True)
        evaluation = row.evaluation if evaluate else None
        sizes = {"gaussians": 300, "sh_degree": 1, "kept": 300, "bytes": 500, "peak_memory": 5}
        return ExternalResult(format=format, **sizes, **times, errors=row.errors, evaluation=evaluation)

    monkeypatch.setattr(comparison, "measure_external", fake_codec)
    settings = [Settings.from_preset("fast"), Settings.from_preset("balanced", **QUICK)]
    notes = []
    rows = compare(
        scene,
        BenchmarkPlan(
            presets=settings,
            curve_presets=settings[1:],
            quality_offsets=[-4.0],
            external_codecs=["sog", "spz"],
            splat_transform=[sys.executable],
            repeats=2,
            evaluate=True,
        ),
        progress=lambda stage, fraction, note="": notes.append(note),
    )
    assert notes == ["fast", "balanced", "balanced", "sog", "spz"]
    assert [(row.name, len(row.runs)) for row in rows] == [
        *(("fast", 2), ("balanced", 2), ("balanced at -4", 1), (".sog", 1), (".spz", 2)),
    ]
    assert calls == [("sog", True), ("spz", True), ("spz", False)]
    assert all(row.reproducible for row in rows)
    for row, made in zip(
        rows, [*settings, Settings.from_preset("balanced", quality_offset_db=-4.0, **QUICK)], strict=False
    ):
        result = kissgs.compress(scene, settings=made)
        assert row.bytes == len(result.to_zip())
        assert row.file_bytes == result.report.file_bytes
        assert set(row.median_run.stage_seconds) == set(result.report.seconds)
        found = kissgs.evaluate(kissgs.load(scene), kissgs.decompress(result.to_zip()))
        assert row.psnr("original") == found.mean.candidate_vs_reference.psnr
        assert row.psnr("photographs") is None
    entry = json.loads(json.dumps(rows[0].as_dict()))
    assert (entry["codec"], entry["quality_offset_db"], entry["bytes"]) == ("fast", None, rows[0].bytes)
    assert entry["encode_seconds"] == statistics.median(each["encode_seconds"] for each in entry["runs"])
    assert entry["report"]["container_bytes"] == rows[0].bytes


def test_measurements_go_on_after_an_external_codec_fails(scene, monkeypatch):
    def fails(*_, **__):
        raise UnsupportedError("out of splats")

    monkeypatch.setattr(comparison, "measure_external", fails)
    monkeypatch.setattr(comparison, "isolated_roundtrip", roundtrip.roundtrip)
    plan, failures = (
        BenchmarkPlan(
            presets=[Settings.from_preset("fast")], external_codecs=["spz"], splat_transform=[sys.executable]
        ),
        [],
    )
    assert [row.name for row in compare(scene, plan, on_failure=failures.append)] == ["fast"]
    assert failures == ["out of splats"]
    with pytest.raises(UnsupportedError, match="out of splats"):
        compare(scene, plan)


@pytest.mark.quick(0)
def test_a_resampled_scene_is_measured_at_each_count(scene):
    rows = list(measure_scaling(scene, [100, 500], BenchmarkPlan(presets=[Settings.from_preset("fast")])))
    assert [(row.scene, row.gaussians) for row in rows] == [("tiny.ply", 100), ("tiny.ply", 500)]
    assert rows[0].evaluation is None
    assert "fast, 500" in text(scaling_tables(rows, []))
