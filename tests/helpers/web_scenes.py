"""Containers for the tests of the JavaScript decoder, and comparison of its results with those of kissgs."""

from __future__ import annotations

import base64
import functools
import json

import numpy as np

import kissgs
from helpers.codec_scenes import random_scene
from helpers.reference_sog import zip_of
from helpers.web_tools import pillow, run_node
from kissgs.sogxt import CHECKSUM
from kissgs.sogxt.decode import decode as decode_in_python

IMAGES = (
    *("active_mask.webp", "means_bytes_1.webp", "f_dc.webp", "opacities.webp", "scales.webp", "quaternions.webp"),
    *("means_bytes_0.webp", "f_rest_labels.webp", "f_rest_centroids.webp"),
)
TYPES = {"labels": np.uint16, "cells": np.uint32}
COEFFICIENTS = (0, 3, 8, 15)


@functools.cache
def levels_of(data):
    """Return the pixels of an image, which many tests compare with."""
    return pillow(data)


@functools.cache
def container(preset="fast", degree=3, count=65):
    """Return a container as files by name."""
    settings = kissgs.Settings.research(preset, sensitivity_views=4, sensitivity_view_size=48)
    return dict(kissgs.compress(random_scene(count, degree), settings=settings).files)


def with_meta(files, change):
    """Return the container with a changed ``meta.json``, without its checksum."""
    meta = json.loads(files["meta.json"])
    meta.pop(CHECKSUM, None)
    change(meta)
    return {**files, "meta.json": json.dumps(meta).encode()}


def without_checksums(files):
    return with_meta(files, lambda meta: meta.pop("kissgs"))


def job(source, **more):
    """Return a decoding job for the bytes of a zip, files by name, or an address."""
    if isinstance(source, str):
        return {"source": {"url": source}, **more}
    data = zip_of(source) if isinstance(source, dict) else source
    return {"source": {"base64": base64.b64encode(data).decode(), "as": more.pop("as_", "bytes")}, **more}


def in_node(*jobs):
    lines = run_node("decode_scenes.mjs", json.dumps(jobs)).splitlines()
    assert len(lines) == len(jobs)
    return [json.loads(line) for line in lines]


def refusals(*jobs):
    """Return the errors of jobs that must fail."""
    found = in_node(*jobs)
    for report, each in zip(found, jobs, strict=True):
        name = "SogError" if each.get("format") == "sog" else "SogxtError"
        assert report.get("error", {}).get("name") == name, report.get("error", "was decoded")
        assert "\n" not in report["error"]["message"]
        assert report["later"] == 0
    return [report["error"]["message"] for report in found]


def array_of(text, field):
    return np.frombuffer(base64.b64decode(text), TYPES.get(field, np.float32))


def ulps(found, wanted):
    """Return the largest difference, in units of float32's last place."""
    assert found.shape == wanted.shape
    assert np.isfinite(found).all()

    def steps(array):
        bits = np.ascontiguousarray(array, np.float32).view(np.int32).astype(np.int64)
        return np.where(bits < 0, -(1 << 31) - bits, bits)

    return int(np.abs(steps(found) - steps(wanted)).max(initial=0))


def assert_scene(answer, files):
    """Assert that a result equals that of kissgs and Pillow; return the largest difference of floats, ulps."""
    assert "error" not in answer, answer["error"]
    meta = json.loads(files["meta.json"])
    images = {name: levels_of(files[name]) for name in IMAGES}
    mask = images["active_mask.webp"][:, :, 0].ravel() > 0
    cells = np.flatnonzero(mask)
    side = meta["shN"]["centroidSide"]
    labels = images["f_rest_labels.webp"].reshape(-1, 4)[cells].astype(int)
    arrays = {field: array_of(text, field) for field, text in answer["arrays"].items()}
    assert (answer["count"], answer["gridSide"], answer["codebookSide"]) == (len(cells), meta["gridSide"], side)
    assert (arrays["cells"] == cells).all()
    assert (arrays["labels"] == labels[:, 1] * side + labels[:, 0]).all()
    assert answer["sizes"] == {name: len(files[name]) for name in (*IMAGES, "meta.json")}
    for name, (width, height, text) in answer["planes"].items():
        assert (height, width) == images[name].shape[:2]
        assert base64.b64decode(text) == images[name].tobytes(), name
    splats = decode_in_python(files)
    assert answer["degree"] == splats.sh_degree
    wanted = {name: getattr(splats, name) for name in ("means", "quats", "scales", "opacities", "sh0", "shN")}
    count, coefficients = len(cells), COEFFICIENTS[answer["degree"]]
    codebook = arrays["centroids"].reshape(side * side, 3 * coefficients)
    assert (codebook[arrays["labels"]].ravel() == arrays["shN"]).all()
    assert len(arrays["shN"]) == 3 * coefficients * count
    kinds = {"labels": "Uint16Array", "cells": "Uint32Array"}
    assert answer["types"] == {field: kinds.get(field, "Float32Array") for field in answer["types"]}
    return max(ulps(arrays[name], np.ravel(array)) for name, array in wanted.items())


def assert_progress(answer):
    """Assert that progress increases to completion, with the mask first and each image once."""
    progress = answer["progress"]
    for key in ("received", "total", "decoded"):
        values = [entry[key] for entry in progress]
        assert values == sorted(values), key
    assert all(entry["received"] <= entry["total"] for entry in progress)
    assert progress[-1]["decoded"] == progress[-1]["planes"] == 9
    assert progress[-1]["received"] == progress[-1]["total"]
    assert answer["order"][0] == "active_mask.webp"
    assert sorted(answer["order"]) == sorted(IMAGES)
    assert answer["later"] == 0
