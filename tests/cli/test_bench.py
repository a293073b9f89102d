"""``kissgs bench`` as a user runs it; reference: the library's functions, and the texts of errors."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from helpers.benchmark_rows import measured
from helpers.captured_scene import cameras
from helpers.command_line import failure, run

import kissgs
from kissgs.benchmark.results import Measurement
from kissgs.benchmark.scaling import FailedMeasurement
from kissgs.cli import bench_scaling
from kissgs.cli.bench_codecs import ExternalCodecs
from kissgs.cli.bench_scenes import BenchInputs, BenchOutput, report
from kissgs.cli.interrupts import Interrupted


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("bench") / "scene.ply"
    kissgs.save(kissgs.sample_scene(600, sh_degree=1), path)
    return path


@pytest.mark.quick(0)
def test_each_preset_is_measured(scene: Path) -> None:
    rows = json.loads(run("bench", "codecs", scene, "-p", "fast", "-p", "paper", "--repeats", 2, "--json").stdout)
    assert [(row["codec"], len(row["runs"])) for row in rows] == [("fast", 2), ("paper", 2)]
    for row in rows:
        result = kissgs.compress(scene, settings=kissgs.Settings(preset=row["codec"]))
        assert row["report"]["container_bytes"] == row["bytes"] == len(result.to_zip())
        assert row["file_bytes"] == result.report.file_bytes
        assert row["reproducible"] is True
        assert row["evaluation"] is None
        assert sum(row["runs"][0]["stage_seconds"].values()) == pytest.approx(row["runs"][0]["encode_seconds"])


def test_a_curve_is_plotted_and_images_are_compared(scene: Path, tmp_path: Path) -> None:
    quick = ["--set", "sensitivity_views=4", "--set", "sensitivity_view_size=60"]
    options = ["-p", "balanced", "--quality-offset", -3, *quick, "--plot", tmp_path / "p.svg"]
    done = run("bench", "codecs", scene, *options)
    assert done.returncode == 0, done.stderr
    assert "balanced at -3" in done.stdout.decode()
    assert "f_rest_centroids.webp" in done.stdout.decode()
    assert (tmp_path / "p.svg").read_bytes().startswith(b"<?xml")


def test_time_limits_are_measured_beside_presets(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    words = "bench", "frontier", scene, "-p", "fast", "--time", "0.01s", "--time", "0.02s"
    rows = json.loads(run(*words, "--json").stdout)
    assert [row["codec"] for row in rows] == ["fast", "in 0.01 s", "in 0.02 s"]
    assert len({row["bytes"] for row in rows}) == 1  # there is time for the preset fast only
    done = run(*words, "--plot", tmp_path / "p.svg")
    assert done.returncode == 0, done.stderr
    assert [line.split()[-1] == "*" for line in done.stdout.decode().splitlines() if "fast" in line] == [True]
    assert (tmp_path / "p.svg").read_bytes().startswith(b"<?xml")


def test_other_sizes_are_measured_and_plotted(scene: Path, tmp_path: Path) -> None:
    options = ["-p", "fast", "--gaussians", 200, "--gaussians", 900, "--json", "--plot", tmp_path / "p.png"]
    done = run("bench", "scaling", scene, *options)
    assert done.returncode == 0, done.stderr
    assert [row["gaussians"] for row in json.loads(done.stdout)] == [200, 900]
    assert (tmp_path / "p.png").stat().st_size > 10_000


@pytest.mark.quick(0)
def test_sample_scenes_are_measured_beside_other_codecs(tmp_path: Path) -> None:
    """The external codec copies its input."""
    tool = tmp_path / "tool.py"
    tool.write_text("import shutil, sys; shutil.copy(*sys.argv[-2:])")
    words = ["--gaussians", 500, "--degree", 0, "-p", "fast", "--external", "spz"]
    done = run("bench", "scaling", *words, "--splat-transform", f"{sys.executable} {tool}", "--json")
    assert done.returncode == 0, done.stderr
    rows = json.loads(done.stdout)
    assert [(row["scene"], row["codec"], row["gaussians"]) for row in rows] == [
        ("sample, degree 0", "fast", 500),
        ("sample, degree 0", "spz", 500),
    ]
    for row in rows:
        assert row["peak_memory_per_gaussian"] == row["peak_memory"] / 500
        assert row["peak_memory_ratio"] == row["peak_memory"] / (56 * 500)
    assert b"sample scenes of up to 500 Gaussians" in done.stderr


def scaled(inputs: BenchInputs) -> BenchOutput:
    """Measure sample scenes in this process."""
    return bench_scaling.scaling(
        inputs,
        [7, 9],
        degrees=[],
        presets=["fast", "small"],
        changes=None,
        external=ExternalCodecs([], "splat-transform", None),
        repeats=1,
        evaluate=False,
        plotted=False,
    )


def test_sample_scenes_have_no_photographs() -> None:
    with pytest.raises(kissgs.UnsupportedError, match="--views needs the FILE of its scene"):
        scaled(BenchInputs(scenes=[], views=cameras()))


def test_an_interrupt_keeps_what_is_measured(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(source: Path | int, *_: object, **__: object) -> Iterator[Measurement | FailedMeasurement]:
        yield measured("fast", 9, 30.0, gaussians=7)
        yield FailedMeasurement(scene="scene.ply", codec="small", gaussians=7, failure="the measurement was killed")
        raise Interrupted(2)

    monkeypatch.setattr("kissgs.benchmark.scaling.measure_scaling", interrupted)
    output = scaled(BenchInputs(scenes=[]))
    with pytest.raises(Interrupted):
        report(output, as_json=True)
    rows = json.loads(capsys.readouterr().out)
    assert [(row["gaussians"], row.get("failure")) for row in rows] == [(7, None), (7, "the measurement was killed")]
    with pytest.raises(Interrupted):
        report(output, as_json=False)
    assert "small, 7: the measurement was killed" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("scene.ply --degree 1", "--degree is for sample scenes"),
        ("--degree 1 --degree 2 --plot p.svg", "--plot takes one scene; give one --degree"),
        ("--external spz --splat-transform no-such-tool", "cannot start no-such-tool"),
        ("none.ply -p small --gaussians 7", "none.ply: there is no such file"),
    ],
)
def test_invalid_options_of_scaling_are_refused(options: str, message: str) -> None:
    assert message in failure("bench", "scaling", "--gaussians", 5, "-p", "fast", *options.split())


def test_clusters_are_simulated(tmp_path: Path) -> None:
    words = ("bench", "capacity", "-p", "fast", "--gaussians", 2000, "--degree", 1, "--cpus", 8, "--dollars", 0.3)
    done = run(*words, "--json", "--plot", tmp_path / "capacity.svg")
    said = done.stderr.decode().splitlines()[0]
    assert said.startswith(
        "kissgs: measuring 2,000 Gaussians with levels of detail and without: about 1 min of processor "
    )
    costs, *runs = json.loads(done.stdout)
    assert costs["node"] == {"cpus": 8, "network_bytes": 625e6, "dollars": 0.3}
    assert [run["jobs_per_day"] for run in runs[16:]] == [1e3, 1e4, 1e5, 1e6]
    assert all(run["longest_wait"] <= 60 and run["busy"] < 1 for run in runs[16:])
    assert b"<svg" in (tmp_path / "capacity.svg").read_bytes()
    shown = run(*words).stdout.decode()
    assert "1,000,000,000" in shown
    assert max(map(len, shown.splitlines())) <= 120


def test_the_time_of_a_simulation_is_stated_by_count_and_preset(monkeypatch: pytest.MonkeyPatch) -> None:
    """Oracle: 240 and 62 CPU seconds of a million Gaussians, docs/scaling.md."""
    from kissgs.benchmark import streaming_costs

    monkeypatch.setattr(streaming_costs, "isolated", lambda work, what: None)
    for count, preset, minutes in ((1_048_576, "balanced", 5), (10_000_000, "balanced", 40), (10_000_000, "fast", 11)):
        said: list[str] = []
        settings = kissgs.Settings.from_preset(preset)
        streaming_costs.measure_costs(3, settings, count, announce=said.append)
        assert f"{count:,} Gaussians with levels of detail and without: about {minutes} min" in said[0]


def test_what_makes_a_simulation_faster_is_named_where_it_applies(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Regression: it named the preset fast where it was chosen, and a number of Gaussians that no file has."""
    from kissgs.benchmark import streaming_costs

    monkeypatch.setattr(streaming_costs, "isolated", lambda work, what: None)
    for source, preset, end in (
        (3, "balanced", " min of processor time; fewer Gaussians and the preset fast take less"),
        (3, "fast", " min of processor time; fewer Gaussians take less"),
        (scene, "balanced", " min of processor time; the preset fast takes less"),
        (scene, "fast", " min of processor time"),
    ):
        said: list[str] = []
        streaming_costs.measure_costs(source, kissgs.Settings.from_preset(preset), 1000, announce=said.append)
        assert said[0].endswith(end)


@pytest.mark.quick(0)
def test_images_are_compared_and_the_rasteriser_is_measured(scene: Path) -> None:
    rows = json.loads(run("bench", "codecs", scene, "-p", "fast", "--evaluate", "--json").stdout)
    assert rows[0]["evaluation"]["mean"]["candidate_vs_reference"]["psnr"] > 20
    rows = json.loads(run("bench", "rendering", scene, "--gaussians", 100, "--json").stdout)
    assert [row["gaussians"] for row in rows] == [100]


@pytest.mark.parametrize(
    ("command", "options", "message"),
    [
        ("codecs", "--quality-offset 1 -p fast", "--quality-offset needs a preset with rate-distortion planning"),
        ("codecs", "--external rar -p fast", "unknown external codec 'rar'; choose sog or spz"),
        ("codecs", "--sog-iterations 1", "--sog-iterations needs --external sog"),
        ("codecs", "--external sog --splat-transform '", "--splat-transform ': no closing quotation"),
        ("codecs", "--plot curve.jpg", "ends in .svg, .png or .pdf"),
        ("codecs", "--scale 4", "--views"),
        ("rendering", "--gaussians 99999999999999", "need more memory than there is"),
        ("ablation", "-p fast", "balanced or small, not fast"),
        ("finetuning", "-p fast", "choose balanced or small"),
        ("finetuning", "--supervision cameras", "--supervision cameras needs a capture"),
    ],
)
def test_invalid_options_are_refused(scene: Path, command: str, options: str, message: str) -> None:
    assert message in failure("bench", command, scene, *options.split())


def test_a_command_has_only_its_own_options(scene: Path) -> None:
    for words in (["rendering", scene, "-p", "fast"], ["codecs", scene, "--gaussians", 5], ["scaling", scene]):
        assert run("bench", *words).returncode == 2


def test_without_a_command_help_is_printed() -> None:
    done = run("bench")
    printed = (done.stdout + done.stderr).decode()
    commands = ("codecs", "scaling", "ablation", "compaction", "finetuning", "rendering")
    assert [command for command in commands if f"│ {command} " not in printed] == []


def test_a_plot_of_two_scenes_is_refused(scene: Path, tmp_path: Path) -> None:
    assert "--plot takes one scene" in failure("bench", "codecs", scene, "other.ply", "--plot", tmp_path / "p.svg")


@pytest.mark.parametrize("words", [["ablation", "-p", "paper"], ["rendering"], ["codecs", "-p", "fast"]])
@pytest.mark.quick(0)
def test_the_results_of_other_scenes_are_printed_if_one_fails(scene: Path, words: list[str]) -> None:
    done = run("bench", *words, scene, scene.with_name("none.ply"), "--json")
    assert done.returncode == 2
    assert b"none.ply: there is no such file" in done.stderr
    assert {row["scene"] for row in json.loads(done.stdout)} == {"scene.ply"}


def test_scenes_of_equal_file_names_have_different_names(scene: Path, tmp_path: Path) -> None:
    """Many captures have a scene called point_cloud.ply."""
    other = tmp_path / "other" / scene.name
    other.parent.mkdir()
    kissgs.save(kissgs.sample_scene(50, sh_degree=0), other)
    rows = json.loads(run("bench", "codecs", scene, other, scene, "-p", "fast", "--json").stdout)
    names = [f"{path.parent.name}/{path.name}" for path in (scene, other)]
    assert [(row["scene"], row["gaussians"]) for row in rows] == [(names[0], 600), (names[1], 50)]


def test_an_empty_scene_is_not_resampled(tmp_path: Path) -> None:
    kissgs.save(kissgs.sample_scene(0), tmp_path / "none.ply")
    plot = ["--plot", tmp_path / "p.svg"]
    done = run("bench", "scaling", tmp_path / "none.ply", "-p", "fast", "--gaussians", 5, *plot)
    assert done.returncode == 2
    assert b"a scene without Gaussians cannot be plotted" in done.stderr
    rows = json.loads(run("bench", "scaling", tmp_path / "none.ply", "-p", "fast", "--gaussians", 5, "--json").stdout)
    assert [row["gaussians"] for row in rows] == [0]


def test_there_is_no_table_if_all_scenes_fail() -> None:
    done = run("bench", "codecs", "none.ply", "nothing.ply", "-p", "fast")
    assert (done.returncode, done.stdout) == (2, b"")
    assert done.stderr.count(b"there is no such file") == 2
