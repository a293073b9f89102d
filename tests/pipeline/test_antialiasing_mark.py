"""The mark of antialiased scenes in every format; oracle: the bytes that other tools look for, and files by hand."""

import base64
import gzip
import io
import json
import struct
import zipfile
import zlib
from dataclasses import replace

import pytest
import yaml
from helpers.command_line import run
from helpers.format_scenes import made_scene
from helpers.reference_ply import assert_identical, header_bytes, names
from helpers.reference_sog import sog_files, zip_of
from helpers.reference_spz import spz_bytes
from helpers.web_tools import run_node

import kissgs
from kissgs import Settings
from kissgs.io.scene_format import ReadOptions
from kissgs.pipeline.scene_files import describe, open_scene
from kissgs.streaming.compress import compress_streamed

CLASSIC = made_scene(30, 1, extremes=False)
MARKED = replace(CLASSIC, antialiased=True)
FAST = Settings.from_preset("fast")


def ply(*comments):
    lines = [f"comment {comment}" for comment in comments]
    return header_bytes([*lines, "element vertex 1", *(f"property float {name}" for name in names(0))]) + b"\0" * 68


def sog(**keys):
    files = sog_files(CLASSIC)
    return zip_of({**files, "meta.json": json.dumps({**json.loads(files["meta.json"]), **keys}).encode()})


SOURCES = {
    "brush.ply": (ply("Exported from Brush", "SplatRenderMode: mip"), True),
    "spaces.ply": (ply("  SPLATRENDERMODE:MIP  "), True),
    "postshot.ply": (ply("antialiased 1"), True),
    "capital.ply": (ply("Antialiased:  1"), True),
    "gsplat.ply": (ply("rasterize_mode: antialiased"), True),
    "gsplat-classic.ply": (ply("rasterize_mode=classic"), False),
    "hyphen.ply": (ply("Anti-Aliasing = on"), True),
    "enabled.ply": (ply("antialiasing enabled"), True),
    "decimal.ply": (ply("antialias: 1.0"), True),
    "sentence.ply": (ply("Trained with antialiasing"), True),
    "mip-splatting.ply": (ply("mip_splatting: true", "SplatRenderMode mip-splatting"), True),
    "no-mip.ply": (ply("mip_splatting: false"), False),
    "bare.ply": (ply("antialiased"), True),
    "last.ply": (ply("antialiased 0", "SplatRenderMode: mip"), True),
    "default.ply": (ply("SplatRenderMode: default"), False),
    "zero.ply": (ply("antialiased 0"), False),
    "revoked.ply": (ply("antialiased 1", "SplatRenderMode: default"), False),
    "prose.ply": (ply("not antialiased 1 bit", "the SplatRenderMode: mip of Brush"), False),
    **{f"{v}.spz": (spz_bytes(CLASSIC, v, flags=1), True) for v in (1, 2, 3, 4)},
    "classic.spz": (spz_bytes(CLASSIC, 3), False),
    "model.sog": (sog(model="antialiased"), True),
    "spelled.sog": (sog(antialias=True), True),
    "default.sog": (sog(model="default"), False),
    "classic.sog": (sog(), False),
}


@pytest.mark.parametrize("name", SOURCES)
def test_marks_of_other_tools_are_read(name, tmp_path):
    data, marked = SOURCES[name]
    (tmp_path / name).write_bytes(data)
    assert kissgs.load(tmp_path / name).antialiased == marked
    assert kissgs.load(tmp_path / name, antialiased=False).antialiased is False
    assert kissgs.decompress(tmp_path / name, antialiased=True).antialiased if not name.endswith(".ply") else True
    assert describe(tmp_path / name).details["antialiased"] == marked
    assert open_scene(tmp_path / name, ReadOptions(antialiased=not marked), 1, lambda *_: None)[0].antialiased != marked


def test_the_page_reads_the_same_marks():
    files = [[name, base64.b64encode(data).decode()] for name, (data, _) in SOURCES.items()]
    said = run_node("read_marks.mjs", json.dumps(files)).split()
    assert dict(zip(SOURCES, said, strict=True)) == {name: str(marked).lower() for name, (_, marked) in SOURCES.items()}


def read(path):
    return path.read_bytes()


def model_of(data):
    return json.loads(zipfile.ZipFile(io.BytesIO(data)).read("meta.json")).get("model")


def yaml_of(data):
    return yaml.safe_load(zipfile.ZipFile(io.BytesIO(data)).read("container_meta.yaml")).get("model")


def spz_in_glb(data):
    start = 20 + struct.unpack_from("<I", data, 12)[0] + 8
    return zlib.decompressobj(31).decompress(data[start:])[14] == 1


WRITTEN = {
    "a.ply": lambda path: b"\ncomment SplatRenderMode: mip\n" in read(path)[:2000],
    "a.compressed.ply": lambda path: b"\ncomment SplatRenderMode: mip\n" in read(path)[:2000],
    "a.spz": lambda path: gzip.decompress(read(path))[14] == 1,
    "a.spz.glb": lambda path: spz_in_glb(read(path)),
    "a.sog": lambda path: model_of(read(path)) == "antialiased",
    "a.zip": lambda path: model_of(read(path)) == yaml_of(read(path)) == "antialiased",
    "sog/lod-meta.json": lambda path: json.loads(read(path.parent / "0_0/meta.json")).get("model") == "antialiased",
    "a.sogxt/levels.json": lambda path: model_of(read(path.parent / "0_0.zip")) == "antialiased",
}
UNMARKED = ("a.splat", "a.glb")


def write(splats, path):
    folder = path.parent.parent if path.suffix == ".json" else path.parent
    folder.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".json":
        kissgs.save(splats, path.parent.with_suffix(".ply"))
        compress_streamed(path.parent.with_suffix(".ply"), path, settings=FAST)
    elif path.suffix in (".sog", ".zip"):
        kissgs.compress(splats, path, container="sog" if path.suffix == ".sog" else "sogxt", settings=FAST)
    else:
        kissgs.save(splats, path)


@pytest.mark.parametrize("name", WRITTEN)
def test_the_mark_is_written_and_read_again(name, tmp_path):
    first, second, classic = (tmp_path / folder / name for folder in ("first", "second", "classic"))
    write(MARKED, first)
    again = kissgs.load(first)
    assert WRITTEN[name](first)
    assert again.antialiased
    write(again, second)
    assert WRITTEN[name](second)
    write(CLASSIC, classic)
    assert not WRITTEN[name](classic)
    unmarked = kissgs.load(classic)
    assert not unmarked.antialiased
    assert_identical(unmarked, again)  # the mark changes nothing else


@pytest.mark.parametrize("name", UNMARKED)
def test_formats_without_a_place_say_so(name, tmp_path):
    (_note,) = [note for note in kissgs.save(MARKED, tmp_path / name) if "antialias" in note]
    assert not any("antialias" in note for note in kissgs.save(CLASSIC, tmp_path / f"c-{name}"))
    assert (tmp_path / name).read_bytes() == (tmp_path / f"c-{name}").read_bytes()


def test_parts_that_disagree_are_drawn_without_and_named(tmp_path):
    """One wrong choice for a part is as visible as the other; splat-transform decides so too."""
    write(MARKED, tmp_path / "a.sogxt/levels.json")
    (tmp_path / "a.sogxt/other.zip").write_bytes(kissgs.compress(CLASSIC, settings=FAST).to_zip())
    manifest = tmp_path / "a.sogxt/levels.json"
    document = json.loads(manifest.read_bytes())
    manifest.write_text(json.dumps({**document, "environment": "other.zip"}))
    splats = kissgs.load(manifest)
    assert not splats.antialiased
    assert any("antialias" in note for note in splats.notes)
    assert describe(manifest).details["antialiased"] is False


def test_the_command_line_overrides_the_mark(tmp_path):
    (tmp_path / "a.spz").write_bytes(spz_bytes(CLASSIC, 3, flags=1))
    run("convert", tmp_path / "a.spz", tmp_path / "classic.ply", "--classic")
    run("convert", tmp_path / "classic.ply", tmp_path / "again.spz", "--antialiased")
    assert not kissgs.load(tmp_path / "classic.ply").antialiased
    assert kissgs.load(tmp_path / "again.spz").antialiased
    done = run("convert", tmp_path / "again.spz", tmp_path / "a.splat")
    assert b"antialias" in done.stderr
    seen = run("evaluate", tmp_path / "again.spz", tmp_path / "a.splat", "--json")
    assert b"a.splat is not" in seen.stderr
    assert run("evaluate", tmp_path / "again.spz", tmp_path / "a.splat", "--antialiased", "--json").stderr == b""
    shown = run("info", tmp_path / "again.spz")
    assert b"antialiased" in shown.stdout
