"""SOG containers in JavaScript; oracles: kissgs' Python decoder, and splat-transform and a naive writer as encoders."""

import base64
import functools
import io
import json
import zipfile
import zlib

import numpy as np
import pytest
from helpers.codec_scenes import random_scene
from helpers.format_scenes import made_scene
from helpers.reference_sog import sog_files, webp, zip_of
from helpers.splat_transform import convert, needs_splat_transform
from helpers.web_scenes import array_of, in_node, job, refusals, ulps
from helpers.web_tools import put_value
from PIL import Image

import kissgs
from kissgs.core.errors import KissgsError
from kissgs.sog.decode import decode as decode_in_python

MAX_ULPS = 1
"""Largest difference of values of JavaScript and Python, ulps: both compute in float64 and round once."""

FIELDS = ("means", "quats", "scales", "opacities", "sh0", "shN")


def sog_job(source, **more):
    return job(source, format="sog", **more)


def assert_equal(report, source):
    """Assert that a result of JavaScript is that of Python, and that its parts fit each other."""
    assert "error" not in report, report["error"]
    splats = decode_in_python(source)
    arrays = {field: array_of(text, field) for field, text in report["arrays"].items()}
    assert (report["count"], report["degree"]) == (len(splats), splats.sh_degree)
    assert max(ulps(arrays[field], np.ravel(getattr(splats, field))) for field in FIELDS) <= MAX_ULPS
    assert (arrays["cells"] == np.arange(len(splats))).all()
    if splats.sh_degree:
        codebook = arrays["centroids"].reshape(-1, splats.shN.shape[1] * 3)
        assert (codebook[arrays["labels"]].ravel() == arrays["shN"]).all()
    else:
        assert len(arrays["labels"]) == len(arrays["centroids"]) == 0
    kinds = {"labels": "Uint16Array", "cells": "Uint32Array"}
    assert report["types"] == {field: kinds.get(field, "Float32Array") for field in report["types"]}


@functools.cache
def ours(preset, degree, count):
    settings = kissgs.Settings.research(preset, sensitivity_views=4, sensitivity_view_size=48)
    return dict(kissgs.compress(random_scene(count, degree), settings=settings, container="sog").files)


@pytest.mark.parametrize(("preset", "degree"), [("fast", 0), ("fast", 1), ("balanced", 3), ("fast", 2), ("fast", 3)])
@pytest.mark.quick(2)
def test_our_containers(preset, degree):
    files = [ours(preset, degree, count) for count in (1, 65, 1000)]
    found = in_node(*(sog_job(some, options={"keepPlanes": True}) for some in files))
    for report, some in zip(found, files, strict=True):
        assert_equal(report, some)
        images = [name for name in some if name != "meta.json"]
        assert report["order"][0] == "means_u.webp"
        assert sorted(report["order"]) == sorted(report["planes"]) == sorted(report["contents"]) == sorted(images)
        assert report["sizes"] == {name: len(data) for name, data in some.items()}
        assert report["progress"][-1]["decoded"] == report["progress"][-1]["planes"] == len(images)


@needs_splat_transform
@pytest.mark.parametrize("degree", range(4))
@pytest.mark.quick(1)
def test_containers_of_splat_transform(degree, tmp_path):
    kissgs.save(made_scene(65, degree), tmp_path / "a.ply")
    data = convert(tmp_path / "a.ply", tmp_path / "a.sog", "-i", "2").read_bytes()
    (report,) = in_node(sog_job(data))
    assert_equal(report, data)


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("degree", range(4))
@pytest.mark.quick(2)
def test_both_versions(version, degree):
    """Extreme values, no Gaussians, more labels than a byte has, images of any shape."""
    scenes = [sog_files(made_scene(count, degree), version=version) for count in (0, 1, 300)]
    scenes += [sog_files(made_scene(65, degree), version=version, width=w, height=h) for w, h in ((65, 1), (7, 30))]
    for report, some in zip(in_node(*map(sog_job, scenes)), scenes, strict=True):
        assert_equal(report, some)


def test_zips_and_folders(site):
    files = sog_files(made_scene(65, 2))
    below = sog_files(made_scene(65, 2), names=lambda name: f"planes/{name}")
    folder = site.put("scene", below)
    sources = [zip_of(files, method=zipfile.ZIP_DEFLATED), zip_of(files, folder="in/"), zip_of(below), folder]
    for report in in_node(*map(sog_job, [*sources, f"{folder}meta.json"])):
        assert_equal(report, files)


def test_images_arrive_coarse_first():
    files = ours("fast", 2, 65)
    (report,) = in_node(sog_job(files, snapshots=["means_u.webp", "means_l.webp"]))
    arrays = {field: array_of(text, field) for field, text in report["arrays"].items()}
    first = {field: array_of(text, field) for field, text in report["snapshots"]["means_u.webp"].items()}
    span = np.ptp(arrays["means"].reshape(-1, 3), axis=0).max()
    assert 0 < np.abs(first["means"] - arrays["means"]).max() < 0.05 * span
    assert (first["quats"].reshape(-1, 4) == [1, 0, 0, 0]).all()
    assert (first["scales"] == 0).all()
    last = report["snapshots"]["means_l.webp"]
    assert last["means"] == report["arrays"]["means"]


def png(data, mode=None, **options):
    """Return a WebP as PNG, of another mode of Pillow if one is given."""
    image, buffer = Image.open(io.BytesIO(data)), io.BytesIO()
    image = image.quantize(256) if mode == "P" else image.convert(mode) if mode else image
    image.save(buffer, "PNG", **options)
    return buffer.getvalue()


@pytest.mark.parametrize("degree", [0, 2])
def test_planes_may_be_png(degree):
    """Colours, alpha, grey, grey with alpha, palettes of 8, 4, 2 and 1 bits, and transparent colours."""
    files = sog_files(made_scene(65, degree))
    files["scales.webp"] = webp([[i, i, i] for i in range(65)], 9, 8, 3)
    plain = {name: png(data) for name, data in files.items() if name != "meta.json"}
    grey_alpha = webp([[i, i, i, i] for i in range(65)], 9, 8, 4)
    variants = [
        {},
        {"scales.webp": png(files["scales.webp"], "L"), "sh0.webp": png(grey_alpha, "LA")},
        *({"means_l.webp": png(webp([[i % n, 5, 6] for i in range(65)], 9, 8, 3), "P", bits=b)} for n, b in
          ((60, 8), (16, 4), (4, 2), (2, 1))),
        {"means_l.webp": png(webp([[255 * (i % 2)] * 3 for i in range(65)], 9, 8, 3), "1")},
        {"sh0.webp": png(files["scales.webp"], "L", transparency=7)},
        {"sh0.webp": png(webp([[i, 5, 6] for i in range(65)], 9, 8, 3), transparency=(7, 5, 6))},
        {"sh0.webp": png(webp([[i % 9, 5, 6] for i in range(65)], 9, 8, 3), "P", transparency=bytes([9, 0, 255]))},
    ]  # fmt: skip
    containers = [{**files, **plain, **variant} for variant in variants]
    for report, some in zip(in_node(*map(sog_job, containers)), containers, strict=True):
        assert_equal(report, some)


def test_the_filters_of_png():
    """Noise and gradients, for which encoders choose all filters."""
    rng = np.random.default_rng(0)
    rows = [[min(255, 4 * (i % 50) + i // 50), (i // 50) * 4, int(rng.integers(256))] for i in range(50 * 50)]
    scene = made_scene(1, 0)
    files = sog_files(scene.select(np.zeros(50 * 50, np.int64)))
    for channels in (3, 4):
        name = "scales.webp" if channels == 3 else "sh0.webp"
        files[name] = png(webp([[*row, 255 - row[0]][:channels] for row in rows], 50, 50, channels), compress_level=9)
    (report,) = in_node(sog_job(files))
    assert_equal(report, files)


GOOD = sog_files(made_scene(65, 2))


def edited(change):
    meta = json.loads(GOOD["meta.json"])
    change(meta)
    return {**GOOD, "meta.json": json.dumps(meta).encode()}


def put(path, value):
    """Return a container with a changed value at a dotted path of its metadata; the value ``del`` deletes it."""
    return edited(put_value(path, value))


def without(name):
    return {key: data for key, data in GOOD.items() if key != name}


LOSSY = io.BytesIO()
Image.new("RGB", (9, 8)).save(LOSSY, "WEBP")
INTERLACED = bytearray(png(GOOD["scales.webp"]))
INTERLACED[28] = 1
INTERLACED[29:33] = zlib.crc32(INTERLACED[12:29]).to_bytes(4)
PNG = png(GOOD["scales.webp"])

REFUSED = [
    (without("meta.json"), "this is no SOG container: it has no meta.json"),
    (without("quats.webp"), "this is no SOG container: it has no quats.webp"),
    ({**GOOD, "meta.json": b"{"}, "meta.json is not readable JSON"),
    ({**GOOD, "meta.json": b"null"}, "meta.json is not the metadata of a SOG container"),
    ({**GOOD, "meta.json": b"[]"}, "meta.json is not the metadata of a SOG container"),
    *((put("version", value), "meta.json: unsupported version") for value in (3, "2", 0, None, True)),
    *((put("model", value), f'meta.json names the model "{value}"') for value in ("2dgs", "2DGS", "hexplane")),
    (put("asset", {"model": "2dgs"}), 'meta.json names the model "2dgs"'),
    *((put("count", value), "meta.json: count is not a whole number") for value in (-1, 1.5, "65", None, "del", 2**40)),
    (put("count", 66 * 9), "means_u.webp: 9 x 8 pixels are too few for 594 Gaussians"),
    *((put("means.mins", value), "means.mins are not 3 numbers") for value in ([0, 0], "x", "del", [0, 0, "1"])),
    (put("means.maxs", [0, 0, 89]), "meta.json: means beyond float32"),
    *((put("scales.codebook", value), "scales.codebook is not a list") for value in ("del", [], [0.0] * 257, 5)),
    *((put("sh0.codebook", value), "sh0.codebook has something else") for value in ([1, "2"], [True], [1e39])),
    (put("sh0.codebook", [0.0, 1.0]), "sh0.webp uses a level for which its codebook has no number"),
    (put("shN.codebook", [0.0]), "shN_centroids.webp uses a level for which its codebook has no number"),
    (put("quats.files", ["a", "b"]), "meta.json: quats.files does not name 1 image"),
    *((put("quats.files", [name]), "does not name") for name in ("../quats.webp", "", "/a", "a\\b", "a//..", 5, "http://x")),
    (put("quats.files", ["scales.webp"]), "meta.json names an image twice"),
    *((put("shN.bands", value), "meta.json: shN.bands is not") for value in (0, 4, "2")),
    (put("shN.bands", 3), "shN_centroids.webp: 512 x 2 pixels; 65 entries need 960 x 2"),
    *((put("shN.count", value), "meta.json: shN.count is not") for value in (0, 65537, "del")),
    (put("shN.count", 64), "shN_labels.webp points outside the codebook of 64 entries"),
    (put("shN", 5), "meta.json: shN"),
    ({**GOOD, "quats.webp": webp([(1, 2, 3, 251)] * 65, 9, 8, 4)}, "quats.webp has a rotation whose alpha is 251"),
    ({**GOOD, "quats.webp": webp([(1, 2, 3, 252)], 1, 1, 4)}, "quats.webp: 1 x 1 pixels are too few"),
    ({**GOOD, "sh0.webp": GOOD["sh0.webp"][:-20]}, "sh0.webp: cut off"),
    ({**GOOD, "sh0.webp": b""}, "sh0.webp: not a WebP file"),
    ({**GOOD, "sh0.webp": webp([(1, 2, 3)], 1200, 1200, 3)}, "1440000 pixels|1200 x 1200"),
    ({**GOOD, "scales.webp": LOSSY.getvalue()}, "scales.webp: lossy WebP"),
    ({**GOOD, "scales.webp": b"\x89PNG" + bytes(40)}, "scales.webp: not a WebP file"),
    ({**GOOD, "scales.webp": PNG[:60]}, "scales.webp: cut off"),
    ({**GOOD, "scales.webp": PNG[:45] + b"\0" + PNG[46:]}, "scales.webp: damaged: it does not match its checksums"),
    ({**GOOD, "scales.webp": bytes(INTERLACED)}, "scales.webp: interlaced PNG"),
    ({**GOOD, "scales.webp": png(webp([(1, 2, 3)], 1200, 1200, 3))}, "scales.webp: 1200 x 1200 pixels, more than"),
    (zip_of(GOOD)[:-40], "not a zip file, or one that is cut off"),
    (b"Dear reader", "not a zip file"),
]  # fmt: skip


def test_damaged_containers_get_a_sentence():
    for error, (_, why) in zip(refusals(*(sog_job(source) for source, _ in REFUSED)), REFUSED, strict=True):
        assert any(part in error for part in why.split("|")), (error, why)


def test_a_first_level_that_old_encoders_left_out():
    def change(meta):
        meta["scales"]["codebook"][0] = None

    files = edited(change)
    (report,) = in_node(sog_job(files))
    assert_equal(report, files)


def test_more_gaussians_than_allowed():
    (error,) = refusals(sog_job(GOOD, options={"maxGaussians": 64}))
    assert error == "65 Gaussians, more than the 64 allowed (maxGaussians)"
    (report,) = in_node(sog_job(GOOD, options={"maxGaussians": 65}))
    assert_equal(report, GOOD)


@pytest.mark.quick(0)
@pytest.mark.parametrize("name", [*GOOD, "png"])
def test_mutations_decode_as_in_python_or_are_refused(name):
    """The zip around the changed file has a checksum that fits it. Python may refuse more."""
    rng = np.random.default_rng(len(name))
    files = {**GOOD, "sh0.webp": PNG} if name == "png" else GOOD
    name = "sh0.webp" if name == "png" else name
    mutants = []
    for _ in range(150):
        data = bytearray(files[name])
        for at in rng.integers(0, len(data), rng.integers(1, 4)):
            data[at] = rng.integers(256)
        mutants.append({**files, name: bytes(data)})
    found = in_node(*map(sog_job, mutants))
    decoded = 0
    for report, some in zip(found, mutants, strict=True):
        if "error" in report:
            assert report["error"]["name"] == "SogError", report["error"]
            continue
        try:
            decode_in_python(some)
        except KissgsError:
            continue
        decoded += 1
        assert_equal(report, some)
    assert decoded < len(mutants)


def test_base64_of_planes_equals_pillow():
    """Alpha is data: the colours under a small alpha stay."""
    (report,) = in_node(sog_job(GOOD, options={"keepPlanes": True}))
    for name, (width, height, text) in report["planes"].items():
        image = np.asarray(Image.open(io.BytesIO(GOOD[name])).convert("RGBA"))
        assert image.shape[:2] == (height, width)
        assert base64.b64decode(text) == image.tobytes(), name
