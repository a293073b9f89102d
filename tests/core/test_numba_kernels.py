"""Kernels are compiled by the first process or loaded from the cache, and never again while a command works."""

import ast
import os
import pickle
import subprocess
import sys
from pathlib import Path

import numba
import pytest

import kissgs

PROGRAM = """
import importlib, pkgutil, sys, tempfile
from pathlib import Path
import kissgs
for module in pkgutil.walk_packages(kissgs.__path__, "kissgs."):
    if "kernel" in module.name or module.name.startswith(("kissgs.core.", "kissgs.rendering.")):
        importlib.import_module(module.name)
from numba.core import event

class Printer(event.Listener):
    def on_start(self, event):
        print(event.data["dispatcher"].py_func.__name__)

    def on_end(self, event):
        pass

event.register("numba:compile", Printer())
from helpers.photographed import photographs, with_photographs
from helpers.training_scenes import cloud
scene = cloud(60)
with tempfile.TemporaryDirectory() as folder:
    views = photographs(scene, Path(folder))
    kissgs.compress(scene, settings=with_photographs(max_psnr_drop=1, max_ssim_drop=0.05), views=views, evaluate=True)
few = {"sensitivity_views": 4, "sensitivity_view_size": 48}
tuned = kissgs.Settings.research("balanced", finetune={"enabled": True, "steps": 2, "views": 4, "view_size": 48}, **few)
kissgs.compress(scene, settings=tuned, container="sog")
merged = kissgs.Settings.research("balanced", compact={"ratio": 0.5, "method": "merge", "views": 4, "view_size": 48})
kissgs.compact(scene, settings=merged)
"""


def decorators_of(node):
    """Return the names of a function's decorators."""
    return {name.id for each in getattr(node, "decorator_list", []) for name in ast.walk(each) if hasattr(name, "id")}


def test_functions_without_a_signature_are_called_by_kernels_alone():
    """Kernels compile nothing but their signature, and are cached. Oracle: the syntax trees of the modules."""
    texts = [path.read_text(encoding="utf-8") for path in Path(kissgs.__file__).parent.rglob("*.py")]
    trees = [ast.parse(text) for text in texts if "njit" in text]
    bare = 0
    for tree in trees:
        names = {node.name for node in tree.body if "njit" in decorators_of(node)}
        bare += len(names)
        for node in tree.body:
            if not decorators_of(node) & {"compiled", "njit"}:
                assert names.isdisjoint(name.id for name in ast.walk(node) if isinstance(name, ast.Name)), node.lineno
    assert bare > 5


@pytest.mark.quick(0)
def test_no_kernel_is_compiled_while_a_scene_is_compressed():
    """Regression: one without a signature was compiled by every process, not only by the first with an empty cache."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    command = [sys.executable, "-c", PROGRAM]
    for _ in range(2):
        done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
        assert done.returncode == 0, done.stderr[-2000:]
        if not done.stdout:
            return
    raise AssertionError(done.stdout)


GRADIENT = """
import hashlib, numpy
from kissgs.core.context import Workers
from kissgs.rendering.metrics import differences_and_ssim
image, target = numpy.random.default_rng(1).random((2, 2, 72, 96, 3), dtype=numpy.float32)
gradient = numpy.empty_like(image)
with Workers(1) as pool:
    differences_and_ssim(image, target, pool, gradient, (0.7, 0.3, 0.1))
print(hashlib.sha256(gradient.tobytes()).hexdigest())
"""


@pytest.mark.quick(0)
def test_results_do_not_depend_on_whether_kernels_come_from_the_cache(tmp_path):
    """Regression: the process that compiled the kernels of SSIM rounded its gradient in another way than later ones."""
    paths = os.pathsep.join(path for path in sys.path if path)
    environment = {**os.environ, "PYTHONPATH": paths, "NUMBA_CACHE_DIR": str(tmp_path)}
    command = [sys.executable, "-c", GRADIENT]
    first, second = (subprocess.run(command, capture_output=True, check=True, env=environment).stdout for _ in range(2))
    assert list(tmp_path.rglob("*.nbi"))
    assert len(first) > 64
    assert first == second
    for index in tmp_path.rglob("*.nbi"):  # as left by a version with a module of another name
        version = index.read_bytes()[: len(pickle.dumps(numba.__version__, protocol=-1))]
        assert pickle.loads(version) == numba.__version__
        index.write_bytes(version + b"cgone\nname\n.")
    done = subprocess.run(command, capture_output=True, check=False, env=environment)
    assert done.stdout == first, done.stderr.decode()[-2000:]
