"""The page's check of a file before the upload, in Node; oracle: what the files were made of."""

import json
import subprocess
from pathlib import Path

import pytest
from helpers.format_scenes import made_scene
from helpers.reference_gltf import attributes, document, glb_bytes
from helpers.reference_sog import sog_files, zip_of
from helpers.reference_splat import ksplat_bytes, splat_bytes
from helpers.reference_spz import spz_bytes
from helpers.service import MESH, SMALL
from helpers.web_tools import node

SCRIPT = """
import { readFile } from "node:fs/promises";
import { basename } from "node:path";
const { inspect } = await import(process.argv[2]);
const limits = { max_upload_bytes: 1e9, max_header_bytes: 65536, max_gaussians: 1000,
  formats: ["ply", "sog", "spz", "splat", "ksplat", "glb", "compressed.ply"] };
for (const path of process.argv.slice(3)) {
  const file = new File([await readFile(path)], basename(path));
  console.log(JSON.stringify(await inspect(file, limits).catch((error) => error.message)));
}
"""

SCENE = made_scene(40, 1, extremes=False)
NO_SCENE = " is a mesh or a point cloud, not a Gaussian splatting scene: send the trained scene."
MANY = made_scene(1001, 0, extremes=False)
FILES = {
    "a.ply": (SMALL, {"gaussians": 300, "shDegree": 1, "packed": False}),
    "a.sog": (zip_of(sog_files(SCENE)), {"gaussians": None, "shDegree": None, "packed": False}),
    "a3.spz": (spz_bytes(SCENE, 3), {"gaussians": 40, "shDegree": 1, "packed": False}),
    "cut.spz": (spz_bytes(SCENE, 3)[:9], {"gaussians": None, "shDegree": None, "packed": False}),
    "a4.spz": (spz_bytes(SCENE, 4), {"gaussians": 40, "shDegree": 1, "packed": False}),
    "a.splat": (splat_bytes(SCENE), {"gaussians": 40, "shDegree": 0, "packed": False}),
    "a.ksplat": (ksplat_bytes([SCENE], 1), {"gaussians": 40, "shDegree": None, "packed": False}),
    "a.glb": (glb_bytes(*document(attributes(SCENE))), {"gaussians": None, "shDegree": None, "packed": False}),
    "mesh.glb": (glb_bytes({"asset": {"version": "2.0"}, "meshes": []}, b""), f"mesh.glb{NO_SCENE}"),
    "mesh.ply": (MESH, f"mesh.ply{NO_SCENE}"),
    "many.splat": (splat_bytes(MANY), "many.splat has 1,001 Gaussians; the limit of this service is 1,000."),
    "half.splat": (
        splat_bytes(SCENE)[:-1],
        "half.splat is not a scene: send a .ply, .sog, .spz, .splat, .ksplat or .glb.",
    ),
    "unknown.spz": (b"hello", {"gaussians": None, "shDegree": None, "packed": False}),
    "a.txt": (b"hello", "a.txt is not a scene: send a .ply, .sog, .spz, .splat, .ksplat or .glb."),
}


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    folder = tmp_path_factory.mktemp("files")
    for name, (data, _) in FILES.items():
        (folder / name).write_bytes(data)
    (folder / "check.mjs").write_text(SCRIPT)
    module = Path(__file__).parents[2] / "service/static/ply.js"
    call = [node(), folder / "check.mjs", module, *(folder / name for name in FILES)]
    done = subprocess.run(list(map(str, call)), capture_output=True, text=True, check=True, timeout=60)
    return dict(zip(FILES, map(json.loads, done.stdout.splitlines()), strict=True))


@pytest.mark.parametrize("name", FILES)
def test_files_before_the_upload(name, found):
    assert found[name] == FILES[name][1]
