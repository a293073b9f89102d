"""``kissgs bench`` as a user runs it; oracle: the library's own functions, and sentences for what cannot be."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from helpers.command_line import failure, run

import kissgs


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("bench") / "scene.ply"
    kissgs.save(kissgs.sample_scene(600, sh_degree=1), path)
    return path


def test_each_preset_is_measured(scene: Path) -> None:
    rows = json.loads(run("bench", scene, "-p", "fast", "-p", "paper", "--repeats", 2, "--json").stdout)
    assert [(row["encoder"], len(row["runs"])) for row in rows] == [("fast", 2), ("paper", 2)]
    for row in rows:
        result = kissgs.compress(scene, settings=kissgs.Settings(preset=row["encoder"]))
        assert row["report"]["container_bytes"] == row["bytes"] == len(result.to_zip())
        assert row["file_bytes"] == result.report.file_bytes
        assert row["steady"] is True
        assert row["pictures"] is None
        assert sum(row["runs"][0]["stage_seconds"].values()) == pytest.approx(row["runs"][0]["encode_seconds"])


def test_a_curve_is_drawn_and_pictures_are_compared(scene: Path, tmp_path: Path) -> None:
    quick = ["--set", "sensitivity_views=4", "--set", "sensitivity_view_size=60"]
    words = ["-p", "balanced", "--quality-offset", -3, *quick, "--plot", tmp_path / "p.svg"]
    done = run("bench", scene, *words)
    assert done.returncode == 0, done.stderr
    assert "balanced at -3" in done.stdout.decode()
    assert "f_rest_centroids.webp" in done.stdout.decode()
    assert (tmp_path / "p.svg").read_bytes().startswith(b"<?xml")


def test_other_sizes_are_measured_and_drawn(scene: Path, tmp_path: Path) -> None:
    words = ["-p", "fast", "--gaussians", 200, "--gaussians", 900, "--json", "--plot", tmp_path / "p.png"]
    done = run("bench", scene, *words)
    assert done.returncode == 0, done.stderr
    assert [row["gaussians"] for row in json.loads(done.stdout)] == [200, 900]
    assert (tmp_path / "p.png").stat().st_size > 10_000


def test_pictures_are_compared_and_the_rasteriser_is_measured(scene: Path) -> None:
    rows = json.loads(run("bench", scene, "-p", "fast", "--pictures", "--json").stdout)
    assert rows[0]["pictures"]["mean"]["candidate_vs_reference"]["psnr"] > 20
    rows = json.loads(run("bench", scene, "--rendering", "--gaussians", 100, "--json").stdout)
    assert [row["gaussians"] for row in rows] == [100]


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ("--rendering -p fast", "no presets and no peers"),
        ("--rendering --ablate", "--ablate and --rendering are several measurements"),
        ("--rendering --repeats 2", "--repeats does not go with --rendering"),
        ("--gaussians 5 --peer spz", "without --peer and --quality-offset"),
        ("--gaussians 5 --compaction", "--gaussians does not go with --compaction"),
        ("--quality-offset 1 -p fast", "--quality-offset is of presets that weigh bits"),
        ("--quality-offset 1 --ablate", "--quality-offset does not go with --ablate"),
        ("--ablate -p fast", "not of fast"),
        ("--ratio 0.5", "--ratio goes with --compaction"),
        ("--learn-from scene", "--learn-from goes with --compaction or --finetuning"),
        ("--compaction -p fast -p paper", "--compaction goes with one --preset"),
        ("--plot curve.jpg", "plots are svg, png, pdf"),
        ("--scale 4", "--views"),
        ("--peer rar -p fast", "unknown peer format 'rar'; there are sog, spz"),
    ],
)
def test_what_does_not_go_together_is_refused(scene: Path, words: str, sentence: str) -> None:
    assert sentence in failure("bench", scene, *words.split())


def test_two_scenes_are_not_one_plot(scene: Path, tmp_path: Path) -> None:
    assert "--plot draws one scene" in failure("bench", scene, "other.ply", "--plot", tmp_path / "p.svg")


@pytest.mark.parametrize("study", [["--ablate", "-p", "paper"], ["--rendering"], ["-p", "fast"]])
def test_a_scene_that_fails_costs_the_others_nothing(scene: Path, study: list[str]) -> None:
    """What the first took long to find is told all the same, and so is what is wrong with the second."""
    done = run("bench", scene, scene.with_name("none.ply"), *study, "--json")
    assert done.returncode == 2
    assert b"none.ply: there is no such file" in done.stderr
    assert {row["scene"] for row in json.loads(done.stdout)} == {"scene.ply"}


def test_scenes_of_equal_names_are_told_apart(scene: Path, tmp_path: Path) -> None:
    """A capture's scene is often called point_cloud.ply; a peer must be compared with its own."""
    other = tmp_path / "other" / scene.name
    other.parent.mkdir()
    kissgs.save(kissgs.sample_scene(50, sh_degree=0), other)
    rows = json.loads(run("bench", scene, other, scene, "-p", "fast", "--json").stdout)
    names = [f"{path.parent.name}/{path.name}" for path in (scene, other)]
    assert [(row["scene"], row["gaussians"]) for row in rows] == [(names[0], 600), (names[1], 50)]


def test_nothing_has_no_other_size(tmp_path: Path) -> None:
    kissgs.save(kissgs.sample_scene(0), tmp_path / "none.ply")
    rows = json.loads(run("bench", tmp_path / "none.ply", "-p", "fast", "--gaussians", 5, "--json").stdout)
    assert [row["gaussians"] for row in rows] == [0]


def test_scenes_that_all_fail_make_no_table() -> None:
    done = run("bench", "none.ply", "nothing.ply", "-p", "fast")
    assert (done.returncode, done.stdout) == (2, b"")
    assert done.stderr.count(b"there is no such file") == 2
