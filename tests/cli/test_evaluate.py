"""``kissgs evaluate`` and ``compress --evaluate`` as a user runs them. Oracle: the library's own functions."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from helpers.captured_scene import SCENE, damaged, write_capture
from helpers.command_line import failure, run
from PIL import Image

import kissgs


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with a.ply, its container b.zip, a damaged c.ply, and a capture."""
    folder = tmp_path_factory.mktemp("evaluate")
    kissgs.save(SCENE, folder / "a.ply")
    kissgs.compress(SCENE, folder / "b.zip")
    kissgs.save(damaged(), folder / "c.ply")
    write_capture(folder / "capture")
    return folder


def test_json_is_the_evaluation_and_the_bytes(folder: Path) -> None:
    capture = folder / "capture"
    done = run("evaluate", folder / "a.ply", folder / "b.zip", "--views", capture, "--json")
    report = json.loads(done.stdout)
    found = kissgs.evaluate(kissgs.load(folder / "a.ply"), kissgs.load(folder / "b.zip"), kissgs.load_views(capture))
    assert report.pop("bytes") == {
        side: (folder / name).stat().st_size for side, name in (("reference", "a.ply"), ("candidate", "b.zip"))
    }
    assert report == json.loads(json.dumps(found.as_dict()))


def test_cameras_can_be_farther_away(folder: Path) -> None:
    done = run("evaluate", folder / "a.ply", folder / "c.ply", "--distance", "3", "--json")
    scenes = kissgs.load(folder / "a.ply"), kissgs.load(folder / "c.ply")
    found = kissgs.evaluate(*scenes, distance=3.0)
    assert json.loads(done.stdout)["mean"] == json.loads(json.dumps(found.as_dict()))["mean"]
    assert found.mean != kissgs.evaluate(*scenes).mean
    assert "give a number above 0" in failure("evaluate", folder / "a.ply", folder / "c.ply", "--distance", "0")
    assert b"at 3 times the distance" in run("evaluate", folder / "a.ply", folder / "c.ply", "--distance", "3").stdout


def test_the_table_says_what_was_compared(folder: Path) -> None:
    done = run("evaluate", folder / "a.ply", folder / "c.ply", "--views", folder / "capture", "--split", "all")
    text = done.stdout.decode()
    found = kissgs.evaluate(SCENE, kissgs.load(folder / "c.ply"), kissgs.load_views(folder / "capture"), split="all")
    assert "3 photographs, 60x40: " in text
    assert "c.ply compared with a.ply" in text
    assert "1.0x smaller" in text
    assert "1,500 of 1,500 Gaussians" in text
    rows = {row.split()[0]: row.split()[1:] for row in text.splitlines() if row.startswith(("images/", "mean"))}
    assert rows["images/a.png"] == found.views[0].comparison.cells(["PSNR", "SSIM"])
    assert rows["mean"] == found.mean.cells(["PSNR", "SSIM"])
    means = found.mean.reference, found.mean.candidate, found.mean.candidate_vs_reference
    titles = ("reference to photo", "candidate to photo", "candidate to reference")
    below = {row[:22].strip(): row[22:].split() for row in text.splitlines() if row.startswith(titles)}
    assert below == {title: [f"{mean.ms_ssim:.4f}"] for title, mean in zip(titles, means, strict=True)}


def test_without_views_it_draws_cameras_and_folders_are_scenes_too(folder: Path, tmp_path: Path) -> None:
    kissgs.compress(SCENE, tmp_path / "unpacked")
    done = run("evaluate", folder / "b.zip", tmp_path / "unpacked")
    text = done.stdout.decode()
    assert done.returncode == 0, done.stderr
    assert "24 cameras, 320x240: drawn over the whole scene, seed 0" in text
    assert "∞" in text
    assert "photo" not in text


def test_the_worst_view_is_printed_and_depends_on_the_seed(folder: Path) -> None:
    words = ["evaluate", folder / "a.ply", folder / "c.ply"]
    found = kissgs.evaluate(SCENE, kissgs.load(folder / "c.ply"), seed=7)
    text = " ".join(run(*words, "--seed", 7).stdout.decode().split())
    assert f"W{found.extremes[1:]}." in text
    report = json.loads(run(*words, "--seed", 7, "--json").stdout)
    assert report["worst"]["psnr"] == min(view["candidate_vs_reference"]["psnr"] for view in report["views"])
    assert report["worst"]["position"] != json.loads(run(*words, "--json").stdout)["worst"]["position"]


def test_the_scene_beyond_the_capture_is_evaluated_too(folder: Path) -> None:
    words = ["evaluate", folder / "a.ply", folder / "c.ply", "--views", folder / "capture"]
    text = " ".join(run(*words).stdout.decode().split())
    report = json.loads(run(*words, "--json").stdout)
    assert report["against"] == "photos"
    assert report["surroundings"]["against"] == "renderings"
    assert report["surroundings"]["surroundings"] is None
    around = report["surroundings"]["mean"]["candidate_vs_reference"]["psnr"]
    assert f"Beyond the capture: PSNR {around:.2f} dB to the scene's own renderings from 24 cameras; worst view" in text


@pytest.mark.parametrize(("noise", "noted"), [(0.02, False), (0.2, True)])
def test_a_capture_that_fits_poorly_is_noted(folder: Path, tmp_path: Path, noise: float, noted: bool) -> None:
    """Below 18 dB the photographs may be of another scene, which ``compress`` notes too."""
    capture = write_capture(tmp_path / "capture")
    for path in (capture / "images").iterdir():
        image = np.asarray(Image.open(path)) / 255
        noisy = np.clip(image + np.random.default_rng(0).normal(0, noise, image.shape), 0, 1)
        Image.fromarray((255 * noisy).astype(np.uint8)).save(path)
    done = run("evaluate", folder / "a.ply", folder / "a.ply", "--views", capture)
    text = " ".join(done.stdout.decode().split())
    assert ("the photographs differ much from renderings of a.ply: PSNR 1" in text) == noted


def test_views_without_a_test_split_say_so(folder: Path, tmp_path: Path) -> None:
    capture = write_capture(tmp_path / "one", names=("only.png",))
    text = run("evaluate", folder / "a.ply", folder / "a.ply", "--views", capture).stdout.decode()
    assert "1 training photograph, 60x40" in text
    assert "no view is held out" in text


def test_missing_photographs_are_reported(folder: Path, tmp_path: Path) -> None:
    capture = write_capture(tmp_path / "capture")
    (capture / "images").rename(capture / "rgb")
    words = ["evaluate", folder / "a.ply", folder / "c.ply", "--views", capture]
    note = f"no photographs were found (searched {capture} for 'images', 'input'); name their folder with --images"
    text = " ".join(run(*words, "--html", tmp_path / "page.html").stdout.decode().split())
    assert note.replace(" ", "") in text.replace(" ", "")
    assert note[1:].replace("'", "&#x27;") in (tmp_path / "page.html").read_text(encoding="utf-8")
    assert json.loads(run(*words, "--json").stdout)["note"] == note
    report = json.loads(run(*words, "--images", "rgb", "--json").stdout)
    assert (report["note"], report["against"]) == ("", "photos")


def test_a_page_is_written_whole_and_not_over_another(folder: Path, tmp_path: Path) -> None:
    page, words = (
        tmp_path / "page.html",
        ["evaluate", folder / "a.ply", folder / "c.ply", "--views", folder / "capture"],
    )
    done = run(*words, "--html", page)
    assert str(page) in done.stdout.decode()
    text = page.read_text(encoding="utf-8")
    assert text.startswith("<!doctype html>")
    assert text.rstrip().endswith("</html>")
    assert "exists already" in failure(*words, "--html", page)
    assert run(*words, "--html", page, "--force", "-q").stdout == b""
    assert page.read_text(encoding="utf-8") == text
    assert "no folder" in failure(*words, "--html", tmp_path / "none" / "page.html")
    assert [path.name for path in tmp_path.iterdir()] == ["page.html"]


def test_errors_are_one_line(folder: Path, tmp_path: Path) -> None:
    pair, capture = [folder / "a.ply", folder / "b.zip"], folder / "capture"
    assert "no such file" in failure("evaluate", folder / "none.ply", folder / "b.zip").lower()
    assert "no such file" in failure("evaluate", folder / "a.ply", folder / "none.zip").lower()
    assert "name the folder of a capture" in failure("evaluate", *pair, "--views", tmp_path / "none")
    assert "has no cameras" in failure("evaluate", *pair, "--views", tmp_path)
    assert "choose test, train or all" in failure("evaluate", *pair, "--split", "val")
    assert "choose cpu or cuda" in failure("evaluate", *pair, "--device", "tpu")
    for option in ("--scale", "--images"):
        assert f"{option} only applies to the photographs" in failure("evaluate", *pair, option, "2")
    assert "exclude each other" in failure("evaluate", *pair, "--views", capture, "--scale", 2, "--images", tmp_path)
    (capture / "images" / "a.png").rename(capture / "images" / "a.away")
    try:
        assert "1 of 3 photographs is missing" in failure("evaluate", *pair, "--views", capture)
    finally:
        (capture / "images" / "a.away").rename(capture / "images" / "a.png")


@pytest.mark.quick(0)
def test_compressing_can_evaluate(folder: Path, tmp_path: Path) -> None:
    words = ["compress", folder / "a.ply", "-o", tmp_path / "a.zip", "--evaluate", "--views", folder / "capture"]
    report = json.loads(run(*words, "--json").stdout)["evaluation"]
    views = kissgs.load_views(folder / "capture")
    found = kissgs.evaluate(SCENE, kissgs.decompress(tmp_path / "a.zip"), views)
    assert report == json.loads(json.dumps(found.as_dict()))
    assert (tmp_path / "a.zip").read_bytes() == kissgs.compress(folder / "a.ply", views=views).to_zip()
    text = run(*words, "--force").stdout.decode()
    own, mean = found.mean.reference, found.mean.candidate
    figures = f"PSNR {mean.psnr:.2f} dB, SSIM {mean.ssim:.4f}, MS-SSIM {mean.ms_ssim:.4f}"
    scene = f"{own.psnr:.2f} dB, {own.ssim:.4f}, {own.ms_ssim:.4f}"
    assert f"{figures} to 1 held-out photograph; the scene itself {scene};" in text
    run(*[word for word in words if word != "--evaluate"], "--force")
    assert (tmp_path / "a.zip").read_bytes() == kissgs.compress(folder / "a.ply", views=views).to_zip()


def test_cancelling_the_evaluation_writes_nothing(tmp_path: Path) -> None:
    def stop(stage: str, fraction: float) -> None:
        if stage == "evaluate" and fraction > 0:
            raise kissgs.Cancelled("enough")

    with pytest.raises(kissgs.Cancelled, match="enough"):
        kissgs.compress(SCENE, tmp_path / "a.zip", evaluate=True, progress=stop)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("preset", ["fast", "balanced", "small", "paper"])
@pytest.mark.quick(1)
def test_every_preset_accepts_views(folder: Path, tmp_path: Path, preset: str) -> None:
    """A loop over presets needs no exception: presets that render no images use the views for evaluation only."""
    few_views = "--set", "sensitivity_views=4", "--set", "sensitivity_view_size=48"
    words = "compress", folder / "a.ply", "-p", preset, *few_views, "--views", folder / "capture", "--json"
    alone = run(*words, "-o", tmp_path / "a.zip")
    evaluated = run(*words, "-o", tmp_path / "b.zip", "--evaluate")
    assert (alone.returncode, evaluated.returncode) == (0, 0), alone.stderr + evaluated.stderr
    assert (tmp_path / "a.zip").read_bytes() == (tmp_path / "b.zip").read_bytes()
    note = f"kissgs: --views has no effect: the preset {preset} renders no images; add --evaluate\n"
    assert alone.stderr.decode() == (note if preset in ("fast", "paper") else "")
    assert evaluated.stderr == b""
    evaluation = json.loads(evaluated.stdout)["evaluation"]
    assert evaluation["mean"]["reference"] is not None, "no photographs were compared"


@pytest.mark.parametrize("preset", ["fast", "paper"])
def test_views_do_not_change_the_bytes_of_presets_that_render_no_images(folder: Path, preset: str) -> None:
    settings = kissgs.Settings.from_preset(preset)
    views = kissgs.load_views(folder / "capture")
    with_views, without_views = (kissgs.compress(SCENE, settings=settings, views=some) for some in (views, None))
    assert with_views.files == without_views.files


def test_a_capture_that_cannot_be_read_is_refused_by_every_preset(folder: Path, tmp_path: Path) -> None:
    words = "compress", folder / "a.ply", "-p", "fast", "-o", tmp_path / "a.zip"
    assert "there is no folder" in failure(*words, "--views", tmp_path / "none")
    assert run(*words, "--views", folder / "capture", "--quiet").stderr == b""
