"""Scenes far from the origin. Oracle: the float64 positions that a naive writer has put into the file."""

import base64
import json
import re
import struct
from dataclasses import replace

import numpy as np
import pytest
from helpers import reference_ply
from helpers.command_line import run

import kissgs
from kissgs.cameras.views import Similarity, View, Views, black
from kissgs.core.positions import coarse_share
from kissgs.evaluation.evaluate import in_scene_frame
from kissgs.rendering.camera import look_at
from kissgs.sogxt import JSON_NAME, YAML_NAME

SIZE = 0.03
"""Standard deviation of every Gaussian."""

FAST = kissgs.Settings(preset="fast")
AUTO = kissgs.ReadOptions(origin="auto")
OFFSETS = {
    "two axes": (1000.0, 1000.0, 0.0),
    "one axis": (10_000.0, 0.0, 0.0),
    "all": (-2000.0, 2000.0, 2000.0),
    "far": (1e5, 1e5, 0.0),
}
MAP = (452_345.25, 4_512_345.75, 120.0)
"""Projected coordinates, whose steps in float32 are half a metre."""


EYE = (452_345.25, 4_512_345.75, 114.0)
"""Position of a camera that looks at ``MAP``."""


def view_from(eye, target=MAP):
    camera = look_at(np.array(eye), np.array(target), np.array([0.0, -1, 0]), fov=1.0, width=64, height=48)
    return Views((), (View("a", camera),), black(), "a test")


def columns(positions, size=SIZE):
    rng = np.random.default_rng(7)
    count = len(positions)
    values = {name: np.zeros(count) for name in reference_ply.names(0)}
    values |= dict(zip("xyz", positions.T, strict=True))
    values |= {f"scale_{axis}": np.log(np.broadcast_to(size, count)) for axis in range(3)}
    values |= {f"f_dc_{i}": rng.normal(size=count) for i in range(3)}
    values["opacity"], values["rot_0"] = np.full(count, 2.0), np.ones(count)
    return {name: each.tolist() for name, each in values.items()}


def around(offset, count=300):
    return np.random.default_rng(3).normal(size=(count, 3)) + offset


def write(path, positions, kind="float", encoding="binary_little_endian", size=SIZE):
    path.write_bytes(reference_ply.ply_bytes(columns(positions, size), encoding, kind))
    return path


def positions_of(path):
    """Read the positions of a ``.ply`` that this library wrote, float64."""
    data = path.read_bytes()
    head, _, body = data.partition(b"end_header\n")
    words = [line.split() for line in head.decode().splitlines()]
    count = next(int(word[2]) for word in words if word[:2] == ["element", "vertex"])
    codes = "".join("d" if word[1] == "double" else "f" for word in words if word[0] == "property")
    return np.array([row[:3] for row in struct.iter_unpack(f"<{codes}", body)])[:count]


def largest_error(wanted, found):
    """Return the largest error of a coordinate; Gaussians may have another order."""
    nearest = ((wanted[:, None] - found[None]) ** 2).sum(axis=2).argmin(axis=1)
    return np.abs(wanted - found[nearest]).max()


@pytest.mark.parametrize("ending", [".zip", ".sog"])
@pytest.mark.parametrize("offset", OFFSETS.values(), ids=OFFSETS)
def test_coarse_steps_are_named_and_an_origin_mends_them(offset, ending, tmp_path):
    scene, out, decoded = write(tmp_path / "a.ply", around(offset)), tmp_path / f"a{ending}", tmp_path / "b.ply"
    wanted = around(offset).astype(np.float32).astype(float)
    plain = kissgs.compress(scene, out, settings=FAST)
    kissgs.decompress(out, decoded)
    coarse = largest_error(wanted, positions_of(decoded)) > SIZE / 4
    assert coarse == ("positions have steps of" in plain.report.note)
    assert coarse == ('--origin auto (in Python origin="auto")' in plain.report.note)
    assert coarse or (ending == ".sog" and max(offset) < 1e5)  # it has a range of each axis

    moved = kissgs.compress(scene, out, settings=FAST, reading=AUTO, overwrite=True)
    kissgs.decompress(out, decoded, overwrite=True)
    assert "steps" not in moved.report.note
    assert "positions are relative to the point" in moved.report.note
    assert largest_error(wanted, positions_of(decoded)) < SIZE / 8


def test_the_step_that_is_named_includes_the_rounding_of_the_range(tmp_path):
    """The ends of a range are float32: at 1e6, that is coarser than 65,535 steps between them."""
    scene = write(tmp_path / "a.ply", around((1e6, 1e6, 0)))
    note = kissgs.compress(scene, tmp_path / "a.sog", settings=FAST).report.note
    step = float(re.search("steps of about ([0-9.e+-]+)", note)[1])
    wanted, found = around((1e6, 1e6, 0)).astype(np.float32), kissgs.load(tmp_path / "a.sog").means
    assert step / 20 < largest_error(wanted.astype(float), found.astype(float)) < step


def test_small_gaussians_among_large_ones_are_no_matter_of_distance(tmp_path):
    """One in ten is small: fast gives all the bits that the median Gaussian needs, which is no loss by distance."""
    sizes = np.where(np.arange(1000) % 10, 0.1, 0.0005)
    scene = kissgs.load(write(tmp_path / "a.ply", around((0, 0, 0), 1000) / 4, size=sizes))

    def coarse(**settings):
        found = kissgs.compress(scene, settings=kissgs.Settings.research("fast", **settings))
        assert found.report.note == ""
        errors = np.abs(kissgs.decompress(found.files).means - scene.means[found.order]).max(axis=1)
        return coarse_share(errors, scene.scales[found.order])

    assert coarse() > 0.05
    assert coarse(means_bits=16) < 0.01


def test_parts_and_an_origin_help_together(tmp_path):
    """Ends of ranges in float32 are too coarse for the second object 1,000 units away; near an origin they are not."""
    rng = np.random.default_rng(1)
    far = 0.02 * rng.normal(size=(1500, 3)) + (1000, 0, 0)
    positions, sizes = np.concatenate([rng.normal(size=(1500, 3)), far]), np.repeat([0.05, 0.0007], 1500)
    scene = write(tmp_path / "a.ply", positions, size=sizes)
    note = kissgs.compress(scene, settings=FAST).report.note
    assert "compressing into FOLDER/lod-meta.json with --origin auto" in note
    report = kissgs.compress_streamed(scene, tmp_path / "tree" / "lod-meta.json", settings=FAST, reading=AUTO)
    assert "positions have steps of" not in report.note


def test_a_scene_near_the_origin_is_not_moved():
    scene = kissgs.sample_scene(500, sh_degree=0)
    plain, auto = (kissgs.compress(scene, settings=FAST, reading=each) for each in (kissgs.ReadOptions(), AUTO))
    assert plain.files == auto.files
    assert plain.report.note == auto.report.note == ""


@pytest.mark.parametrize("encoding", ["binary_little_endian", "binary_big_endian", "ascii"])
def test_doubles_are_read_as_doubles(encoding, tmp_path):
    scene = write(tmp_path / "a.ply", around(MAP), "double", encoding)
    splats = kissgs.load(scene)
    assert largest_error(around(MAP), splats.means + np.array(splats.origin)) < 1e-5
    kissgs.save(splats, tmp_path / "b.ply")
    assert largest_error(around(MAP), positions_of(tmp_path / "b.ply")) < 1e-5


def test_doubles_that_float32_holds_are_floats(tmp_path):
    scene = write(tmp_path / "a.ply", around((0, 0, 3)), "double")
    splats = kissgs.load(scene)
    assert splats.origin == (0, 0, 0)
    assert (splats.means == around((0, 0, 3)).astype(np.float32)).all()


@pytest.mark.parametrize("ending", [".zip", ".sog", ".glb", ".spz.glb", ".ply"])
def test_what_can_hold_an_origin_gives_the_positions_back(ending, tmp_path):
    scene, out = write(tmp_path / "a.ply", around(MAP), "double"), tmp_path / f"b{ending}"
    if ending in (".zip", ".sog"):
        kissgs.compress(scene, out, settings=FAST)
    else:
        kissgs.save(kissgs.load(scene), out)
    found = kissgs.load(out)
    assert largest_error(around(MAP), found.means + np.array(found.origin)) < SIZE / 4
    again = kissgs.compress(out, settings=FAST)  # the origin goes on
    assert "(452,34" in again.report.note


@pytest.mark.parametrize("ending", [".spz", ".splat", ".compressed.ply"])
def test_what_cannot_hold_an_origin_says_so(ending, tmp_path):
    *_, note = kissgs.save(kissgs.load(write(tmp_path / "a.ply", around(MAP), "double")), tmp_path / f"b{ending}")
    assert "relative to the point" in note
    assert f"{ending} does not record it" in note


def test_later_rows_and_nodes_count_too(tmp_path):
    """The first block of rows is near the origin, all others are on a map."""
    positions = np.concatenate([around((0, 0, 0), 9000), around(MAP, 9000)])
    for encoding in ("binary_little_endian", "ascii"):
        found = kissgs.load(write(tmp_path / "a.ply", positions, "double", encoding))
        near = np.abs(found.means + np.array(found.origin) - positions).max(axis=1) < SIZE / 4
        assert near.mean() > 0.9 or any("rounded to float32" in note for note in found.notes)


def test_convert_writes_the_world_where_a_format_can(tmp_path):
    scene = write(tmp_path / "a.ply", around(OFFSETS["two axes"]))
    kissgs.compress(scene, tmp_path / "a.zip", settings=FAST, reading=AUTO)
    report = json.loads(run("convert", tmp_path / "a.zip", tmp_path / "b.splat", "--json").stdout)
    assert not any("relative" in note for note in report["notes"])
    assert np.abs(kissgs.load(tmp_path / "b.splat").means - OFFSETS["two axes"]).max() < 10
    moved = json.loads(run("convert", scene, tmp_path / "c.splat", "--origin", "auto", "--json").stdout)
    *_, note = moved["notes"]
    assert "(1,000, 1,000, 0); .splat does not record it" in note


def test_a_compression_is_evaluated_with_its_capture(tmp_path):
    scene = write(tmp_path / "a.ply", around(MAP), "double")
    report = kissgs.compress(scene, settings=FAST, evaluate=True, views=view_from(EYE)).report
    assert report.evaluation.mean.candidate_vs_reference.psnr > 35
    assert report.evaluation.shown > 0.5
    assert np.allclose(report.evaluation.worst.pose_as_dict()["position"], EYE, rtol=0, atol=1e-6)


def test_evaluations_name_cameras_in_the_world(tmp_path):
    scene = kissgs.load(write(tmp_path / "a.ply", around(MAP), "double"))
    found = kissgs.evaluate(scene, scene, view_from(EYE))
    assert np.allclose(found.as_dict()["worst"]["position"], EYE, rtol=0, atol=1e-6)
    assert "at (452345.2, 4512345.8, 114) looking along (0, 0, 1)" in found.extremes
    drawn = found.surroundings.as_dict()["worst"]
    assert max(np.abs(np.subtract(drawn[name], MAP)).max() for name in ("position", "target")) < 100


def test_rendered_images_name_cameras_in_the_world(tmp_path):
    scene, camera = write(tmp_path / "a.ply", around(MAP), "double"), tmp_path / "camera.json"
    options = ("--size", "64x48", "--json")
    first = run("render", scene, "-o", tmp_path / "a.png", "--save-camera", camera, *options)
    again = run("render", scene, "-o", tmp_path / "b.png", "--view", camera, *options)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    for out in (first, again):
        viewmat = np.array(json.loads(out.stdout)["cameras"][0]["viewmat"])
        assert np.abs(-viewmat[:3, :3].T @ viewmat[:3, 3] - MAP).max() < 100


def test_a_capture_that_its_files_move_to_a_map_fits(tmp_path):
    """Cameras near zero, and a similarity from there to the world of the scene, which is relative to its origin."""
    scene, to_map = kissgs.load(write(tmp_path / "a.ply", around(MAP), "double")), np.eye(4)
    to_map[:3, 3] = MAP
    near = replace(view_from(np.array(EYE) - MAP, (0, 0, 0)), similarities=(Similarity("a.json", to_map),))
    found = in_scene_frame(scene, near)
    assert "moved by a.json" in found.note
    assert np.allclose(found.test[0].camera.position + scene.origin, EYE, rtol=0, atol=1e-6)
    assert in_scene_frame(scene, found).test[0].camera is found.test[0].camera


def test_no_gaussians(tmp_path):
    scene = write(tmp_path / "a.ply", np.empty((0, 3)), "double")
    assert kissgs.load(scene, origin="auto").origin == (0, 0, 0)
    with pytest.raises(kissgs.InvalidSceneError):
        kissgs.compress_streamed(scene, tmp_path / "tree" / "lod-meta.json", settings=FAST, reading=AUTO)


def test_a_gltf_node_far_away(tmp_path):
    """Geo-referenced glTF has a small mesh and a node with a large translation, in glTF's axes."""
    near = kissgs.load(write(tmp_path / "a.ply", around((0, 0, 0))))
    kissgs.save(near, tmp_path / "a.glb")
    data = (tmp_path / "a.glb").read_bytes()
    length = int.from_bytes(data[12:16], "little")
    document, body = json.loads(data[20 : 20 + length]), data[28 + length :]
    document["nodes"][0]["translation"] = [-MAP[0], -MAP[1], MAP[2]]
    document["buffers"][0]["uri"] = "data:application/octet-stream;base64," + base64.b64encode(body).decode()
    (tmp_path / "b.gltf").write_text(json.dumps(document))
    found = kissgs.load(tmp_path / "b.gltf")
    assert largest_error(near.means + np.array(MAP), found.means + np.array(found.origin)) < 1e-4


def test_scenes_of_two_origins_and_a_capture_are_compared_in_one_world(tmp_path):
    scene = write(tmp_path / "a.ply", around(MAP), "double")
    kissgs.compress(scene, tmp_path / "a.zip", settings=FAST)
    reference, candidate = kissgs.load(scene), kissgs.load(tmp_path / "a.zip")
    origin = np.array(candidate.origin) + np.array([5, -3, 2])
    means = (candidate.means + np.array(candidate.origin) - origin).astype(np.float32)
    other = kissgs.Splats(
        **{name: getattr(candidate, name) for name in ("quats", "scales", "opacities", "sh0", "shN")},
        means=means,
        origin=tuple(map(float, origin)),
    )
    found = kissgs.evaluate(reference, other, view_from(EYE))
    assert found.mean.candidate_vs_reference.psnr > 35
    assert found.shown > 0.5


def test_objects_far_apart_are_kept_by_streamed_sog(tmp_path):
    """The second object, a fiftieth of the size, is 1,000 units away: no origin serves both."""
    rng = np.random.default_rng(1)
    near, far = rng.normal(size=(1500, 3)), 0.02 * rng.normal(size=(1500, 3)) + (1000, 0, 0)
    positions, sizes = np.concatenate([near, far]), np.repeat([0.05, 0.001], 1500)
    scene = write(tmp_path / "a.ply", positions, size=sizes)
    note = kissgs.compress(scene, settings=FAST, reading=AUTO).report.note
    assert "positions have steps of" in note
    assert "compressing into FOLDER/lod-meta.json" in note
    assert "with --origin auto" not in note
    report = kissgs.compress_streamed(scene, tmp_path / "tree" / "lod-meta.json", settings=FAST)
    assert report.note == ""
    found = kissgs.load(tmp_path / "tree").means.astype(float)
    wanted = far.astype(np.float32).astype(float)
    nearest = np.array([np.abs(found - one).max(axis=1).min() for one in wanted])
    assert coarse_share(nearest, np.full((1500, 3), np.log(0.001), np.float32)) < 0.05
    assert "steps" in kissgs.compress_streamed(scene, tmp_path / "tree.sogxt", settings=FAST).note


@pytest.mark.parametrize("manifest", ["lod-meta.json", "levels.json"])
def test_a_streamed_scene_records_its_origin_which_is_that_of_the_whole_scene(manifest, tmp_path):
    scene = write(tmp_path / "a.ply", around(OFFSETS["two axes"]))
    kissgs.compress_streamed(scene, tmp_path / "tree" / manifest, settings=FAST, reading=AUTO)
    assert json.loads((tmp_path / "tree" / manifest).read_bytes())["kissgs"] == {"origin": [1000.0, 1000.0, 0.0]}
    assert kissgs.load(scene, origin="auto").origin == (1000, 1000, 0)
    assert largest_error(around(OFFSETS["two axes"]), kissgs.load(tmp_path / "tree").means.astype(float)) < SIZE / 4


def test_a_goal_that_coarse_positions_prevent_names_them(tmp_path):
    scene = write(tmp_path / "a.ply", around(OFFSETS["one axis"]))
    settings = kissgs.Settings.research(
        "balanced", psnr=60.0, max_encodes=3, sensitivity_views=4, sensitivity_view_size=64
    )
    with pytest.raises(kissgs.UnsupportedError, match="positions have steps of"):
        kissgs.compress(scene, settings=settings)


@pytest.mark.parametrize(("container", "name"), [("sogxt", JSON_NAME), ("sog", "meta.json")])
def test_a_damaged_origin_is_refused(container, name):
    scene = kissgs.sample_scene(40, sh_degree=0)
    files = dict(kissgs.compress(scene, settings=FAST, container=container).files)
    files.pop(YAML_NAME, None)
    document = json.loads(files[name])
    for origin in ([1, 2], [1, 2, "x"], "far", [1, 2, None], [1, 2, 1e999], [1e300, 0, 0], [True, 0, 0]):
        document["kissgs"] = {**document.get("kissgs", {}), "origin": origin}
        with pytest.raises(kissgs.InvalidContainerError):
            kissgs.decompress({**files, name: json.dumps(document).encode()})
