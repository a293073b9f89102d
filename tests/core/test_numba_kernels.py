"""Kernels are compiled on import or loaded from the cache, and never again while a command works."""

import os
import pickle
import subprocess
import sys

import numba

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
scene = cloud(150)
with tempfile.TemporaryDirectory() as folder:
    views = photographs(scene, Path(folder))
    kissgs.compress(scene, settings=with_photographs(max_psnr_drop=1, max_ssim_drop=0.05), views=views, evaluate=True)
tuned = kissgs.Settings.from_preset("small", finetune={"enabled": True, "steps": 2})
kissgs.compress(scene, settings=tuned, container="sog")
kissgs.compact(scene, settings=kissgs.Settings.from_preset("balanced", compact={"ratio": 0.5, "method": "merge"}))
"""


def test_no_kernel_is_compiled_while_a_scene_is_compressed():
    """Regression: one without a signature was compiled by every process, which announced that it was cached."""
    paths = os.pathsep.join(path for path in sys.path if path)
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": paths},
        check=False,
    )
    assert (done.returncode, done.stdout) == (0, ""), done.stderr[-2000:]


GRADIENT = """
import hashlib, numpy, torch
from kissgs.rendering.differentiable import photometric_loss
image, target = torch.from_numpy(numpy.random.default_rng(1).random((2, 2, 72, 96, 3), dtype=numpy.float32))
photometric_loss(image.requires_grad_(), target, ssim_weight=0.3, mse_weight=0.1).backward()
print(hashlib.sha256(image.grad.numpy().tobytes()).hexdigest())
"""


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
