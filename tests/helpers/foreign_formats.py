"""Readers and writers of formats that others wrote (web/foreign_formats.mjs), if scripts/setup dev has run."""

import json

import numpy as np
import pytest

from helpers.web_tools import DECODER, run_node
from kissgs.core.splats import Splats

SH_C0 = 0.28209479177387814
PACKAGES = ("@adobe/spz", "@cesium/engine", "@mkkellogg/gaussian-splats-3d", "gltf-validator", "three")

needs_foreign_formats = pytest.mark.skipif(
    not all((DECODER / "node_modules" / name).exists() for name in PACKAGES),
    reason=f"scripts/setup dev installs {', '.join(PACKAGES)}",
)


def foreign(work, file, *arguments, text=""):
    """Do one work of the program and return what it printed."""
    return json.loads(run_node("foreign_formats.mjs", text, work, file, *arguments, timeout=120))


def floats(values, *shape):
    """Return an array of numbers, of which infinite ones are text."""
    return np.array([float(value) for value in values], np.float32).reshape(shape)


def bounded(opacities):
    """Return logits with infinite ones as this library has them."""
    return np.clip(opacities, -13.8155, 13.8023).astype(np.float32)


def splats_of_cloud(cloud):
    """Return the scene of the library of .spz, in whatever axes it is."""
    count, coefficients = cloud["numPoints"], (0, 3, 8, 15)[cloud["shDegree"]]
    return Splats(
        means=floats(cloud["positions"], count, 3),
        quats=np.roll(floats(cloud["rotations"], count, 4), 1, axis=1),
        scales=floats(cloud["scales"], count, 3),
        opacities=bounded(floats(cloud["alphas"], count)),
        sh0=floats(cloud["colors"], count, 3),
        shN=floats(cloud["sh"], count, coefficients, 3),
    )


def cloud_of_splats(splats):
    """Return a scene as the library of .spz takes it, as JSON."""
    cloud = {
        "numPoints": len(splats),
        "shDegree": splats.sh_degree,
        "positions": splats.means,
        "rotations": np.roll(splats.quats, -1, axis=1),
        "scales": splats.scales,
        "alphas": splats.opacities,
        "colors": splats.sh0,
        "sh": splats.shN,
    }
    return json.dumps({key: v.ravel().tolist() if isinstance(v, np.ndarray) else v for key, v in cloud.items()})


def splats_of_rows(rows, sh=()):
    """Return the scene of GaussianSplats3D: centre, scale, rotation, and a byte each for colour and opacity."""
    count = len(rows)
    table = np.array([row[:14] for row in rows], float).reshape(count, 14)
    with np.errstate(divide="ignore"):
        opacities = -np.log(255 / table[:, 13] - 1)
        scales = np.log(table[:, 3:6])
    return Splats(
        means=table[:, :3].astype(np.float32),
        quats=table[:, 6:10].astype(np.float32),
        scales=scales.astype(np.float32),
        opacities=bounded(opacities),
        sh0=((table[:, 10:13] / 255 - 0.5) / SH_C0).astype(np.float32),
        shN=floats(sh, count, len(sh) // (3 * max(count, 1)), 3),
    )
