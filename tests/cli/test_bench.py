"""``kissgs bench`` as a user runs it; reference: ``kissgs compress`` and ``evaluate`` by hand, and texts of errors."""

import csv
import json
import os
import signal

import numpy as np
import pytest
from helpers.captured_scene import SCENE, write_capture
from helpers.command_line import failure, run

import kissgs
from kissgs.cli import bench
from kissgs.cli.interrupts import Interrupted


def table(path):
    return list(csv.DictReader(path.read_text(encoding="utf-8").splitlines()))


def test_the_table_has_the_bytes_and_the_quality_of_the_commands(scene, tmp_path):
    done = run("bench", scene, "-p", "fast", "--time", "0.01s", "-o", tmp_path / "t.csv")
    assert done.returncode == 0, done.stderr
    rows = table(tmp_path / "t.csv")
    assert [row["name"] for row in rows] == ["fast", "in 0.01s"]
    assert rows[1]["bytes"] == rows[0]["bytes"], "there is time for the preset fast only"
    row = rows[0]
    assert run("compress", scene, "-p", row["name"], "-o", tmp_path / "c.zip", "--force").returncode == 0
    found = json.loads(run("evaluate", scene, tmp_path / "c.zip", "--json").stdout)
    assert int(row["bytes"]) == (tmp_path / "c.zip").stat().st_size == found["bytes"]["candidate"]
    assert float(row["bytes_per_gaussian"]) == int(row["bytes"]) / 600
    views = [view["candidate_vs_reference"]["psnr"] for view in found["views"]]
    assert float(row["psnr"]) == pytest.approx(np.mean(np.minimum(views, 60)), abs=1e-6)
    assert float(row["ssim"]) == pytest.approx(found["mean"]["candidate_vs_reference"]["ssim"], abs=1e-6)
    assert float(row["worst_view"]) == pytest.approx(min(views), abs=1e-6)
    assert (row["against"], row["psnr_change"]) == ("renderings", "")
    assert min(float(row[name]) for name in ("seconds", "cpu_seconds", "decode_seconds", "peak_memory")) > 0
    assert f"{int(row['bytes']):,}" in done.stdout.decode()
    assert (tmp_path / "t.png").read_bytes().startswith(b"\x89PNG")


def test_photographs_are_compared_with(tmp_path):
    kissgs.save(SCENE, tmp_path / "scene.ply")
    capture = write_capture(tmp_path / "capture", names=("a.png", "b.png", "c.png"))
    words = tmp_path / "scene.ply", "-p", "fast", "--views", capture, "-o", tmp_path / "t.csv"
    done = run("bench", *words)
    assert done.returncode == 0, done.stderr
    (row,) = table(tmp_path / "t.csv")
    result = kissgs.compress(
        tmp_path / "scene.ply", settings=kissgs.Settings(preset="fast"), views=kissgs.load_views(capture)
    )
    (view,) = kissgs.load_views(capture).test
    photo = view.load_photo() / 255
    psnr = {
        name: -10 * np.log10(np.mean((np.clip(kissgs.render(splats, view.camera)[0], 0, 1) - photo) ** 2))
        for name, splats in (("scene", SCENE), ("decoded", kissgs.decompress(result.files)))
    }
    assert row["against"] == "photos"
    assert float(row["psnr"]) == pytest.approx(psnr["decoded"], abs=1e-3)
    assert float(row["psnr_change"]) == pytest.approx(psnr["decoded"] - psnr["scene"], abs=1e-3)
    assert float(row["worst_view"]) == pytest.approx(float(row["psnr_change"])), "there is one held-out view"
    assert max(map(len, done.stdout.decode().splitlines())) <= 120


@pytest.fixture(scope="module")
def one(scene):
    return bench.measured(scene, kissgs.Settings(preset="fast"))


def test_all_presets_and_some_times_are_measured_by_default(scene, one, monkeypatch):
    asked = []

    def measured(path, settings, **_):
        asked.append((str(settings.preset), settings.time_limit))
        return one

    monkeypatch.setattr(bench, "measured", measured)
    assert run("bench", scene).returncode == 0
    presets = [("fast", None), ("balanced", None), ("paper", None)]
    assert asked == [*presets, ("balanced", 5), ("balanced", 30), ("balanced", 120)]


@pytest.mark.parametrize("error", [kissgs.UnsupportedError("it was killed"), Interrupted(signal.SIGINT)])
def test_what_is_measured_is_kept_if_a_later_one_fails(scene, one, tmp_path, monkeypatch, error):
    left = [one, error]

    def measured(*_, **__):
        found = left.pop(0)
        if isinstance(found, BaseException):
            raise found
        return found

    monkeypatch.setattr(bench, "measured", measured)
    if isinstance(error, Interrupted):
        with pytest.raises(Interrupted):
            bench.bench(scene, presets=["fast", "paper"], output=tmp_path / "t.csv")
    else:
        done = run("bench", scene, "-p", "fast", "-p", "paper", "-o", tmp_path / "t.csv")
        assert (done.returncode, done.stderr) == (2, b"kissgs: paper: it was killed\n")
    assert [row["name"] for row in table(tmp_path / "t.csv")] == ["fast"]


def test_a_killed_measurement_and_an_error_end_in_a_sentence(tmp_path):
    with pytest.raises(kissgs.UnsupportedError, match=r"^a scene: the measurement was killed"):
        bench.isolated(killed, "a scene")
    with pytest.raises(kissgs.InvalidSceneError, match="there is no such file"):
        bench.measured(tmp_path / "none.ply", kissgs.Settings())


def killed():
    os.kill(os.getpid(), signal.SIGKILL)


def test_without_matplotlib_the_table_is_written(scene, one, tmp_path, monkeypatch):
    monkeypatch.setattr(bench, "find_spec", lambda name: None)
    monkeypatch.setattr(bench, "measured", lambda *_, **__: one)
    done = run("bench", scene, "-p", "fast", "-o", tmp_path / "t.csv")
    assert b"kissgs: no plot without matplotlib, which is missing: pip install matplotlib\n" in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["t.csv"]


REFUSED = {
    "-p gzip": "fast",
    "--time soon": "soon",
    "-o table.txt": "table.txt is no name of a table; end it in .csv",
    "-o no/such/table.csv": "there is no folder no/such",
    "-o there.csv": "there.csv exists already",
    "-o plotted.csv": "plotted.png exists already",
    "--views none": "none",
}


def test_wrong_inputs_are_refused_before_a_measurement(scene, tmp_path, monkeypatch):
    monkeypatch.setattr(bench, "measured", None)
    for name in ("there.csv", "plotted.png"):
        (tmp_path / name).touch()
    for options, message in REFUSED.items():
        assert message in failure("bench", scene, *options.split(), cwd=tmp_path), options
