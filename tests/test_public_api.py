"""Oracle: the list of public names as it stands here, and what a fresh interpreter has loaded."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

import kissgs
from kissgs.core import errors

PUBLIC = [
    "Camera",
    "Cancelled",
    "CompactSettings",
    "Compacted",
    "CompactionReport",
    "Compressed",
    "EncodeSettings",
    "Evaluation",
    "FinetuneReport",
    "FinetuneSettings",
    "InvalidContainerError",
    "InvalidSceneError",
    "InvalidViewsError",
    "KissgsError",
    "OutputError",
    "PlyInfo",
    "Preset",
    "Progress",
    "ReadOptions",
    "Remote",
    "RemoteError",
    "Report",
    "RunnerError",
    "SceneInfo",
    "Sensitivity",
    "Settings",
    "Splats",
    "StopSearch",
    "StreamedReport",
    "UnsupportedError",
    "View",
    "Views",
    "WeightedCameras",
    "__version__",
    "clean",
    "compact",
    "compress",
    "compress_streamed",
    "decompress",
    "evaluate",
    "load",
    "load_views",
    "measure_sensitivity",
    "read_ply_info",
    "read_scene_info",
    "recognise",
    "render",
    "sample_scene",
    "save",
    "virtual_views",
]
"""Public names; adding one is a promise, removing one breaks programs."""

HOME = str(Path(kissgs.__file__).parents[1])


def fresh(program):
    """Return the output of a program in a new interpreter."""
    run = subprocess.run(
        [sys.executable, "-P", "-c", program],
        env=os.environ | {"PYTHONPATH": HOME},
        capture_output=True,
        text=True,
        check=True,
    )
    return run.stdout.strip()


def test_the_public_names_are_these():
    assert sorted(kissgs.__all__) == PUBLIC
    assert sorted(dir(kissgs)) == PUBLIC


@pytest.mark.parametrize("name", PUBLIC)
def test_every_public_name_is_there_and_explained(name):
    value = getattr(kissgs, name)
    if name != "__version__":
        assert value.__name__ == name
        assert len(value.__doc__) > 20


def test_other_names_are_no_attributes():
    with pytest.raises(AttributeError, match="module 'kissgs' has no attribute 'frobnicate'"):
        kissgs.frobnicate  # noqa: B018


def test_star_import_gives_the_public_names():
    program = "from kissgs import *; print(sorted(name for name in dir() if not name.startswith('__')))"
    assert fresh(program) == str([name for name in PUBLIC if name != "__version__"])


HEAVY = ("torch", "numba", "scipy", "rich", "typer")


@pytest.mark.parametrize("module", ["kissgs", "kissgs.pipeline.pipeline", "kissgs.sogxt.encode", "kissgs.sogxt.decode"])
def test_importing_loads_nothing_heavy(module):
    assert fresh(f"import sys, {module}; print([name for name in {HEAVY} if name in sys.modules])") == "[]"


ENCODER = ("kissgs.planning", "kissgs.rendering", "kissgs.cameras", "kissgs.settings", "kissgs.sogxt.encode")


def test_decoding_needs_no_compiled_kernels_and_nothing_of_the_encoder(tmp_path):
    kissgs.compress(kissgs.sample_scene(50), tmp_path / "scene.zip")
    program = f"""
import sys, kissgs
splats = kissgs.decompress({str(tmp_path / "scene.zip")!r}, {str(tmp_path / "scene.ply")!r})
print([name for name in {(*HEAVY, *ENCODER)} if name in sys.modules])
"""
    assert fresh(program) == "[]"
    assert (tmp_path / "scene.ply").exists()


def test_describing_a_container_loads_only_the_reader_of_its_metadata(tmp_path):
    kissgs.compress(kissgs.sample_scene(50), tmp_path / "scene.zip")
    others = ("kissgs.io.ply", "kissgs.io.spz", "kissgs.io.gltf", "kissgs.sog.decode", "kissgs.sogxt.decode")
    program = f"""
import sys
from pathlib import Path
from kissgs.pipeline.inspect import describe
assert describe(Path({str(tmp_path / "scene.zip")!r})).kind == "sogxt"
print([name for name in {(*HEAVY, *ENCODER, *others)} if name in sys.modules])
"""
    assert fresh(program) == "[]"


@pytest.mark.parametrize(("module", "seconds"), [("kissgs", 0.1), ("kissgs.pipeline.pipeline", 0.5)])
def test_importing_is_quick(module, seconds):
    """Processor time, the best of up to three, so that a busy machine does not matter."""
    program = f"import time; start = time.process_time(); import {module}; print(time.process_time() - start)"
    assert any(float(fresh(program)) < seconds for _ in range(3))


def test_errors_form_one_tree_with_codes_of_their_own():
    kinds = [value for value in vars(errors).values() if isinstance(value, type)]
    assert {kind.__name__ for kind in kinds} == {
        name for name in PUBLIC if name.endswith("Error") or name in ("Cancelled", "StopSearch")
    }
    assert all(issubclass(kind, errors.KissgsError) for kind in kinds)
    assert len({kind.code for kind in kinds}) == len(kinds)
    assert all(kind.__name__ in errors.__doc__ for kind in kinds)
