"""The command line as a user runs it. Oracle: the library's own functions, and the promises of the README."""

from __future__ import annotations

import errno
import json
import os
import signal
import subprocess
import sys
import time
import zipfile
from pathlib import Path

import pytest
from helpers.command_line import KISSGS, failure, run

import kissgs


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("cli") / "scene.ply"
    kissgs.save(kissgs.sample_scene(600, sh_degree=1), path)
    return path


def test_compress_and_decompress(scene: Path, tmp_path: Path) -> None:
    """Regression: square brackets in names were parsed as rich markup."""
    done = run("compress", scene, "-o", tmp_path / "[red]a.zip")
    assert done.returncode == 0
    assert "[red]a.zip" in done.stdout.decode()
    assert run("decompress", tmp_path / "[red]a.zip", "-o", tmp_path / "b.ply").returncode == 0
    assert (tmp_path / "[red]a.zip").read_bytes() == kissgs.compress(scene).to_zip()
    assert len(kissgs.load(tmp_path / "b.ply")) == len(kissgs.decompress(tmp_path / "[red]a.zip"))
    assert run("sample", tmp_path / "s.ply", "--gaussians", 500).returncode == 0
    assert len(kissgs.load(tmp_path / "s.ply")) == 500


def test_default_outputs_are_next_to_the_input(scene: Path, tmp_path: Path) -> None:
    here = tmp_path / "mine.ply"
    here.write_bytes(scene.read_bytes())
    assert run("compress", "mine.ply", cwd=tmp_path).returncode == 0
    assert zipfile.is_zipfile(tmp_path / "mine.zip")
    assert "exists already" in failure("decompress", "mine.zip", cwd=tmp_path)
    assert run("decompress", "mine.zip", "--force", cwd=tmp_path).returncode == 0


def test_pipes(scene: Path) -> None:
    packed = run("compress", "-", "-o", "-", "-q", stdin=scene.read_bytes())
    assert packed.stdout == kissgs.compress(scene).to_zip()
    back = run("decompress", "-", "-o", "-", stdin=packed.stdout)
    assert back.stdout.startswith(b"ply\nformat binary_little_endian")


def test_several_files_and_patterns(scene: Path, tmp_path: Path) -> None:
    """One bad file does not stop the others."""
    for name in ("a.ply", "c.ply"):
        (tmp_path / name).write_bytes(scene.read_bytes())
    (tmp_path / "b.ply").write_text("not a scene")
    done = run("compress", tmp_path / "*.ply", "-o", f"{tmp_path}/out/", "--json", "-p", "fast")
    assert done.returncode == 2
    first, second, third = json.loads(done.stdout)
    assert second["error"]["code"] == "invalid-scene"
    assert [Path(report["output"]).name for report in (first, third)] == ["a.zip", "c.zip"]
    assert all(Path(report["output"]).stat().st_size == report["container_bytes"] for report in (first, third))
    assert "cannot all become" in failure("compress", tmp_path / "*.ply", "-o", tmp_path / "x.zip")
    assert "no file matches" in failure("compress", tmp_path / "*.nothing")


@pytest.mark.parametrize("words", [["compress", "scene.ply", "new.zip"], ["decompress", "old.zip", "new.ply"]])
def test_an_output_without_its_option_is_refused_before_any_work(scene: Path, tmp_path: Path, words: list[str]) -> None:
    (tmp_path / "scene.ply").write_bytes(scene.read_bytes())
    run("compress", "scene.ply", "-o", "old.zip", "-p", "fast", cwd=tmp_path)
    assert failure(*words, cwd=tmp_path).endswith(f"does not exist; if it is the output, name it with -o {words[2]}")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["old.zip", "scene.ply"]


def test_info_of_both_kinds(scene: Path, tmp_path: Path) -> None:
    container = tmp_path / "a.zip"
    run("compress", scene, "-o", container, "-q")
    ply, zipped = json.loads(run("info", scene, container, "--json").stdout)
    assert (ply["kind"], ply["count"], ply["sh_degree"]) == ("ply", 600, 1)
    assert (zipped["kind"], zipped["sh_degree"]) == ("sogxt", 1)
    assert zipped["count"] == len(kissgs.decompress(container))
    assert sum(zipped["parts"].values()) < zipped["bytes"] == container.stat().st_size
    table = run("info", container).stdout.decode()
    assert "means_bytes_0.webp" in table
    assert "bits per Gaussian" in table


@pytest.mark.quick(0)
def test_goals_and_cached_sensitivity(scene: Path, tmp_path: Path) -> None:
    few_views = "--set", "sensitivity_views=4", "--set", "sensitivity_view_size=48"
    copy = tmp_path / "scene.ply"
    copy.write_bytes(scene.read_bytes())
    done = run("compress", copy, "--target-size", "13kB", "--finetune", "0", "--cache", *few_views)
    assert b"container, kept" in done.stdout
    assert 12_610 <= (tmp_path / "scene.zip").stat().st_size <= 13_000
    assert sorted(file.name for file in tmp_path.iterdir()) == ["scene.ply", "scene.sensitivity.npz", "scene.zip"]
    report = json.loads(
        run("compress", copy, "-f", "--psnr", "38", "--cache", "--evaluate", "--json", *few_views).stdout
    )
    assert "sensitivity" not in report["seconds"]
    assert any(trial["bytes"] == report["container_bytes"] and trial["psnr"] >= 38 for trial in report["trials"])
    assert (
        report["evaluation"]["mean"]["candidate_vs_reference"]["psnr"] > 37
    )  # from other cameras than those of the search
    assert "psnr needs rate_distortion" in failure("compress", copy, "-f", "-p", "fast", "--psnr", "40")
    assert "setting time_limit: write 30s, 2min, 1h" in failure("compress", copy, "-f", "--time", "soon")
    piped = failure("compress", "-", "-o", tmp_path / "b.zip", "--cache", stdin=scene.read_bytes())
    assert "standard input has no folder" in piped


def test_settings_from_the_command_line(scene: Path, tmp_path: Path) -> None:
    done = run("compress", scene, "-o", tmp_path / "a.zip", "--json", "--set", "sh_neighbors=16", "--seed", "3")
    report = json.loads(done.stdout)
    assert (report["source_count"], report["container_bytes"]) == (600, (tmp_path / "a.zip").stat().st_size)
    settings = json.loads(run("info", tmp_path / "a.zip", "--json").stdout)["details"]["settings"]
    assert (settings["sh_neighbors"], settings["seed"]) == (16, 3)
    assert "there is no setting 'bits'" in failure("compress", scene, "-o", tmp_path / "b.zip", "--set", "bits=16")
    assert "NAME=VALUE" in failure("compress", scene, "-o", tmp_path / "b.zip", "--set", "bits")
    assert "write GROUP.NAME=VALUE" in failure("compress", scene, "-o", tmp_path / "b.zip", "--set", "preset=small")
    assert "fast, balanced, small, paper" in failure("compress", scene, "-o", tmp_path / "b.zip", "-p", "huge")


def test_errors_are_one_line(scene: Path, tmp_path: Path) -> None:
    assert "no such file" in failure("compress", tmp_path / "none.ply", "-o", tmp_path / "a.zip").lower()
    (tmp_path / "text.ply").write_text("hello")
    failure("compress", tmp_path / "text.ply", "-o", tmp_path / "a.zip")
    (tmp_path / "bad.zip").write_bytes(b"PK\x03\x04 but no more")
    failure("decompress", tmp_path / "bad.zip", "-o", tmp_path / "a.ply")
    failure("info", tmp_path / "none.zip")
    assert json.loads(run("info", tmp_path / "none.ply", "--json").stdout)["error"]["code"] == "invalid-scene"
    assert "no folder" in failure("compress", scene, "-o", tmp_path / "missing" / "a.zip")
    assert "both write" in failure("compress", scene, "-o", "-", "--json")
    assert "give the output with -o" in failure("compress", "-", stdin=b"")
    assert (
        "standard input is closed"
        in subprocess.run(
            f"{KISSGS} compress - -o {tmp_path}/q.zip <&-", shell=True, capture_output=True, text=True, check=False
        ).stderr
    )
    assert "has no name" in failure("decompress", "/")
    assert (
        "no space left"
        in subprocess.run(
            f"{KISSGS} info {scene} > /dev/full", shell=True, capture_output=True, text=True, check=False
        ).stderr
    )
    expected = (2, "kissgs: cannot write to standard output: no space left on device\n")
    for words in (f"info {scene} --json", "compact --help"):
        for environment in (None, {}):  # with and without what a terminal sets, on which the help's output depends
            full = subprocess.run(
                f"{KISSGS} {words} > /dev/full",
                shell=True,
                capture_output=True,
                text=True,
                check=False,
                env=environment,
            )
            assert (full.returncode, full.stderr) == expected
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bad.zip", "text.ply"]


def test_a_folder_as_output_means_into_it_for_one_file_as_for_many(scene: Path, tmp_path: Path) -> None:
    assert "there is no folder new; end it in a slash" in failure("decompress", scene, "-o", "new", cwd=tmp_path)
    assert run("compress", scene, "-o", f"{tmp_path}/new/", "-q").returncode == 0
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["scene.zip"]
    assert run("compress", scene, "-o", tmp_path / "new", "-q", "--unpacked").returncode == 0
    assert len(kissgs.load(tmp_path / "new" / "scene.container")) > 0


def test_no_folder_gets_the_name_of_a_file(scene: Path, tmp_path: Path) -> None:
    """Regression: compress -o a.spz made a folder a.spz, and wrote a SOG-XT container into it."""
    for name in ("a.spz", "a.Yaml", "x.usdz", "full.ziip", ".zip", "a.zip.", "v1.2", "new", "new/room"):
        assert f"{name} is not the name of a container" in failure("compress", scene, "-o", name, cwd=tmp_path)
    for name in ("x.usdz", ".zip", "a.zip.", "v1.2"):
        with pytest.raises(kissgs.UnsupportedError, match=rf"{name} is not the name of .* in \.zip or \.sog, or if"):
            kissgs.compress(scene, tmp_path / name)
    for name in ("lod_meta.json", "new/meta.json", "LOD-META.JSON"):
        refused = f"{name} is not the name of a container: end it in .zip or .sog; levels of detail, which "
        assert refused in failure("compress", scene, "-o", name, cwd=tmp_path)
        with pytest.raises(kissgs.UnsupportedError, match=f"^{refused}.* are FOLDER/lod-meta"):
            kissgs.compress(scene, name)
    for name in ("city/lod-meta.json", "city.sogxt"):
        with pytest.raises(
            kissgs.UnsupportedError, match=r"end it in \.zip or \.sog; .*kissgs\.compress_streamed write"
        ):
            kissgs.compress(scene, tmp_path / name)
    for name, command in (("a.spz", "convert"), ("a.sog", "compress")):
        sentence = f"{name} has the ending of another format than .ply, which this command writes; use kissgs {command}"
        assert sentence in failure("decompress", scene, "-o", name, cwd=tmp_path)
    assert "end it in .ply, or if it is a folder" in failure("decompress", scene, "-o", "meta.json", cwd=tmp_path)
    unpacked = failure("compress", scene, "-o", "a.sog", "--unpacked", cwd=tmp_path)
    assert "a.sog is the name of a file, but --unpacked" in unpacked
    assert "would become one file" in failure("compress", scene, scene, "-o", "new/", cwd=tmp_path)
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "c.sog").mkdir()
    assert run("compress", scene, "-o", tmp_path / "c.sog", "-p", "fast", "-q", "--unpacked").returncode == 0


@pytest.mark.parametrize(
    ("words", "known"),
    [
        ("compress scene.ply -o full.ziip", ".zip or .sog"),
        ("compress scene.ply -o k.ssog --container sog", ".zip or .sog"),
        ("compress scene.ply -o k.ssog --unpacked", "a slash"),
        ("remote compress scene.ply -o out.xyz", ".zip or .sog"),
        ("remote get 1 -o out.xyz", ".zip or .sog"),
        ("decompress scene.ply -o x.usdz", ".ply"),
        ("compact scene.ply --ratio 0.5 -o x.plyy", ".ply"),
        ("convert scene.ply x.usdz", ".spz, .splat"),
        ("convert scene.ply x.usdz --to spz", ".spz"),
        ("render scene.ply -o x.gif", ".png or .webp"),
        ("sample x.usdz", ".spz, .splat"),
    ],
)
def test_an_unknown_ending_makes_no_folder(scene: Path, tmp_path: Path, words: str, known: str) -> None:
    (tmp_path / "scene.ply").write_bytes(scene.read_bytes())
    assert known in failure(*words.split(), cwd=tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["scene.ply"]


@pytest.mark.parametrize("name", ["x.usdz/", "new/", "a/v1.2/", "made.d"])
def test_names_of_folders(scene: Path, tmp_path: Path, name: str) -> None:
    """A slash, or a folder that exists."""
    (tmp_path / "made.d").mkdir()
    assert run("convert", scene, name, "--to", "ply", "-q", cwd=tmp_path).returncode == 0
    assert [path.parent for path in tmp_path.rglob("*.ply")] == [tmp_path / name]


@pytest.mark.parametrize("command", ["compress", "decompress", "info", "render"])
def test_a_folder_that_is_no_container_is_named_with_what_to_give(scene: Path, tmp_path: Path, command: str) -> None:
    trained = "point_cloud/iteration_7000/point_cloud.ply"
    for path in (tmp_path / "trained" / trained, tmp_path / "adir" / "scene.ply", tmp_path / "notes" / "a.txt"):
        path.parent.mkdir(parents=True)
        path.write_bytes(scene.read_bytes())
    assert "adir is a folder, not a scene; name a file in it: scene.ply" in failure(command, "adir", cwd=tmp_path)
    assert f"it: {trained}" in failure(command, tmp_path / "trained")
    assert "notes is a folder without a scene" in failure(command, "notes", cwd=tmp_path)


@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "cp1252"])
def test_standard_output_escapes_what_its_encoding_lacks(scene: Path, tmp_path: Path, encoding: str) -> None:
    """The expected bytes are those of Python's own error handler for standard error."""
    name = "日本 ü\udcff.ply"
    (tmp_path / name).write_bytes(scene.read_bytes())
    done = run("info", name, cwd=tmp_path, encoding=encoding)
    assert (done.returncode, done.stderr) == (0, b"")
    assert done.stdout.startswith(name.encode(encoding, "backslashreplace"))
    assert b"\\u2026" in run("compress", "--help", encoding="ascii").stdout
    done = run("convert", name, "ü.ply", "--json", cwd=tmp_path, encoding=encoding)
    assert json.loads(done.stdout)["input"] == name


@pytest.mark.parametrize("option", ["--unpacked", "--quiet"])
def test_a_disk_that_fills_up_leaves_no_file(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, option: str
) -> None:

    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    words = ["compress", scene, "-p", "fast", "-o", f"{tmp_path}/new/", option]
    assert "no space left on device" in failure(*words)
    assert sorted(tmp_path.rglob("*")) == [tmp_path / "new"]  # which another command may be about to write into


def test_an_interrupt_inside_a_finalizer_is_not_lost() -> None:
    """Python prints and ignores exceptions of finalizers; numba and torch run such callbacks during imports."""
    lines = (
        "import signal, time, weakref; from kissgs.cli import app, main",
        "class Thing: pass",
        "def work(words):",
        "    thing = Thing()",
        "    watch = weakref.ref(thing, lambda _: signal.raise_signal(signal.SIGINT))",
        "    del thing",
        "    time.sleep(30)",
        "app.app = work",
        "main.main()",
    )
    done = subprocess.run(
        [sys.executable, "-c", "\n".join(lines)], check=False, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 130
    assert done.stderr == "kissgs: interrupted; no partial file is left\n"


def test_interrupt_leaves_nothing(tmp_path: Path) -> None:
    scene, target = tmp_path / "scene.ply", tmp_path / "a.zip"
    kissgs.save(kissgs.sample_scene(60_000), scene)
    process = subprocess.Popen([KISSGS, "compress", scene, "-o", target, "-p", "paper"], stderr=subprocess.PIPE)
    time.sleep(1.5)
    process.send_signal(signal.SIGINT)
    _, message = process.communicate(timeout=300)
    assert process.returncode == 130
    assert message.decode().splitlines()[-1].startswith("kissgs: interrupted")
    assert [path.name for path in tmp_path.iterdir()] == ["scene.ply"]


def test_help_is_fast() -> None:
    best = min(_seconds("--help") for _ in range(3))
    assert best < 0.5


def _seconds(*words: str) -> float:
    before = os.times()
    run(*words)
    after = os.times()
    return after.children_user + after.children_system - before.children_user - before.children_system
