"""Every format under its own name, another name or none: all functions and commands read the same scene."""

import json

import pytest
from helpers.command_line import run
from helpers.format_scenes import made_scene
from helpers.reference_gltf import attributes, data_uri, document, glb_bytes
from helpers.reference_ply import assert_identical
from helpers.reference_sog import sog_files, write_folder, zip_of
from helpers.reference_splat import ksplat_bytes, splat_bytes
from helpers.reference_spz import spz_bytes
from helpers.streamed_scenes import KINDS
from helpers.web_tools import DECODER

import kissgs
from kissgs import InvalidContainerError, InvalidSceneError, KissgsError, Settings, UnsupportedError
from kissgs.core.splats import clean
from kissgs.io.scene_format import ReadOptions
from kissgs.pipeline.scene_files import describe, open_scene, read_scene, recognise, stored_bytes

SCENE = made_scene(30, 1, extremes=False)
ROOT, BUFFER = document(attributes(SCENE))
TEXT = {**ROOT, "buffers": [{"byteLength": len(BUFFER), "uri": data_uri(BUFFER)}]}
STREAMED = {
    name: kind.files([[SCENE], [made_scene(5, 1)]], environment=made_scene(2, 0)) for name, kind in KINDS.items()
}

FILES = {
    "a.splat": ("splat", splat_bytes(SCENE)),
    "a.ksplat": ("ksplat", ksplat_bytes([SCENE], 1)),
    "a2.spz": ("spz", spz_bytes(SCENE, 2)),
    "a4.spz": ("spz", spz_bytes(SCENE, 4, flags=1)),
    "a.glb": ("gltf", glb_bytes(ROOT, BUFFER)),
    "a.gltf": ("gltf", json.dumps(TEXT, indent=1).encode()),
    "a.sog": ("sog", zip_of(sog_files(SCENE))),
    "a1.sog": ("sog", zip_of(sog_files(SCENE, version=1))),
    "a.zip": ("streamed-sog", zip_of(STREAMED["streamed-sog"], folder="x/")),
    "a2.zip": ("streamed-sogxt", zip_of(STREAMED["streamed-sogxt"], folder="x/")),
}


@pytest.mark.parametrize("name", FILES)
def test_files_are_recognised_and_read_by_all(name, tmp_path):
    kind, data = FILES[name]
    path = tmp_path / name
    path.write_bytes(data)
    assert recognise(path) == kind
    wanted = read_scene(path)
    assert_identical(kissgs.decompress(path), wanted)
    assert_identical(kissgs.load(path), clean(wanted)[0])
    opened, _, size = open_scene(path, ReadOptions(), 1, lambda *_: None)
    assert_identical(opened, clean(wanted)[0])
    assert size == len(data) == stored_bytes(path)
    found = describe(path)
    assert (found.kind, found.count, found.sh_degree, found.bytes) == (kind, len(wanted), wanted.sh_degree, len(data))
    assert set(found.ranges) == {"means", "quats", "scales", "opacities", "sh0", "shN"} - (
        {"quats"} if kind in ("sog", "streamed-sog") else set()
    ) - ({"shN"} if kind == "splat" else set())
    low, high = found.ranges["means"]
    assert low == pytest.approx(wanted.means.min(), rel=1e-4)
    assert high == pytest.approx(wanted.means.max(), rel=1e-4)


@pytest.mark.parametrize("name", FILES)
def test_content_decides_before_the_ending(name, tmp_path):
    """A .splat, which nothing marks, needs its ending; the others are known even as bytes."""
    kind, data = FILES[name]
    for ending in ("", ".ply", ".bin", ".splat"):
        path = tmp_path / f"other{ending}"
        path.write_bytes(data)
        if kind == "splat":
            assert recognise(path) == ("splat" if ending == ".splat" else "ply")
        elif ending != ".splat" or kind not in ("ksplat", "gltf"):
            assert recognise(path) == kind
    assert recognise(data) == ("ply" if kind == "splat" else kind)


def test_a_ply_under_other_names_is_a_ply(tmp_path):
    kissgs.save(SCENE, tmp_path / "a.ply")
    data = (tmp_path / "a.ply").read_bytes()
    for name in ("a.splat", "a.spz", "a.sog", "a.glb", "a.ksplat"):
        (tmp_path / name).write_bytes(data)
        assert recognise(tmp_path / name) == "ply"
        assert len(kissgs.load(tmp_path / name)) == len(SCENE)


@pytest.mark.parametrize("kind", ["sog", *STREAMED])
def test_folders_and_their_metadata_file(kind, tmp_path):
    files = STREAMED.get(kind) or sog_files(SCENE)
    folder = write_folder(files, tmp_path / "scene")
    meta = folder / (KINDS[kind].manifest if kind in KINDS else "meta.json")
    wanted = read_scene(folder)
    for path in (folder, meta):
        assert recognise(path) == kind
        assert_identical(read_scene(path), wanted)
        assert describe(path).bytes == stored_bytes(path) == sum(map(len, files.values()))
    assert recognise(files) == kind
    assert_identical(kissgs.decompress(files), wanted)


def test_folders_of_sog_xt_stay_what_they_are(tmp_path):
    packed = kissgs.compress(SCENE, settings=Settings.from_preset("fast"))
    packed.save(tmp_path / "folder")
    only_json = {name: data for name, data in packed.files.items() if not name.endswith(".yaml")}
    for source in (tmp_path / "folder", packed.to_zip(), packed.files, only_json, zip_of(only_json)):
        assert recognise(source) == "sogxt"
    assert recognise(tmp_path / "folder/meta.json") == "sogxt"
    assert len(kissgs.load(tmp_path / "folder/meta.json")) == len(kissgs.decompress(only_json))


@pytest.mark.parametrize("kind", STREAMED)
def test_levels_of_a_streamed_scene(kind, tmp_path):
    folder, manifest = write_folder(STREAMED[kind], tmp_path / "scene"), KINDS[kind].manifest
    ending = "/" if kind == "streamed-sog" else ".zip"
    assert [len(kissgs.load(folder, level=level)) for level in (0, 1)] == [32, 7]
    found = describe(folder)
    assert found.details == {
        "level": 0, "levels": [30, 5], "environment": 2, "files": 2, "antialiased": False,
    }  # fmt: skip
    assert set(found.parts) == {manifest, f"0_0{ending}", f"env{ending}"}
    coarse = describe(folder, ReadOptions(level=1))
    assert (coarse.count, set(coarse.parts)) == (7, {manifest, f"1_0{ending}", f"env{ending}"})
    assert coarse.details["level"] == 1
    assert coarse.bits_per_gaussian == 8 * sum(coarse.parts.values()) / 7
    message = r"there is no level 2; this scene has levels 0 \(the finest\) to 1"
    with pytest.raises(KissgsError, match=message):
        kissgs.load(folder, level=2)
    with pytest.raises(KissgsError, match=message):
        describe(folder, ReadOptions(level=2))


@pytest.mark.parametrize("ending", [".ply", ".zip"])
def test_a_scene_without_levels_has_no_other_level_than_the_finest(ending, tmp_path):
    scene, target = tmp_path / f"scene{ending}", tmp_path / "levels/lod-meta.json"
    sample = kissgs.sample_scene(50)
    if ending == ".ply":
        kissgs.save(sample, scene)
    else:
        kissgs.compress(sample, scene, settings=Settings.from_preset("fast"))
    with pytest.raises(KissgsError, match="there is no level 1: this scene has no levels of detail"):
        kissgs.load(scene, level=1)
    with pytest.raises(KissgsError, match="there is no level -1"):
        describe(scene, ReadOptions(level=-1))
    with pytest.raises(KissgsError, match="no such file"):
        kissgs.load(tmp_path / f"none{ending}", level=1)
    with pytest.raises(KissgsError, match="there is no level 1"):
        kissgs.compress_streamed(scene, target, reading=ReadOptions(level=1))


def test_a_coarse_level_is_evaluated_against_the_scene_that_it_is_of(tmp_path):
    scene, packed = tmp_path / "scene.ply", tmp_path / "lod.zip"
    packed.write_bytes(zip_of(next(iter(STREAMED.values()))))
    kissgs.save(kissgs.load(packed), scene)
    done = run("evaluate", str(scene), str(packed), "--level", "1", "--json")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["mean"]["candidate_vs_reference"]["psnr"] < 60
    done = run("evaluate", str(scene), str(scene), "--level", "1")
    assert (done.returncode, b"no levels of detail" in done.stderr) == (2, True)


@pytest.mark.parametrize("container", ["sogxt", "sog"])
def test_a_limit_of_gaussians_holds_for_descriptions_of_containers(container, tmp_path):
    kissgs.compress(
        kissgs.sample_scene(100), tmp_path / "c", container=container, settings=kissgs.Settings(preset="fast")
    )
    count = describe(tmp_path / "c").count
    assert describe(tmp_path / "c", ReadOptions(max_gaussians=count)).count == count
    with pytest.raises(UnsupportedError, match=f"{count:,}|{count}"):
        describe(tmp_path / "c", ReadOptions(max_gaussians=count - 1))


def test_damaged_files_are_explained_by_the_reader_of_their_ending(tmp_path):
    for name, message in {
        "a.spz": "is not an .spz file",
        "a.glb": "is not readable JSON",
        "a.gltf": "is not readable JSON",
        "a.sog": "is not a readable zip file",
        "a.splat": "is no .splat file",
        "a.ksplat": "is cut short",
    }.items():
        (tmp_path / name).write_bytes(b"nothing here")
        with pytest.raises((InvalidSceneError, InvalidContainerError)) as error:
            kissgs.load(tmp_path / name)
        assert message in str(error.value)
        with pytest.raises((InvalidSceneError, InvalidContainerError), match="cannot read"):
            kissgs.load(tmp_path / f"absent-{name}")


@pytest.mark.parametrize("name", FILES)
def test_a_limit_that_is_given_holds_for_every_format(name, tmp_path):
    path = tmp_path / name
    path.write_bytes(FILES[name][1])
    count = len(kissgs.load(path))
    assert len(kissgs.load(path, max_gaussians=count)) == count
    with pytest.raises(UnsupportedError, match=rf"has {count} Gaussians; the limit is {count - 1}: raise it"):
        kissgs.load(path, max_gaussians=count - 1)


def test_the_default_limit_is_for_formats_that_can_declare_more_than_they_hold(tmp_path, monkeypatch):
    monkeypatch.setattr("kissgs.io.scene_format.MAX_GAUSSIANS", 3)
    refused = set()
    for name, (_, data) in FILES.items():
        (tmp_path / name).write_bytes(data)
        try:
            kissgs.load(tmp_path / name)
        except UnsupportedError:
            refused.add(name)
    assert set(FILES) - refused == {name for name in FILES if name.endswith((".ply", "splat"))}


TINY = ("--size", "32x24")
READING = {
    "info": ("info", "IN", "--json"),
    "convert": ("convert", "IN", "OUT.ply"),
    "decompress": ("decompress", "IN", "-o", "OUT.ply"),
    "compress": ("compress", "IN", "-o", "OUT.zip", "-p", "fast", "--json"),
    "compact": ("compact", "IN", "-o", "OUT.ply", "-n", "5", "-p", "fast", "--json"),
    "evaluate": ("evaluate", "IN", "IN", "--json"),
    "render": ("render", "IN", "-o", "OUT.png", *TINY),
    "view": ("view", "IN", "-o", "OUT.html"),
}


@pytest.mark.parametrize("kind", STREAMED)
@pytest.mark.parametrize("command", READING)
@pytest.mark.quick(2)
def test_every_command_that_reads_scenes_has_the_options_for_it(command, kind, tmp_path):
    """A limit that the coarse level meets and the finest does not: the level is chosen, and the limit is heeded."""
    packed = tmp_path / "lod.zip"
    packed.write_bytes(zip_of(STREAMED[kind]))
    words = [word.replace("IN", str(packed)).replace("OUT", str(tmp_path / "out")) for word in READING[command]]
    if command == "view" and not (DECODER / "vendor").exists():
        pytest.skip("scripts/vendor has not run")
    if command == "view":  # the limit chooses the level
        assert run(*words, "--max-gaussians", "7").returncode == 0
        (tmp_path / "out.html").unlink()
    elif command != "info":  # which decodes nothing
        done = run(*words, "--max-gaussians", "7")
        assert (done.returncode, b"level 0 has 32 Gaussians; the limit is 7" in done.stderr) == (2, True), done.stderr
    done = run(*words, "--level", "1", "--max-gaussians", "7")
    assert done.returncode == 0, done.stderr
    if command in ("info", "compress"):
        report = json.loads(done.stdout)
        assert 7 in (report.get("count"), report.get("source_count"))
    assert run(*words, "--raw-axes", "--level", "1", "-f" if command != "info" else "--json").returncode == 0
