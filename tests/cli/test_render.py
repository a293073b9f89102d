"""``kissgs render`` as a user runs it. Oracle: the library's own renderings and views, read back by Pillow."""

import io
import json
import os
import runpy
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from helpers.captured_scene import SCENE
from helpers.command_line import KISSGS, failure, run
from PIL import Image
from rich.console import Console
from rich.text import Text

import kissgs
from kissgs.cameras.captures.transforms_json import read_cameras
from kissgs.cameras.virtual.select import best_view
from kissgs.cli import files as console
from kissgs.core.splats import clean
from kissgs.rendering.images import reframed
from kissgs.rendering.metrics import psnr


@pytest.fixture(scope="module")
def virtual():
    return kissgs.virtual_views(SCENE, width=80, height=60)


def by_name(views):
    return sorted(views.train + views.test, key=lambda view: view.name)


def shown(camera, scene=SCENE, background=(0, 0, 0)):
    """Render with the library, and round to 8 bits per channel."""
    image, _ = kissgs.render(scene, camera, background=background)
    return (255 * image.astype(np.float64)).round().clip(0, 255).astype(np.uint8)


def pixels(source):
    with Image.open(io.BytesIO(source) if isinstance(source, bytes) else source) as image:
        return np.asarray(image.convert("RGB"))


def close(one, other):
    """Whether two images are equal except for the rounding of values at .5."""
    return (
        one.shape == other.shape and int(np.abs(one.astype(int) - other).max()) <= 1 and (one == other).mean() > 0.999
    )


def test_the_default_is_the_best_virtual_view_next_to_the_scene(folder, tmp_path, virtual):
    (tmp_path / "mine.ply").write_bytes((folder / "a.ply").read_bytes())
    done = run("render", "mine.ply", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    best = best_view(SCENE, width=1280, height=960)
    assert close(pixels(tmp_path / "mine.png"), shown(best.camera))
    assert done.stdout.decode() == f"mine.png  1280x960, {best.name} (best of the virtual cameras)\n"
    assert best_view(SCENE, width=80, height=60).name in [view.name for view in by_name(virtual)]
    assert "exists already" in failure("render", "mine.ply", cwd=tmp_path)
    assert run("render", "mine.ply", "-f", "-q", "--size", "80x60", cwd=tmp_path).stdout == b""
    assert pixels(tmp_path / "mine.png").shape == (60, 80, 3)


def test_virtual_views_by_number_and_name(folder, tmp_path, virtual):
    fourth = by_name(virtual)[3]
    for which in ("3", fourth.name):
        done = run("render", folder / "b.zip", "-o", "-", "--view", which, "--size", "80x60", "--background", "#ff8000")
        scene, _ = clean(kissgs.decompress(folder / "b.zip"))
        view = by_name(kissgs.virtual_views(scene, width=80, height=60))[3]
        assert view.name == fourth.name
        assert close(pixels(done.stdout), shown(view.camera, scene, (1, 128 / 255, 0)))


def test_views_of_a_capture_have_their_own_size(folder, tmp_path):
    capture = by_name(kissgs.load_views(folder / "capture"))
    words = ["render", folder / "a.ply", "--views", folder / "capture", "-o", tmp_path / "a.png", "--force"]
    for which, view in ((None, capture[0]), ("1", capture[1]), ("c", capture[2]), ("images/b.png", capture[1])):
        assert run(*words, *(() if which is None else ("--view", which))).returncode == 0
        assert close(pixels(tmp_path / "a.png"), shown(view.camera))
    done = run(*words, "--size", "120x40", "--json")
    report = json.loads(done.stdout)
    camera = reframed(capture[0].camera, 120, 40)
    assert close(pixels(tmp_path / "a.png"), shown(camera))
    assert (report["output"], report["width"], report["height"]) == (str(tmp_path / "a.png"), 120, 40)
    assert report["bytes"] == (tmp_path / "a.png").stat().st_size
    assert (report["frames"], len(report["cameras"]), report["cameras"][0]["name"]) == (1, 1, "images/a.png")
    assert np.array_equal(report["cameras"][0]["K"], camera.K)


def test_a_saved_camera_renders_the_same_image(folder, tmp_path):
    kept = tmp_path / "kept.json"
    words = ["render", folder / "a.ply", "-o"]
    done = run(*words, tmp_path / "a.png", "--size", "80x60", "--view", "5", "--save-camera", kept)
    assert str(kept) in done.stdout.decode()
    assert run(*words, tmp_path / "b.png", "--view", kept).returncode == 0
    assert np.array_equal(pixels(tmp_path / "a.png"), pixels(tmp_path / "b.png"))
    (tmp_path / "cameras.json").write_text(f"[{kept.read_text()}, {kept.read_text()}]")
    assert run(*words, tmp_path / "c.png", "--view", f"{tmp_path}/cameras.json:1").returncode == 0
    assert np.array_equal(pixels(tmp_path / "a.png"), pixels(tmp_path / "c.png"))
    assert read_cameras(kept)[0].camera.width == 80
    taken = failure(*words, tmp_path / "d.png", "--size", "8x6", "--save-camera", kept)
    assert f"{kept} exists already" in taken
    assert not (tmp_path / "d.png").exists()


def test_an_orbit_is_an_animation_or_a_contact_sheet(folder, tmp_path):
    words = ["render", folder / "a.ply", "--orbit", "--size", "40x30", "--json", "-o"]
    report = json.loads(run(*words, tmp_path / "a.webp", "--frames", "9").stdout)
    assert (report["width"], report["height"], report["frames"], len(report["cameras"])) == (40, 30, 9, 9)
    with Image.open(tmp_path / "a.webp") as film:
        assert (film.n_frames, film.info["loop"]) == (9, 0)
        durations = []
        for number in range(9):
            film.seek(number)
            film.load()
            durations.append(film.info["duration"])
            if number == 4:
                entry = report["cameras"][4]
                camera = kissgs.Camera(np.array(entry["viewmat"]), np.array(entry["K"]), 40, 30)
                assert psnr(np.asarray(film.convert("RGB")) / 255, shown(camera) / 255) > 28
    assert sum(durations) == 9 * 1000 // 12
    report = json.loads(run(*words, tmp_path / "a.png", "--frames", "6").stdout)
    assert (report["frames"], len(report["cameras"])) == (1, 6)
    assert pixels(tmp_path / "a.png").shape == (report["height"], report["width"], 3)
    assert report["width"] > 2 * 40


def test_a_sheet_has_all_views(folder, tmp_path):
    words = ["render", folder / "a.ply", "--sheet", "--size", "60x40"]
    done = run(*words, "--views", folder / "capture", "-o", tmp_path / "a.png")
    assert ", 3 views, 1 held out (cameras of " in done.stdout.decode()
    sheet = pixels(tmp_path / "a.png")
    first = shown(kissgs.load_views(folder / "capture").test[0].camera)
    assert close(sheet[4:44, 4:64], first)
    report = json.loads(run(*words, "-o", tmp_path / "b.png", "--json").stdout)
    assert [camera["name"] for camera in report["cameras"]] == [f"virtual_{n:02}" for n in range(32)]


REFUSED = {
    "--view 3 --orbit": "--view and --orbit: choose one",
    "--sheet --orbit": "--orbit and --sheet: choose one",
    "--orbit --views capture": "computes its own cameras",
    "--view a.json --views capture": "is a camera file",
    "--sheet --save-camera a.json": "leave out --save-camera",
    "--frames 9": "leave out --frames: it only applies to --orbit",
    "-o OUT.jpg": "written as .png or .webp",
    "-o none/a.png": "no folder",
    "-o - --json": "both write to standard output",
    "-o OUT.png --view nobody": "nobody",
    "-o OUT.png --view 32 --size 80x60": "numbers go from 0 to 31",
    "-o OUT.png --size 10": "give WIDTHxHEIGHT",
    "-o OUT.png --size 0x9": "give WIDTHxHEIGHT",
    "-o OUT.png --size 9x-1": "give WIDTHxHEIGHT",
    "-o OUT.png --size 1e3x9": "give WIDTHxHEIGHT",
    "-o OUT.png --background red": "give black, white or #rrggbb",
    "-o OUT.png --background #12345": "give black, white or #rrggbb",
    "-o OUT.png --background #1234567": "give black, white or #rrggbb",
    "-o OUT.png --device tpu": "choose cpu or cuda",
    "-o OUT.png --scale 2": "--scale only applies to the photographs",
    "-o OUT.png --view none.json": "no such file",
    "-o OUT.png --size 60000x60000 --view 0": "too much memory",
    "-o OUT.webp --size 16384x1 --view 0": "16,383 pixels a side",
}


def test_impossible_requests_are_refused(folder, tmp_path):
    for words, expected in REFUSED.items():
        options = words.replace("OUT", str(tmp_path / "a")).split()
        assert expected in failure("render", "a.ply", *options, cwd=folder), words
    assert "not standard input" in failure("render", "-", "-o", tmp_path / "a.png")
    assert "no such file" in failure("render", tmp_path / "none.ply", "-o", tmp_path / "a.png").lower()
    assert list(tmp_path.iterdir()) == []


def test_an_interrupted_animation_leaves_no_file(folder, tmp_path):
    words = ["render", folder / "a.ply", "--orbit", "--frames", "3600", "-o", tmp_path / "a.webp"]
    with subprocess.Popen([KISSGS, *map(str, words)], stderr=subprocess.PIPE) as process:
        time.sleep(2)
        process.send_signal(signal.SIGINT)
        _, message = process.communicate(timeout=300)
    assert process.returncode == 130
    assert message.decode() == "kissgs: interrupted; no partial file is left\n"
    assert list(tmp_path.iterdir()) == []


def test_compilation_is_announced_when_it_happens(tmp_path, capsys):
    """Regression: a timer announced it to whoever had a slow disk, and a second "kernels" stage raised."""
    module = tmp_path / "kernel.py"
    module.write_text(
        "from kissgs.core.numba_kernels import compiled\n@compiled('int64(int64)')\ndef f(x): return x\nf(1)\n"
    )
    for expected in (1, 0):
        with console.progress_bar(False) as progress:
            for _ in range(2):
                progress("kernels", 0.0)
                runpy.run_path(str(module))
                progress("kernels", 1.0)
            progress("render", 0.5)
        assert capsys.readouterr().err.count("compiling kernels (once; cached from then on)") == expected


def test_the_clock_of_the_progress_bar_runs_through_all_stages(monkeypatch, capsys):
    """Regression: it stopped for good when the first stage was complete."""
    now = 0.0
    monkeypatch.setattr(console, "Console", partial(Console, force_terminal=True, get_time=lambda: now))
    with console.progress_bar(False) as progress:
        progress("read", 1.0)
        now = 75.0
        progress("order", 0.5)
    assert "0:01:15" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("later", "expected"), [(0, "about 1 min left"), (21, "about 40 s left"), (59, "about 1 s left"), (61, "expected")]
)
def test_one_bar_over_the_whole_command_counts_the_time_left_down(monkeypatch, capsys, later, expected):
    now = 5.0
    monkeypatch.setattr(console, "Console", partial(Console, force_terminal=True, width=120, get_time=lambda: now))
    with console.progress_bar(False) as progress:
        progress("sparsify", 0.25, "9 Gaussians", seconds_left=60.0)
        now += later
    line = Text.from_ansi(capsys.readouterr().err).plain.splitlines()[-1]
    assert f"25 % 0:0{later // 60}:{later % 60:02}, " in line
    assert f"{expected} training; 9 Gaussians" in line


def test_estimates_have_few_digits():
    seconds = (0.2, 7.4, 12, 41, 54.9, 200, 5000, 5400)
    texts = ["1 s", "7 s", "10 s", "40 s", "55 s", "3 min", "83 min", "1.5 h"]
    assert [console.roughly(each) for each in seconds] == [f"about {text}" for text in texts]


@pytest.mark.parametrize("torch", ["", "import sys; sys.modules['torch'] = None; "], ids=["torch", "no torch"])
@pytest.mark.quick(0)
def test_warmup_compiles_all_kernels(torch, tmp_path):
    """A kernel compiles at its first call, so that one that is not loaded here is compiled later."""
    home = Path(kissgs.__file__).parents[1]
    sources = {path: path.read_text(encoding="utf-8") for path in home.glob("kissgs/**/*.py")}
    needless = {"finetuning", "training"} if torch else set()  # without it nothing is trained
    wanted = sum(text.count("\n@compiled(") for path, text in sources.items() if path.parent.name not in needless)
    lines = torch + "from kissgs.cli import bench; from kissgs.core.numba_kernels import kernels; "
    lines += "bench.SAMPLE_COUNT = 500; bench.warmup(); "
    lines += "print(len(kernels), all(kernel.signatures for kernel in kernels))"
    places = {**os.environ, "XDG_CACHE_HOME": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", lines], capture_output=True, timeout=300, check=True, env=places)
    assert done.stdout.decode().split() == [str(wanted), "True"]
    assert wanted > 50
    assert 0.01 < json.loads((tmp_path / "kissgs/speed.json").read_text())["speed_per_processor"] < 100
