"""Containers in Node.js; reference: Pillow for levels, kissgs' Python decoder for values."""

import json
import zipfile

import numpy as np
import pytest
from helpers.web_scenes import IMAGES, array_of, assert_progress, assert_scene, container, in_node, job, ulps, zipped
from helpers.web_tools import pillow

import kissgs

KINDS = [*(("fast", degree) for degree in range(4)), ("balanced", 3), ("balanced", 1), ("paper", 2)]
COUNTS = (0, 1, 7, 8, 9, 63, 64, 65, 1000)
MAX_ULPS = 1
"""Largest difference of values of JavaScript and Python, ulps: both compute in float64 and round once."""


@pytest.mark.parametrize(("preset", "degree"), KINDS)
@pytest.mark.quick(2)
def test_every_preset_degree_and_count(preset, degree):
    files = [container(preset, degree, count) for count in COUNTS]
    found = in_node(*(job(some, options={"keepPlanes": True}) for some in files))
    for report, some in zip(found, files, strict=True):
        assert sorted(report["planes"]) == sorted(IMAGES)
        assert assert_scene(report, some) <= MAX_ULPS
        assert_progress(report)


def test_every_kind_of_source(site):
    """Zips stored and deflated, in folders, with comments; bytes in every shape; addresses of folder, metadata, zip."""
    files = container()
    address = site.put("scene", files)
    site.files["/x/a zip?.zip"] = site.files["/x/scene.zip"] = zipped(files)
    found = in_node(
        *(job(files, as_=kind) for kind in ("bytes", "buffer", "blob", "within")),
        job(zipped(files, zipfile.ZIP_DEFLATED)),
        job(zipped(files, zipfile.ZIP_DEFLATED, folder="my scene/"), as_="within"),
        job(zipped(files, folder="a\\b\\")),
        job(zipped(files, comment=b"made by hand, PK\5\6 or so")),
        job(zipped({"notes.txt": b"hello", "preview/index.html": b"", **files})),
        job(address),
        job(f"{address}?token=1#here"),
        job(f"{address}meta.json"),
        job(f"{site.url}/x/scene.zip"),
        job(f"{site.url}/x/scene.zip?a/"),
        {"source": {"url": address, "as": "URL"}},
    )
    for report in found:
        assert assert_scene(report, files) <= MAX_ULPS
        assert_progress(report)
    assert found[9]["progress"][-1]["received"] == sum(len(files[name]) for name in (*IMAGES, "meta.json"))
    assert found[12]["progress"][-1]["received"] == len(zipped(files))


def test_requests_are_made_as_asked(site):
    address = site.put("private", container())
    site.received.clear()
    (report,) = in_node(job(address, options={"request": {"headers": {"Authorization": "Bearer x"}}}))
    assert assert_scene(report, container()) <= MAX_ULPS
    assert len(site.received) == 10
    assert {key for _, key in site.received} == {"Bearer x"}


def test_images_that_arrive_in_the_worst_order(site):
    """The mask arrives last, low bytes first; ``onPlane`` is called in the documented order nevertheless."""
    files = container(count=1000)
    address = site.put("late", files)
    for i, name in enumerate(("means_bytes_0", "f_rest_labels", "means_bytes_1", "active_mask")):
        site.late[f"/late/{name}.webp"] = 0.05 * (i + 1)
    (report,) = in_node(job(address))
    assert assert_scene(report, files) <= MAX_ULPS
    assert_progress(report)


def test_the_scene_has_the_values_of_decoded_images(site):
    """After the mask, values are neutral; after the high bytes, positions have low bytes of 128."""
    files = container(count=1000, degree=1)
    address = site.put("coarse", files)
    site.late["/coarse/means_bytes_0.webp"] = 0.3
    (report,) = in_node(job(address, snapshots=["active_mask.webp", "means_bytes_1.webp"]))
    assert_progress(report)
    assert assert_scene(report, files) <= MAX_ULPS
    neutral = {name: array_of(text, name) for name, text in report["snapshots"]["active_mask.webp"].items()}
    assert (neutral["quats"].reshape(-1, 4) == [1, 0, 0, 0]).all()
    assert {name: len(array) for name, array in neutral.items() if name != "centroids"} == {
        **dict.fromkeys(("means", "scales", "sh0"), 3000),
        **dict.fromkeys(("opacities", "labels", "cells"), 1000),
        "quats": 4000,
    }
    assert not any(neutral[name].any() for name in ("means", "scales", "opacities", "sh0", "labels"))
    meta = json.loads(files["meta.json"])["means"]
    low, high = float(np.float32(meta["mins"])), float(np.float32(meta["maxs"]))
    levels = pillow(files["means_bytes_1.webp"])[:, :, :3].reshape(-1, 3).astype(np.int64) * 256 + 128
    logs = low + (levels - levels.min()) / (levels.max() - levels.min()) * (high - low)
    expected = (np.sign(logs) * np.expm1(np.abs(logs))).astype(np.float32)[neutral["cells"]]
    coarse = array_of(report["snapshots"]["means_bytes_1.webp"]["means"], "means")
    assert ulps(coarse, expected.ravel()) <= MAX_ULPS
    assert (coarse != array_of(report["arrays"]["means"], "means")).any()


def test_aborting(site):
    """Aborted before, during and while waiting: the signal's reason is thrown, and no callback follows."""
    files = container()
    address = site.put("slow", files)
    site.late["/slow/f_dc.webp"] = 20
    found = in_node(
        job(files, abort="before"),
        job(address, abort="before"),
        job(files, abort="reason"),
        job(address, abort={"after": 100}),
        job(files, abort={"at": "f_dc.webp"}),
        job(address, abort={"at": "active_mask.webp"}),
    )
    names = [report["error"]["name"] for report in found]
    assert names == ["AbortError", "AbortError", "RangeError", "AbortError", "AbortError", "AbortError"]
    assert all(report["later"] == 0 for report in found)
    assert all(report["ms"] < 15_000 for report in found)  # none waited for the file
    assert [report["order"] for report in found[:3]] == [[], [], []]


def test_an_error_of_a_callback_ends_decoding():
    (report,) = in_node(job(container(), throwAt="f_dc.webp"))
    assert (report["error"]["name"], report["error"]["message"]) == ("Error", "thrown by the caller")
    assert report["later"] == 0


def test_without_workers_the_event_loop_runs_between_images():
    """A timer fires between images, so that decoding can be aborted and a page can show progress."""
    data = container(count=20_000)
    (whole,) = in_node(job(data))
    (report,) = in_node(job(data, abort={"after": 1}))
    assert whole["ended"] == len(IMAGES)
    assert report["error"]["name"] == "AbortError"
    assert report["ended"] < len(IMAGES)


def test_intact_images_are_decoded_beside_damaged_ones():
    files = container()
    damaged = {**files, "f_dc.webp": files["f_dc.webp"][:-20], "scales.webp": b"RIFF"}
    (report,) = in_node(job(damaged))
    assert report["error"]["message"].startswith("f_dc.webp: cut off")
    assert set(report["order"]) == set(IMAGES) - {"f_dc.webp", "scales.webp"}


@pytest.mark.quick(0)
def test_a_real_scene(shared_data):
    fox = next((shared_data / "fox").glob("*.ply"))
    files = dict(kissgs.compress(fox, settings=kissgs.Settings(preset="balanced")).files)
    (report,) = in_node(job(files, options={"keepPlanes": True}))
    assert assert_scene(report, files) <= MAX_ULPS
    assert_progress(report)
