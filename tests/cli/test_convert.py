"""``kissgs convert`` as a user runs it. Oracle: the library's own functions."""

import json

import numpy as np
import pytest
from helpers.command_line import failure, run

import kissgs
from kissgs import preview as page_files


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    path = tmp_path_factory.mktemp("convert") / "scene.ply"
    splats = kissgs.sample_scene(600, sh_degree=1)
    splats.sh0[:] = splats.sh0.clip(-1.7, 1.7)  # all colours between 0 and 1
    kissgs.save(splats, path)
    return path


def test_the_ending_decides(scene, tmp_path):
    for ending in ("ply", "compressed.ply", "spz", "glb", "spz.glb"):
        done = run("convert", scene, tmp_path / f"a.{ending}")
        assert (done.returncode, done.stderr) == (0, b"")
        kissgs.save(kissgs.load(scene), tmp_path / f"b.{ending}")
        assert (tmp_path / f"a.{ending}").read_bytes() == (tmp_path / f"b.{ending}").read_bytes()
        assert f"a.{ending}  600 Gaussians" in done.stdout.decode()
    assert run("convert", tmp_path / "a.glb", tmp_path / "c.spz", "-q").returncode == 0
    assert (tmp_path / "c.spz").read_bytes() == (tmp_path / "a.spz").read_bytes()


def test_losses_are_one_line(scene, tmp_path):
    done = run("convert", scene, tmp_path / "a.splat")
    assert done.stderr.decode() == f"kissgs: {tmp_path}/a.splat: view-dependent colour (SH degree 1) is left out\n"
    report = json.loads(run("convert", scene, tmp_path / "a.splat", "--force", "--json").stdout)
    size = (tmp_path / "a.splat").stat().st_size
    assert report == {
        "input": str(scene),
        "output": str(tmp_path / "a.splat"),
        "format": "splat",
        "count": 600,
        "sh_degree": 0,
        "bytes": size,
        "notes": ["view-dependent colour (SH degree 1) is left out"],
    }
    assert run("convert", scene, tmp_path / "a.splat", "-f", "-q").stderr == b""


def test_what_reading_and_cleaning_change_is_in_the_line(tmp_path):
    """Rotations that are no unit quaternions, as all trainers write them, look the same and are not in it."""
    broken = kissgs.sample_scene(50, sh_degree=0)
    broken.means[3], broken.quats[4:6], broken.quats[6] = np.inf, 0, (0, 0, 0, 9)
    kissgs.save(broken, tmp_path / "a.ply")
    named = (tmp_path / "a.ply").read_bytes().replace(b"float nx", b"float label", 1)
    (tmp_path / "a.ply").write_bytes(named)
    done = run("convert", tmp_path / "a.ply", tmp_path / "b.ply")
    assert done.stderr.decode() == (
        f"kissgs: {tmp_path}/b.ply: left out: label; 1 Gaussian removed: a value is NaN or infinite; "
        "2 Gaussians with a rotation of length zero: set to the identity\n"
    )
    assert len(kissgs.load(tmp_path / "b.ply")) == 49
    report = json.loads(run("convert", tmp_path / "a.ply", tmp_path / "b.ply", "--force", "--json").stdout)
    assert len(report["notes"]) == 3


def test_pipes(scene, tmp_path):
    piped = run("convert", "-", "-", "--to", "spz", stdin=scene.read_bytes())
    assert run("convert", "-", tmp_path / "a.glb", stdin=piped.stdout).returncode == 0
    kissgs.save(kissgs.load(scene), tmp_path / "b.spz")
    assert piped.stdout == (tmp_path / "b.spz").read_bytes()
    np.testing.assert_allclose(kissgs.load(tmp_path / "a.glb").means, kissgs.load(tmp_path / "b.spz").means)


def test_compressed_ply_is_an_ending(scene, tmp_path):
    """An output beside the input never has its name, and a plain .ply is not named like a compressed one."""
    packed = tmp_path / "a.compressed.ply"
    assert run("convert", scene, packed).returncode == 0
    for kind in ("ply", "compressed.ply", "spz"):
        assert run("convert", packed, f"{tmp_path}/out/", "--to", kind, "-q").returncode == 0
    assert not kissgs.read_ply_info(tmp_path / "out" / "a.ply").compressed
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["a.compressed.ply", "a.ply", "a.spz"]
    assert run("compress", packed, "-p", "fast", "-q").returncode == 0
    assert (tmp_path / "a.zip").exists()


REFUSED = {
    "scene.ply a.sog": "kissgs compress writes those",
    "scene.ply a.zip": "kissgs compress writes those",
    "scene.ply a.sog --to spz": "kissgs compress writes those",
    "scene.ply folder": "has no ending of a format",
    "scene.ply a.ksplat": "has no ending of a format",
    "scene.ply a.gltf --to glb": "has no ending of a format",
    "scene.ply": "needs an input and an output: kissgs convert IN OUT",
    "scene.ply -": "standard output has no ending; give --to",
    "scene.ply b.spz --to ksplat": "--to ksplat is no format that is written; choose ply,",
    "scene.ply a.ply --to spz": "has the ending of ply, but --to asks for spz",
    "scene.ply - --to spz --json": "both write to standard output",
    "none.ply b.spz": "no such file",
    "scene.ply a.spz": "exists already",
    "scene.ply empty.ply a.spz": "cannot all become",
    "empty.ply b.glb": "without Gaussians cannot be written as .glb",
    "boxes scene.ply more/ --to spz": "boxes is a folder without a scene",
}


def test_errors(scene, tmp_path):
    (tmp_path / "scene.ply").write_bytes(scene.read_bytes())
    (tmp_path / "a.spz").write_bytes(b"mine")
    (tmp_path / "boxes").mkdir()
    kissgs.save(kissgs.sample_scene(0), tmp_path / "empty.ply")
    for words, expected in REFUSED.items():
        assert expected in failure("convert", *words.split(), cwd=tmp_path), words
    assert (tmp_path / "a.spz").read_bytes() == b"mine"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.spz", "boxes", "empty.ply", "more", "scene.ply"]


WAYS_TO_READ = {
    "compress": ("-p", "fast", "-o", "o.zip"),
    "compress into a pipe": ("-p", "fast", "-o", "-"),
    "compact": ("--ratio", "0.5", "--method", "merge", "-o", "o.ply"),
    "compact into a pipe": ("--ratio", "0.5", "--method", "merge", "-o", "-"),
    "convert": ("o.spz",),
    "decompress": ("-o", "o.ply"),
    "decompress into a pipe": ("-o", "-"),
    "evaluate": ("in.splat",),
    "render": ("--size", "16x16", "-o", "o.png"),
    "info": (),
    "view": ("-o", "o.html"),
}


@pytest.mark.parametrize("way", WAYS_TO_READ)
def test_every_command_says_what_reading_cleans(way, tmp_path):
    if way == "view" and not (page_files.ROOT / "web_decoder" / "vendor").exists():
        pytest.skip("scripts/vendor has not run")
    kissgs.save(kissgs.sample_scene(50, sh_degree=0), tmp_path / "a.splat")
    rows = np.frombuffer((tmp_path / "a.splat").read_bytes(), np.uint8).reshape(-1, 32).copy()
    rows[3, 28:] = 128  # (byte - 128) / 128
    (tmp_path / "in.splat").write_bytes(rows.tobytes())
    done = run(way.split(maxsplit=1)[0], "in.splat", *WAYS_TO_READ[way], cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    piped = WAYS_TO_READ[way][-1:] == ("-",)
    said = b" ".join((b"" if piped else done.stdout).split() + done.stderr.split()).decode()
    assert "1 Gaussian with a rotation of length zero: set to the identity" in said
