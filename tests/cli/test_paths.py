"""Invalid paths in every argument and option that takes one: a one-line error and exit code 2, never a traceback."""

import os
import shutil
import tempfile
from pathlib import Path

import pytest
from helpers.captured_scene import SCENE, write_capture
from helpers.command_line import failure, run

import kissgs

SMALL = SCENE.select(slice(0, 40))

PLACES = [  # of paths that go through one function, one
    "compress BAD",
    "compress BAD other.ply -o out/",
    "compress BAD --cache",
    "compress BAD --checkpoint --compact 20%",
    "compress scene.ply -p fast -o BAD",
    "compress scene.ply -p fast -o BAD.zip",
    "compress scene.ply -p fast -o BAD --unpacked",
    "compress scene.ply -p paper --evaluate -o out.zip --views BAD",
    "decompress BAD",
    "decompress BAD.zip -o out.ply",
    "decompress scene.zip -o BAD.ply",
    "convert BAD other.ply out --to spz",
    "convert scene.ply BAD.spz",
    "convert scene.ply BAD --to spz",
    "info BAD BAD",
    "evaluate BAD scene.zip",
    "evaluate scene.ply BAD",
    "evaluate scene.ply scene.zip --views capture --images BAD",
    "evaluate scene.ply scene.zip --html BAD",
    "render BAD",
    "render scene.ply -o BAD.png",
    "render scene.ply --views BAD",
    "render scene.ply --view BAD.json",
    "render scene.ply --save-camera BAD -o out.png",
    "compact BAD --ratio 0.5 --checkpoint -o out.ply",
    "compact scene.ply --ratio 0.5 -o BAD.ply",
    "compact scene.ply --ratio 0.5 -o out.ply --views BAD",
    "sample BAD.ply",
    "bench BAD -p fast",
    "bench scene.ply -p fast -o BAD.csv",
    "remote compress BAD",
    "remote compress scene.ply -o BAD.zip",
    "remote get 123 -o BAD",
]

KINDS = {
    "too long": "a" * 300,
    "a folder that is too long": "a" * 300 + "/b",
    "within a file": "scene.ply/inner",
    "a loop": "loop",
    "no permission": "locked/inner",
    "a link to what is locked": "link",
    "too long with an asterisk": "*" + "a" * 300,
}


def ignores_permissions(path):
    """Whether this user, such as root, can read a folder without permission."""
    return os.access(path, os.R_OK)


@pytest.fixture(scope="module")
def folder():
    """Folder with the scene in several forms, and with unusable paths."""
    with tempfile.TemporaryDirectory() as name:
        path = Path(name)
        (path / "loop").symlink_to("loop")
        (path / "locked").mkdir(mode=0o000)
        (path / "link").symlink_to("locked/inner")
        for ply in ("scene.ply", "other.ply"):
            kissgs.save(SMALL, path / ply)
        kissgs.compress(SMALL, path / "scene.zip", settings=kissgs.Settings.from_preset("fast"))
        write_capture(path / "capture")
        yield path


def takes(place, kind):
    """Whether this kind of path is invalid there: patterns only apply to inputs, and ``loop.zip`` is no loop."""
    if kind == "too long with an asterisk":
        return place.split()[:2][-1] == "BAD" and place != "sample BAD"
    return not ("BAD." in place and kind in ("a loop", "a link to what is locked"))


def said(words, kind, folder):
    """Run a command that must end with exit code 2; return its lines on standard error."""
    done = run(*(word.replace("BAD", KINDS.get(kind, kind)) for word in words.split()), cwd=folder)
    assert done.returncode == 2, (words, done)
    shutil.rmtree(folder / "out", ignore_errors=True)  # the output of another input
    return done.stderr.decode().splitlines()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.quick(2)
def test_invalid_paths_give_one_line(kind, folder):
    if "lock" in KINDS[kind] + kind and ignores_permissions(folder / "locked"):
        pytest.skip("this user ignores permissions")
    before = sorted(folder.iterdir())
    for place in PLACES:
        if takes(place, kind):
            lines = said(place, kind, folder)
            assert 1 <= len(lines) <= 2, (place, lines)
            assert all(line.startswith("kissgs: ") for line in lines), (place, lines)
            assert sorted(folder.iterdir()) == before, place


@pytest.mark.parametrize("kind", ["too long", "a folder that is too long", "within a file", "missing/inner"])
@pytest.mark.quick(2)
def test_the_error_names_the_input(kind, folder):
    """Regression: the error named the output, whose path is derived from the input."""
    for words in ("compress BAD", "compress BAD other.ply -o out/", "decompress BAD", "render BAD"):
        assert said(words, kind, folder)[0].startswith(f"kissgs: cannot read {KINDS.get(kind, kind)[:100]}"), words


@pytest.mark.quick(0)
def test_a_name_that_is_too_long_with_another_ending(folder, tmp_path):
    """The files next to the scene have longer names than the scene."""
    scene = tmp_path / ("a" * 251 + ".ply")
    shutil.copy(folder / "scene.ply", scene)
    for words in (["--cache"], ["--checkpoint", "--compact", "50%"], ["--unpacked", "-p", "fast"]):
        assert "name too long" in failure("compress", scene, *words)
    assert [path.name for path in tmp_path.iterdir()] == [scene.name]


@pytest.mark.parametrize("name", ["a\0b", "loop", "\0.zip", "a" * 300])
@pytest.mark.quick(2)
def test_the_library_raises_its_own_errors(name, folder, monkeypatch):
    monkeypatch.chdir(folder)
    kept = "loop/x" if name == "loop" else name  # a link is replaced, wherever it leads
    few = kissgs.Settings.research(
        "balanced", compact={"count": 9, "sparsify_steps": 2, "refine_steps": 2, "views": 8, "view_size": 32}
    )
    for work in (
        lambda: kissgs.load(name),
        lambda: kissgs.decompress(name),
        lambda: kissgs.decompress("scene.zip", f"{name}.ply" if name != "loop" else "loop/x.ply"),
        lambda: kissgs.compress(name),
        lambda: kissgs.compress(SMALL, name),
        lambda: kissgs.compress(SMALL, cache=kept),
        lambda: kissgs.compress(SMALL, checkpoint=kept, settings=few),
        lambda: kissgs.save(SMALL, f"{name}/x.ply"),
        lambda: kissgs.load_views(Path(name)),
        lambda: kissgs.read_ply_info(Path(name)),
    ):
        with pytest.raises(kissgs.KissgsError):
            work()
