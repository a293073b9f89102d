"""Oracle: a naive writer (helpers/reference_sog.py), pixels decoded by hand, and splat-transform's files, streamed
too."""

import io
import json
import zipfile

import numpy as np
import pytest
from helpers.format_scenes import assert_alike, made_scene
from helpers.memory import takes_less_than
from helpers.reference_sog import read_files, sog_files, streamed_files, webp, write_folder, zip_of
from helpers.splat_transform import convert, needs_splat_transform
from PIL import Image

from kissgs.core.errors import InvalidContainerError, KissgsError, UnsupportedError
from kissgs.core.splats import ATTRIBUTES
from kissgs.io.ply import read_ply, write_ply
from kissgs.io.scene_format import ReadOptions
from kissgs.sog.decode import STREAMED, decode


def edited(files, change):
    """Return files whose metadata ``change`` has changed."""
    meta = json.loads(files["meta.json"])
    change(meta)
    return {**files, "meta.json": json.dumps(meta).encode()}


def png(data, mode=None):
    """Return a WebP as PNG, of another mode of Pillow if one is given."""
    image, buffer = Image.open(io.BytesIO(data)), io.BytesIO()
    if mode == "P":
        image = image.quantize(256)
        assert len(image.getcolors()) <= 4
    elif mode == "I;16":
        image = Image.fromarray(np.asarray(image)[:, :, 0].astype(np.uint16))
    elif mode:
        image = image.convert(mode)
    image.save(buffer, "PNG")
    return buffer.getvalue()


ONE = sog_files(made_scene(1, 0))


def test_rotations_by_hand():
    for pixel, wanted in (
        ((200, 100, 50, 253), (0.4020803, 0.7939361, -0.1525132, -0.4298100)),
        ((128, 128, 128, 252), (0.9999885, 0.0027730, 0.0027730, 0.0027730)),
        ((200, 100, 50, 254), (0.4020803, -0.1525132, 0.7939361, -0.4298100)),
        ((200, 100, 50, 255), (0.4020803, -0.1525132, -0.4298100, 0.7939361)),
    ):
        found = decode({**ONE, "quats.webp": webp([pixel], 1, 1, 4)})
        np.testing.assert_allclose(found.quats, [wanted], atol=1e-7)
    with pytest.raises(InvalidContainerError, match=r"quats\.webp has a rotation whose alpha is 251"):
        decode({**ONE, "quats.webp": webp([(1, 2, 3, 251)], 1, 1, 4)})


def test_positions_and_opacity_by_hand():
    files = {**ONE, "means_l.webp": webp([(0x34, 0, 255)], 1, 1, 3), "means_u.webp": webp([(0x12, 128, 255)], 1, 1, 3)}
    files["sh0.webp"] = webp([(0, 0, 0, 128)], 1, 1, 4)
    found = decode(edited(files, lambda meta: meta["means"].update(mins=[-2, -1, 0], maxs=[2, 3, 4])))
    np.testing.assert_allclose(found.means, [[-4.559854, 1.718365, 53.59815]], rtol=1e-6)
    np.testing.assert_allclose(found.opacities, [0.0078432], rtol=1e-5)
    for alpha, logit in ((0, -13.8155), (255, 13.8023)):
        files["sh0.webp"] = webp([(0, 0, 0, alpha)], 1, 1, 4)
        assert decode(files).opacities[0] == pytest.approx(logit, abs=1e-4)


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("count", [1, 65])
def test_within_half_a_step(version, degree, count):
    scene = made_scene(count, degree)
    found = decode(sog_files(scene, version=version))
    assert found.sh_degree == degree
    step = (np.log1p(np.abs(scene.means)).max() * 2) / 65535
    assert (np.abs(found.means - scene.means) <= (1 + np.abs(scene.means)) * step * 0.6 + 1e-6).all()
    for name in ("scales", "sh0", "shN"):
        values = getattr(scene, name)
        half = (values.max() - values.min()) / 255 / 2 if values.size else 0
        np.testing.assert_allclose(getattr(found, name), values, atol=half * 1.01 + 1e-6)
    assert (np.abs((found.quats * scene.quats).sum(axis=1)) > 1 - 2e-4).all()
    a, b = (1 / (1 + np.exp(-np.clip(s.opacities.astype(float), -14, 14))) for s in (found, scene))
    np.testing.assert_allclose(a, b, atol=0.02 if version == 1 else 0.51 / 255)


def test_no_gaussians():
    assert len(decode(sog_files(made_scene(0, 0)))) == 0
    assert len(decode(sog_files(made_scene(0, 2)))) == 0


def test_any_shape_of_images_and_any_number_of_threads():
    scene = made_scene(65, 2)
    wanted = decode(sog_files(scene), threads=1)
    for width, height in ((65, 1), (1, 65), (7, 30), (64, 64)):
        found = decode(sog_files(scene, width=width, height=height), threads=2)
        for name in ATTRIBUTES:
            np.testing.assert_array_equal(getattr(found, name), getattr(wanted, name))


def test_folders_zips_and_paths_below(tmp_path):
    scene = made_scene(20, 1)
    wanted = decode(sog_files(scene))
    below = sog_files(scene, names=lambda name: f"planes/{name}")
    packed = tmp_path / "a.sog"
    packed.write_bytes(zip_of(sog_files(scene), method=zipfile.ZIP_DEFLATED))
    sources = [
        write_folder(sog_files(scene), tmp_path / "flat"),
        write_folder(below, tmp_path / "below"),
        packed,
        zip_of(below),
        zip_of(sog_files(scene), folder="some folder/"),
    ]
    for source in sources:
        np.testing.assert_array_equal(decode(source).means, wanted.means)


def test_a_first_level_that_old_encoders_left_out():
    """A null is extrapolated by the mean step; other missing levels are an error if they are used."""
    files = sog_files(made_scene(30, 0))
    codebook = json.loads(files["meta.json"])["scales"]["codebook"]
    found = decode(edited(files, lambda meta: meta["scales"]["codebook"].__setitem__(0, None)))
    step = (codebook[255] - codebook[1]) / 255
    assert found.scales.min() == pytest.approx(codebook[1] - step, rel=1e-6)
    with pytest.raises(InvalidContainerError, match=r"scales\.webp uses a level for which its codebook has no number"):
        decode(edited(files, lambda meta: meta["scales"].update(codebook=codebook[:200])))
    short = webp([[199, 0, 3]] * 30, 6, 5, 3)
    found = decode(edited({**files, "scales.webp": short}, lambda meta: meta["scales"].update(codebook=codebook[:200])))
    assert found.scales[0, 0] == pytest.approx(codebook[199])


def test_a_constant_axis():
    scene = made_scene(20, 0)
    scene.means[:, 1] = -3
    np.testing.assert_allclose(decode(sog_files(scene)).means[:, 1], -3, rtol=1e-6)


GOOD = sog_files(made_scene(65, 1))

CHANGES = {
    "meta.json is of version '3'; SOG versions 1 and 2 are read": lambda m: m.update(version=3),
    "meta.json: count is not a whole number from 0 to": lambda m: m.update(count=-1),
    "meta.json: it lacks 'scales', which a SOG container has": lambda m: m.pop("scales"),
    "meta.json: means.mins is not a list of 3 finite numbers": lambda m: m["means"].update(mins=[0, 1]),
    "meta.json: means.maxs is not a list of 3 finite numbers": lambda m: m["means"].update(maxs=[0, 1, "2"]),
    "meta.json: the range of means ends beyond ±88.7": lambda m: m["means"].update(maxs=[0, 1, 90]),
    "meta.json: sh0.codebook is not a list of up to 256 numbers": lambda m: m["sh0"].update(codebook=[0] * 257),
    "meta.json: sh0.codebook has something else than finite": lambda m: m["sh0"].update(codebook=[True]),
    "meta.json: quats.files does not name 1 image": lambda m: m["quats"].update(files=["../quats.webp"]),
    "meta.json: means.files does not name 2 images": lambda m: m["means"].update(files=["a.webp"]),
    "meta.json: shN.bands is not a whole number from 1 to 3": lambda m: m["shN"].update(bands=4),
    "meta.json: shN.count is not a whole number from 1 to 65536": lambda m: m["shN"].update(count=0),
    "the container has no file 'x.webp'": lambda m: m["quats"].update(files=["x.webp"]),
    "shN_centroids.webp is 192 x 2 pixels; 65 entries of 8 coefficients": lambda m: m["shN"].update(bands=2),
    "shN_labels.webp points outside the codebook of 64 entries": lambda m: m["shN"].update(count=64),
    "quats.webp is 9 x 8 pixels, which does not fit 90 Gaussians": lambda m: m.update(count=90),
}


@pytest.mark.parametrize(("message", "change"), list(CHANGES.items()), ids=list(CHANGES))
def test_damaged_metadata(message, change):
    with pytest.raises(KissgsError) as error:
        decode(edited(GOOD, change))
    assert message in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("change", [{"model": "2dgs"}, {"asset": {"model": "2DGS"}}, {"model": "hexplane"}])
def test_other_than_3d_gaussians_are_refused(change):
    files = sog_files(made_scene(20, 0))
    meta = json.loads(files["meta.json"]) | change
    with pytest.raises(UnsupportedError, match=r"names the model '(2dgs|2DGS|hexplane)'.*export 3D Gaussians"):
        decode({**files, "meta.json": json.dumps(meta).encode()})


def test_unknown_keys_are_named():
    files = sog_files(made_scene(20, 0))
    meta = json.loads(files["meta.json"]) | {"extras": {"author": "x"}, "velocities": {}}
    assert decode(files).notes == ()
    assert decode({**files, "meta.json": json.dumps(meta).encode()}).notes == ("left out: extras, velocities",)


def test_damaged_files():
    for name, data, message in (
        ("meta.json", b"{", "meta.json is not readable JSON"),
        ("meta.json", b"[]", "meta.json is not the metadata of a SOG container"),
        ("meta.json", b'{"version": 2, "count": NaN}', "meta.json is not readable JSON"),
        ("quats.webp", b"\x89PNG" + bytes(40), "quats.webp is not a WebP image"),
        ("quats.webp", b"\x89PNG\r\n\x1a\n" + bytes(40), "quats.webp is damaged: its PNG header is missing"),
        ("quats.webp", png(GOOD["quats.webp"])[:60], "quats.webp is damaged: its PNG data cannot be decoded"),
        ("quats.webp", png(GOOD["quats.webp"], "I;16"), "quats.webp has 16 bits per channel; planes have 8"),
        ("sh0.webp", GOOD["sh0.webp"][:-20], "sh0.webp is cut off"),
    ):
        with pytest.raises(InvalidContainerError, match=message):
            decode({**GOOD, name: data})


@pytest.mark.parametrize("degree", [0, 2])
def test_planes_may_be_png(degree):
    """Planes of colours, grey ones (equal channels), and with a palette, as tools for smaller PNG write them."""
    files = sog_files(made_scene(65, degree))
    grey = files | {"scales.webp": webp([[i, i, i] for i in range(65)], 9, 8, 3)}
    few = grey | {"means_l.webp": webp([[i % 3, 5, 6] for i in range(65)], 9, 8, 3)}
    wanted = decode(few)
    images = {name: png(data) for name, data in few.items() if name != "meta.json"}
    images["scales.webp"] = png(few["scales.webp"], "L")
    images["means_l.webp"] = png(few["means_l.webp"], "P")
    found = decode({**few, **images})
    for name in ATTRIBUTES:
        np.testing.assert_array_equal(getattr(found, name), getattr(wanted, name))


def test_more_gaussians_than_the_limit_take_no_memory():
    """Constant images of 16 million pixels are some kilobytes."""
    files = edited(ONE, lambda meta: meta.update(count=16_000_000))

    def refused():
        with pytest.raises(UnsupportedError, match=r"has 16,000,000 Gaussians; the limit is 1,000"):
            decode(files, ReadOptions(max_gaussians=1000))

    assert takes_less_than(1e6, refused)


def test_images_far_larger_than_the_scene_take_no_memory():
    big = webp([(1, 2, 3)], 1500, 1500, 3)

    def refused():
        with pytest.raises(InvalidContainerError, match=r"is 1500 x 1500 pixels, which does not fit 1 Gaussians"):
            decode({**ONE, "scales.webp": big})

    assert takes_less_than(10e6, refused)


@needs_splat_transform
@pytest.mark.parametrize(("version", "degree", "count"), [(1, 3, 65), (2, 0, 1), (2, 3, 65)])
def test_splat_transform_reads_the_reference_files_as_we_do(version, degree, count, tmp_path):
    path = tmp_path / "a.sog"
    path.write_bytes(zip_of(sog_files(made_scene(count, degree), version=version)))
    theirs = read_ply(convert(path, tmp_path / "b.ply"))
    assert_alike(decode(path), theirs, rtol=1e-6, atol=1e-6)


@needs_splat_transform
def test_splat_transform_reads_streamed_reference_files_as_we_do(tmp_path):
    """Level by level; that tool wants the environment to be selected as level -1."""
    scenes = [[made_scene(65, 1), made_scene(40, 1)], [made_scene(20, 1)]]
    folder = write_folder(streamed_files(scenes), tmp_path / "folder")
    for level in (0, 1):
        target = convert(folder / "lod-meta.json", tmp_path / f"{level}.ply", "-L", str(level))
        assert_alike(STREAMED.decode(folder, ReadOptions(level=level)), read_ply(target), rtol=1e-6, atol=1e-6)


@needs_splat_transform
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("count", [1, 65])
@pytest.mark.quick(2)
def test_splat_transform_writes_what_we_read(count, degree, tmp_path):
    with (tmp_path / "a.ply").open("wb") as file:
        write_ply(file, made_scene(count, degree))
    packed = convert(tmp_path / "a.ply", tmp_path / "lod/lod-meta.json", "-i", "2")
    theirs = read_ply(convert(packed, tmp_path / "b.ply"))
    assert_alike(STREAMED.decode(packed.parent), theirs, rtol=1e-6, atol=1e-6)


def test_real_data(shared_data):
    folder = shared_data / "flowers"
    found = STREAMED.decode(folder, ReadOptions(level=3))
    assert len(found) == 26_895
    wanted = read_files({path.name: path.read_bytes() for path in (folder / "3_0").iterdir()})
    for name in ATTRIBUTES:
        np.testing.assert_allclose(getattr(found, name), wanted[name], rtol=1e-6, atol=1e-6, err_msg=name)
