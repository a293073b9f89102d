"""The command line as a user runs it. Oracle: the library's own functions, and the promises of the README."""

import errno
import json
import os
import shutil
import signal
import subprocess
import time
import zipfile
from pathlib import Path

import pytest
from helpers.captured_scene import SCENE, write_capture
from helpers.command_line import KISSGS, failure, run

import kissgs


def test_compress_and_decompress(scene, tmp_path):
    """Regression: square brackets in names were parsed as rich markup."""
    done = run("compress", scene, "-o", tmp_path / "[red]a.zip")
    assert done.returncode == 0
    assert "[red]a.zip" in done.stdout.decode()
    packed = (tmp_path / "[red]a.zip").read_bytes()
    assert packed == kissgs.compress(scene).to_zip()
    fast = kissgs.compress(scene, settings=kissgs.Settings.from_preset("fast")).to_zip()
    assert run("compress", "-", "-o", "-", "-q", "-p", "fast", stdin=scene.read_bytes()).stdout == fast
    assert run("decompress", tmp_path / "[red]a.zip", "-o", tmp_path / "b.ply").returncode == 0
    assert len(kissgs.load(tmp_path / "b.ply")) == len(kissgs.decompress(packed))
    back = run("decompress", "-", "-o", "-", stdin=packed)
    assert back.stdout == (tmp_path / "b.ply").read_bytes()
    assert run("sample", tmp_path / "s.ply", "--gaussians", 500).returncode == 0
    assert len(kissgs.load(tmp_path / "s.ply")) == 500


def test_default_outputs_are_next_to_the_input(scene, tmp_path):
    here = tmp_path / "mine.ply"
    here.write_bytes(scene.read_bytes())
    assert run("compress", "mine.ply", "-p", "fast", cwd=tmp_path).returncode == 0
    assert zipfile.is_zipfile(tmp_path / "mine.zip")
    assert "exists already" in failure("decompress", "mine.zip", cwd=tmp_path)
    assert run("decompress", "mine.zip", "--force", cwd=tmp_path).returncode == 0


def test_several_files_and_patterns(scene, tmp_path):
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


def test_info_of_both_kinds(scene, tmp_path):
    container = tmp_path / "a.zip"
    run("compress", scene, "-o", container, "-q", "-p", "fast")
    ply, zipped = json.loads(run("info", scene, container, "--json").stdout)
    assert (ply["kind"], ply["count"], ply["sh_degree"]) == ("ply", 600, 1)
    assert (zipped["kind"], zipped["sh_degree"]) == ("sogxt", 1)
    assert zipped["count"] == len(kissgs.decompress(container))
    assert sum(zipped["parts"].values()) < zipped["bytes"] == container.stat().st_size
    table = run("info", container).stdout.decode()
    assert "means_bytes_0.webp" in table
    assert "bits per Gaussian" in table


@pytest.mark.quick(0)
def test_goals_and_cached_sensitivity(scene, tmp_path):
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


def test_settings_from_the_command_line(scene, tmp_path):
    words = "-p", "fast", "--set", "sh_neighbors=16", "--set", "seed=3"
    report = json.loads(run("compress", scene, "-o", tmp_path / "a.zip", "--json", *words).stdout)
    assert (report["source_count"], report["container_bytes"]) == (600, (tmp_path / "a.zip").stat().st_size)
    settings = json.loads(run("info", tmp_path / "a.zip", "--json").stdout)["details"]["settings"]
    assert (settings["sh_neighbors"], settings["seed"]) == (16, 3)


REFUSED = {
    "compress none.ply -o a.zip": "no such file",
    "compress text.ply -o a.zip": "text.ply",
    "decompress bad.zip -o a.ply": "bad.zip",
    "info none.zip": "no such file",
    "compress scene.ply -o missing/a.zip": "no folder",
    "compress scene.ply -o - --json": "both write",
    "compress - ": "give the output with -o",
    "decompress /": "has no name",
    "compress *.nothing": "no file matches",
    "compress scene.ply text.ply -o a.zip": "cannot all become",
    "compress scene.ply -o b.zip --set bits=16": "there is no setting 'bits'",
    "compress scene.ply -o b.zip --set bits": "NAME=VALUE",
    "compress scene.ply -o b.zip --set preset=small": "write GROUP.NAME=VALUE",
    "compress scene.ply -o b.zip -p huge": "fast, balanced, paper",
    "compress scene.ply -f -p fast --psnr 40": "psnr needs rate_distortion",
    "compress scene.ply -f --time soon": "setting time_limit: write 30s, 2min, 1h",
    "compress - -o b.zip --cache": "standard input has no folder",
    # An output without its option is refused before any work, and no folder gets the name of a file.
    "compress scene.ply new.zip": "does not exist; if it is the output, name it with -o new.zip",
    "decompress bad.zip new.ply": "does not exist; if it is the output, name it with -o new.ply",
    "decompress scene.ply -o new": "there is no folder new; end it in .ply if it is a file, or in a slash",
    "decompress scene.ply -o meta.json": "there is no folder meta.json; end it in .ply",
    "decompress scene.ply -o a.spz": "this command writes .ply; for .spz, use kissgs convert",
    "compress scene.ply -o a.sog --unpacked": "there is no folder a.sog; end it in a slash",
    "compress scene.ply scene.ply -o new/": "would become one file",
    "compress scene.ply -o k.ssog --container sog": ".zip or .sog",
    "compress scene.ply -o k.ssog --unpacked": "a slash",
    "remote compress scene.ply -o out.xyz": ".zip or .sog",
    "decompress scene.ply -o x.usdz": ".ply",
    "compact scene.ply --ratio 0.5 -o x.plyy": ".ply",
    "convert scene.ply x.usdz": ".spz, .splat",
    "convert scene.ply x.usdz --to spz": ".spz",
    "render scene.ply -o x.gif": ".png or .webp",
    "sample x.usdz": ".spz, .splat",
}


def test_errors_are_one_line_and_make_nothing(scene, tmp_path):
    (tmp_path / "scene.ply").write_bytes(scene.read_bytes())
    (tmp_path / "text.ply").write_text("hello")
    (tmp_path / "bad.zip").write_bytes(b"PK\x03\x04 but no more")
    for words, expected in REFUSED.items():
        assert expected in failure(*words.split(), cwd=tmp_path), words
        assert sorted(path.name for path in tmp_path.iterdir()) == ["bad.zip", "scene.ply", "text.ply"], words
    assert json.loads(run("info", tmp_path / "none.ply", "--json").stdout)["error"]["code"] == "invalid-scene"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("compress - -o q.zip <&-", "standard input is closed; there is nothing to read"),
        ("info scene.ply > /dev/full", "cannot write to standard output: no space left on device"),
        ("info scene.ply --json > /dev/full", "cannot write to standard output: no space left on device"),
        ("compact --help > /dev/full", "cannot write to standard output: no space left on device"),
    ],
)
def test_standard_files_that_fail(scene, words, said):
    for environment in (None, {}) if "help" in words else (None,):  # the help's output depends on the terminal's
        done = subprocess.run(
            f"{KISSGS} {words}",
            shell=True,
            cwd=scene.parent,
            env=environment,
            capture_output=True,
            text=True,
            check=False,
        )
        assert (done.returncode, done.stderr) == (2, f"kissgs: {said}\n")


def test_no_folder_gets_the_name_of_a_file(scene, tmp_path):
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
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "c.sog").mkdir()
    assert run("compress", scene, "-o", tmp_path / "c.sog", "-p", "fast", "-q", "--unpacked").returncode == 0
    assert len(kissgs.load(tmp_path / "c.sog" / "scene.container")) > 0


def test_names_of_folders(scene, tmp_path):
    """A slash, or a folder that exists."""
    names = ["x.usdz/", "new/", "a/v1.2/", "made.d"]
    (tmp_path / "made.d").mkdir()
    for name in names:
        assert run("convert", scene, name, "--to", "ply", "-q", cwd=tmp_path).returncode == 0
    assert {path.parent for path in tmp_path.rglob("*.ply")} == {tmp_path / name for name in names}


def test_a_folder_that_is_no_container_is_named_with_what_to_give(scene, tmp_path):
    for path in (tmp_path / "adir" / "scene.ply", tmp_path / "notes" / "a.txt"):
        path.parent.mkdir(parents=True)
        path.write_bytes(scene.read_bytes())
    for command in ("compress", "decompress", "info", "render"):
        assert "adir is a folder, not a scene; name a file in it: scene.ply" in failure(command, "adir", cwd=tmp_path)
        assert "notes is a folder without a scene" in failure(command, "notes", cwd=tmp_path)


def test_a_folder_of_inrias_trainer_is_its_last_scene(tmp_path):
    for iteration, count in ((7000, 30), (30000, 50), ("best", 10)):
        path = tmp_path / f"runs/garden/point_cloud/iteration_{iteration}/point_cloud.ply"
        path.parent.mkdir(parents=True)
        kissgs.save(kissgs.sample_scene(count), path)
    (tmp_path / "runs/garden/cameras.json").write_text("[]")
    model = tmp_path / "runs/garden"
    assert (len(kissgs.load(model)), kissgs.read_scene_info(model).count, kissgs.recognise(model)) == (50, 50, "ply")
    done = run("compress", model, "-p", "fast")
    assert b"the scene is point_cloud/iteration_30000/point_cloud.ply" in done.stdout
    assert kissgs.read_scene_info(tmp_path / "runs/garden.zip").count == 50
    run("compress", model, "-o", tmp_path / "levels.sogxt/", "-p", "fast")
    assert kissgs.read_scene_info(tmp_path / "levels.sogxt").count == 50


def test_outputs_of_equal_names_are_named_after_the_folders_that_differ(scene, tmp_path):
    inputs = [f"{name}/point_cloud/iteration_9/point_cloud.ply" for name in ("garden", "bonsai")]
    for name in inputs:
        (tmp_path / name).parent.mkdir(parents=True)
        shutil.copy(scene, tmp_path / name)
    assert run("convert", *inputs, "out/", "--to", "spz", "-q", cwd=tmp_path).returncode == 0
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"garden.spz", "bonsai.spz"}
    other = inputs[0].replace("_9", "_7")
    (tmp_path / other).parent.mkdir()
    shutil.copy(scene, tmp_path / other)
    shutil.copy(scene, tmp_path / "Own.ply")
    command = ["convert", *inputs, other, "Own.ply", "all/", "--to", "spz", "-q"]
    assert run(*command, cwd=tmp_path).returncode == 0
    assert {path.stem for path in (tmp_path / "all").iterdir()} == {"garden_9", "garden_7", "bonsai_9", "Own"}
    inputs = [inputs[0], f"garden/../{inputs[0]}"]
    assert "would become one file" in failure("convert", *inputs, "out/", "--to", "spz", cwd=tmp_path)


def test_each_scene_has_the_capture_of_its_name(tmp_path):
    for name, photographs in (("garden", ("a.png", "b.png")), ("bonsai", ("a.png", "b.png", "c.png", "d.png"))):
        write_capture(tmp_path / "data" / name, photographs)
        (tmp_path / "runs" / name).mkdir(parents=True)
        kissgs.save(SCENE, tmp_path / "runs" / name / "point_cloud.ply")
    command = ["compress", *(f"runs/{name}/point_cloud.ply" for name in ("garden", "bonsai"))]
    command += ["--views", "data", "-p", "fast", "--evaluate", "--json"]
    for outputs in ([], ["-o", "out/"]):
        done = run(*command, *outputs, cwd=tmp_path)
        found = [report["evaluation"]["source"] for report in json.loads(done.stdout)]
        assert ["data/garden" in found[0], "data/bonsai" in found[1]] == [True, True]
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"garden.zip", "bonsai.zip"}
    done = run(*command, "--views", "nowhere", cwd=tmp_path)
    assert done.stderr == b"kissgs: there is no folder nowhere; name the folder of a capture\n", "once for all scenes"


@pytest.mark.parametrize("encoding", ["ascii", "latin-1"])
def test_standard_output_escapes_what_its_encoding_lacks(scene, tmp_path, encoding):
    """The expected bytes are those of Python's own error handler for standard error."""
    name = "日本 ü\udcff.ply"
    (tmp_path / name).write_bytes(scene.read_bytes())
    done = run("info", name, cwd=tmp_path, encoding=encoding)
    assert (done.returncode, done.stderr) == (0, b"")
    assert done.stdout.startswith(name.encode(encoding, "backslashreplace"))
    assert b"\\u2026" in run("compress", "--help", encoding="ascii").stdout
    done = run("convert", name, "ü.ply", "--json", cwd=tmp_path, encoding=encoding)
    assert json.loads(done.stdout)["input"] == name


def test_interrupt_leaves_nothing(tmp_path):
    scene, target = tmp_path / "scene.ply", tmp_path / "a.zip"
    kissgs.save(kissgs.sample_scene(60_000), scene)
    process = subprocess.Popen([KISSGS, "compress", scene, "-o", target, "-p", "paper"], stderr=subprocess.PIPE)
    time.sleep(1.5)
    process.send_signal(signal.SIGINT)
    _, message = process.communicate(timeout=300)
    assert process.returncode == 130
    assert message.decode().splitlines()[-1].startswith("kissgs: interrupted")
    assert [path.name for path in tmp_path.iterdir()] == ["scene.ply"]


def test_the_settings_that_are_listed_are_those_that_may_be_set(scene, tmp_path):
    names = [line.split()[0] for line in run("settings").stdout.decode().splitlines()[1:] if line[:1].strip()]
    assert {"seed", "target_size", "max_psnr_drop", "compact.ratio", "finetune.steps"} <= set(names)
    assert len(names) <= 20
    groups = (kissgs.settings.EncodeSettings, kissgs.settings.CompactSettings, kissgs.settings.FinetuneSettings)
    for name in names:
        group, _, inner = name.rpartition(".")
        assert inner in groups[("", "compact", "finetune").index(group)].public()


def test_a_result_ends_with_the_command_that_shows_it(scene, tmp_path):
    last = run("compress", scene, "-o", tmp_path / "a b.zip", "-p", "fast").stdout.decode().splitlines()[-1]
    assert last == f"see it: kissgs view '{tmp_path / 'a b.zip'}'"


@pytest.mark.parametrize("option", ["--unpacked", "--quiet"])
def test_a_disk_that_fills_up_leaves_no_file(scene, tmp_path, monkeypatch, option):

    def full(descriptor):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    words = ["compress", scene, "-p", "fast", "-o", f"{tmp_path}/new/", option]
    assert "no space left on device" in failure(*words)
    assert sorted(tmp_path.rglob("*")) == [tmp_path / "new"]  # which another command may be about to write into
