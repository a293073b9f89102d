"""``kissgs evaluate`` and ``compress --evaluate`` as a user runs them. Oracle: the library's own functions."""

import json

import numpy as np
import pytest
from helpers.captured_scene import SCENE, write_capture
from helpers.command_line import failure, run
from PIL import Image

import kissgs


def rows(text, *names):
    return {row.split()[0]: row.split()[1:] for row in text.splitlines() if row.startswith(names)}


def test_the_report_is_the_evaluation_and_the_bytes(folder):
    words = ["evaluate", folder / "a.ply", folder / "c.ply", "--views", folder / "capture", "--split", "all"]
    report = json.loads(run(*words, "--json").stdout)
    scenes = kissgs.load(folder / "a.ply"), kissgs.load(folder / "c.ply")
    found = kissgs.evaluate(*scenes, kissgs.load_views(folder / "capture"), split="all")
    sizes = {"reference": (folder / "a.ply").stat().st_size, "candidate": (folder / "c.ply").stat().st_size}
    assert report == {**json.loads(json.dumps(found.as_dict())), "bytes": sizes}
    around = report["surroundings"]
    assert [report["against"], around["against"], around["surroundings"]] == ["photos", "renderings", None]

    text = run(*words).stdout.decode()
    head = ("3 photographs, 60x40: ", "c.ply compared with a.ply", "1.0x smaller", "1,500 of 1,500 Gaussians")
    assert all(part in text for part in head)
    printed = rows(text, "images/", "mean")
    assert printed["images/a.png"] == found.views[0].comparison.cells(["PSNR", "SSIM"])
    assert printed["mean"] == found.mean.cells(["PSNR", "SSIM"])
    means = found.mean.reference, found.mean.candidate, found.mean.candidate_vs_reference
    titles = ("reference to photo", "candidate to photo", "candidate to reference")
    below = {row[:22].strip(): row[22:].split() for row in text.splitlines() if row.startswith(titles)}
    assert below == {title: [f"{mean.ms_ssim:.4f}"] for title, mean in zip(titles, means, strict=True)}
    psnr = f"{around['mean']['candidate_vs_reference']['psnr']:.2f}"
    said = f"Beyond the capture: PSNR {psnr} dB to the scene's own renderings from 24 cameras; worst view"
    assert said in " ".join(text.split())


def test_without_views_it_draws_cameras_and_folders_are_scenes_too(folder, tmp_path):
    kissgs.compress(SCENE, tmp_path / "unpacked", settings=kissgs.Settings.from_preset("fast"))
    done = run("evaluate", folder / "b.zip", tmp_path / "unpacked")
    text = done.stdout.decode()
    assert done.returncode == 0, done.stderr
    assert "24 cameras, 96x72: drawn over the whole scene, seed 0" in text
    assert "∞" in text
    assert "photo" not in text


def test_the_cameras_depend_on_the_seed_and_the_distance(folder):
    scenes = kissgs.load(folder / "a.ply"), kissgs.load(folder / "c.ply")
    words = ["evaluate", folder / "a.ply", folder / "c.ply", "--seed", 7]
    report, far = (json.loads(run(*words, *more, "--json").stdout) for more in ([], ["--distance", 3]))
    found = kissgs.evaluate(*scenes, seed=7, distance=3.0)
    assert far["mean"] == json.loads(json.dumps(found.as_dict()))["mean"] != report["mean"]
    text = " ".join(run(*words, "--distance", 3).stdout.decode().split())
    assert "at 3 times the distance" in text
    assert f"W{found.extremes[1:]}." in text
    assert report["worst"]["psnr"] == min(view["candidate_vs_reference"]["psnr"] for view in report["views"])
    other = kissgs.evaluate(*scenes, seed=0).as_dict()
    assert report["worst"]["position"] != json.loads(json.dumps(other))["worst"]["position"]


@pytest.mark.parametrize(("noise", "noted"), [(0.02, False), (0.2, True)])
def test_a_capture_that_fits_poorly_is_noted(folder, tmp_path, noise, noted):
    """Below 18 dB the photographs may be of another scene, which ``compress`` notes too."""
    capture = write_capture(tmp_path / "capture")
    for path in (capture / "images").iterdir():
        image = np.asarray(Image.open(path)) / 255
        noisy = np.clip(image + np.random.default_rng(0).normal(0, noise, image.shape), 0, 1)
        Image.fromarray((255 * noisy).astype(np.uint8)).save(path)
    done = run("evaluate", folder / "a.ply", folder / "a.ply", "--views", capture)
    text = " ".join(done.stdout.decode().split())
    assert ("the photographs differ much from renderings of a.ply: PSNR 1" in text) == noted


def test_views_without_a_test_split_say_so(folder, tmp_path):
    capture = write_capture(tmp_path / "one", names=("only.png",))
    text = run("evaluate", folder / "a.ply", folder / "a.ply", "--views", capture).stdout.decode()
    assert "1 training photograph, 60x40" in text
    assert "no view is held out" in text


def test_missing_photographs_are_reported(folder, tmp_path):
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


def test_a_page_is_written_whole_and_not_over_another(folder, tmp_path):
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


REFUSED = {
    "none.ply b.zip": "no such file",
    "a.ply none.zip": "no such file",
    "a.ply b.zip --views none": "name the folder of a capture",
    "a.ply b.zip --views .": "has no cameras",
    "a.ply b.zip --split val": "choose test, train or all",
    "a.ply b.zip --device tpu": "choose cpu or cuda",
    "a.ply b.zip --distance 0": "give a number above 0",
    "a.ply b.zip --scale 2": "--scale only applies to the photographs",
    "a.ply b.zip --images 2": "--images only applies to the photographs",
    "a.ply b.zip --views capture --scale 2 --images .": "exclude each other",
}


def test_errors_are_one_line(folder):
    for words, expected in REFUSED.items():
        assert expected in failure("evaluate", *words.split(), cwd=folder), words
    photo = folder / "capture" / "images" / "a.png"
    photo.rename(photo.with_suffix(".away"))
    try:
        assert "1 of 3 photographs is missing" in failure(
            "evaluate", "a.ply", "b.zip", "--views", "capture", cwd=folder
        )
    finally:
        photo.with_suffix(".away").rename(photo)


@pytest.mark.quick(0)
def test_compressing_can_evaluate(folder, tmp_path):
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


@pytest.mark.parametrize("preset", ["fast", "balanced", "paper"])
@pytest.mark.quick(1)
def test_every_preset_accepts_views(folder, tmp_path, preset):
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


def test_a_capture_that_cannot_be_read_is_refused_by_every_preset(folder, tmp_path):
    words = "compress", folder / "a.ply", "-p", "fast", "-o", tmp_path / "a.zip"
    assert "there is no folder" in failure(*words, "--views", tmp_path / "none")
    assert run(*words, "--views", folder / "capture", "--quiet").stderr == b""


def test_cancelling_the_evaluation_writes_nothing(tmp_path):
    def stop(stage, fraction):
        if stage == "evaluate" and fraction > 0:
            raise kissgs.Cancelled("enough")

    with pytest.raises(kissgs.Cancelled, match="enough"):
        kissgs.compress(
            SCENE, tmp_path / "a.zip", settings=kissgs.Settings.from_preset("fast"), evaluate=True, progress=stop
        )
    assert list(tmp_path.iterdir()) == []
