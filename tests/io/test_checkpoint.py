"""Oracle: checkpoints that torch writes as the trainers do, of random values."""

import argparse
import concurrent.futures
import contextlib
import os
import sys
import zipfile

import numpy as np
import pytest
import torch
from helpers.command_line import failure, run
from helpers.format_scenes import COEFFICIENTS, made_scene

import kissgs
from kissgs.core.errors import InvalidSceneError, KissgsError, UnsupportedError
from kissgs.core.splats import ATTRIBUTES, SH_C0
from kissgs.io.checkpoint import read_checkpoint
from kissgs.io.scene_format import ReadOptions
from kissgs.pipeline.scene_files import describe


def gsplat_document(scene, **more):
    """Return what ``examples/simple_trainer.py`` of gsplat saves: ``splats.state_dict()`` of its ParameterDict."""
    values = {name: torch.from_numpy(getattr(scene, name)) for name in ATTRIBUTES}
    values["sh0"] = values["sh0"][:, None]
    splats = torch.nn.ParameterDict({name: torch.nn.Parameter(value) for name, value in values.items()})
    return {"step": 29999, "splats": splats.state_dict(), **more}


def splatfacto_document(scene):
    """Return what nerfstudio's trainer saves; its learning rates are NumPy's numbers."""
    names, prefix = {"sh0": "features_dc", "shN": "features_rest"}, "_model.gauss_params."
    values = {prefix + names.get(name, name): torch.from_numpy(getattr(scene, name)) for name in ATTRIBUTES}
    values[prefix + "opacities"] = values[prefix + "opacities"][:, None]
    values["_model.lpips.net.lin0"] = torch.ones(3, 3)
    optimizer = torch.optim.Adam([torch.nn.Parameter(values[prefix + "means"])], lr=np.float64(1e-3))
    schedulers = {"means": {"_last_lr": [np.float64(1e-4)]}}
    return {"pipeline": values, "optimizers": {"means": optimizer.state_dict()}, "schedulers": schedulers}


def saved(path, document):
    torch.save(document, path)
    return path


def assert_equal(found, wanted):
    for name in ATTRIBUTES:
        np.testing.assert_array_equal(getattr(found, name), getattr(wanted, name), err_msg=name)


@pytest.mark.parametrize("degree", range(4))
def test_gsplat(tmp_path, degree):
    scene = made_scene(30, degree)
    scene.quats[:] *= np.float32(3)
    path = saved(tmp_path / "ckpt_29999.pt", gsplat_document(scene))
    assert_equal(read_checkpoint(path), scene)
    assert kissgs.read_scene_info(path) == kissgs.SceneInfo(format="checkpoint", count=30, sh_degree=degree)
    np.testing.assert_allclose(np.linalg.norm(kissgs.load(path).quats, axis=1), 1, atol=1e-6)


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_splatfacto(tmp_path, degree):
    """Without view-dependent colour, splatfacto trains the logit of the colour itself."""
    scene = made_scene(20, degree)
    found = read_checkpoint(saved(tmp_path / "step-000007000.ckpt", splatfacto_document(scene)))
    if degree == 0:
        colour = torch.sigmoid(torch.from_numpy(scene.sh0)).numpy()
        np.testing.assert_allclose(SH_C0 * found.sh0 + 0.5, colour, atol=1e-6)
        scene.sh0[:] = found.sh0
    assert_equal(found, scene)


def test_all_ranks_of_a_step_are_read(tmp_path):
    """gsplat gives each GPU a share of the Gaussians; ten and more are not in order of their names."""
    scene = made_scene(55, 1)
    ends = np.cumsum(range(11))
    for rank, end in enumerate(ends):
        document = gsplat_document(scene.select(slice(end - rank, end)))
        saved(tmp_path / f"ckpt_29999_rank{rank}.pt", document)
    saved(tmp_path / "ckpt_6999_rank0.pt", gsplat_document(made_scene(4, 1)))
    (tmp_path / "ckpt_6999_rank1.txt").write_text("another program's")
    for rank in (0, 10):
        found = read_checkpoint(tmp_path / f"ckpt_29999_rank{rank}.pt")
        assert_equal(found, scene)
        assert found.notes[0].startswith("read from ckpt_29999_rank0.pt, ckpt_29999_rank1.pt, ")
    assert len(read_checkpoint(tmp_path / "ckpt_6999_rank0.pt")) == 4
    files = sorted(tmp_path.glob("ckpt_29999_*.pt"))
    assert describe(files[3]).bytes == sum(file.stat().st_size for file in files)
    inputs = [*files, tmp_path / "ckpt_6999_rank0.pt"]
    run("convert", *inputs, f"{tmp_path}/out/", "--to", "splat")
    assert sorted(file.name for file in (tmp_path / "out").iterdir()) == [
        "ckpt_29999_rank0.splat",
        "ckpt_6999_rank0.splat",
    ]
    (tmp_path / "ckpt_29999_rank05.pt").touch()
    with pytest.raises(InvalidSceneError, match=r"the same rank's .*ckpt_29999_rank05\.pt, .*; remove one"):
        read_checkpoint(files[0])
    (tmp_path / "ckpt_29999_rank05.pt").unlink()
    (tmp_path / "ckpt_29999_rank5.pt").unlink()
    with pytest.raises(InvalidSceneError, match="that of rank 5 is not beside it"):
        read_checkpoint(tmp_path / "ckpt_29999_rank0.pt")
    saved(tmp_path / "ckpt_6999_rank1.pt", gsplat_document(made_scene(4, 2)))
    with pytest.raises(InvalidSceneError, match=r"^ckpt_6999_rank0\.pt has attributes that make no scene: "):
        read_checkpoint(tmp_path / "ckpt_6999_rank0.pt")


def test_half_precision_and_no_gaussians(tmp_path):
    document = gsplat_document(made_scene(0, 2))
    document["splats"] = {name: value.half() for name, value in document["splats"].items()}
    found = read_checkpoint(saved(tmp_path / "a.pt", document))
    assert (len(found), found.sh_degree, found.means.dtype) == (0, 2, np.float32)


def test_the_limit_is_checked_before_memory_is_taken(tmp_path):
    """A pickle of some hundred bytes can declare a tensor of any size, all of whose rows are the same number."""
    document = gsplat_document(made_scene(1, 3))
    document["splats"] = {name: value.expand(10**10, *value.shape[1:]) for name, value in document["splats"].items()}
    path = saved(tmp_path / "a.pt", document)
    with pytest.raises(UnsupportedError, match=r"10,000,000,000 Gaussians; the limit is 20,000,000"):
        read_checkpoint(path)
    assert kissgs.read_scene_info(path).count == 10**10
    with pytest.raises(UnsupportedError, match="the limit is 2"):
        read_checkpoint(saved(path, gsplat_document(made_scene(3, 0))), ReadOptions(max_gaussians=2))


class _Runs:
    def __reduce__(self):
        return os.mkdir, ("ran",)


def test_code_in_a_pickle_is_not_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    saved(tmp_path / "a.pt", gsplat_document(made_scene(3, 0), config=_Runs()))
    assert "the rest could run code" in failure("info", "a.pt")
    assert [path.name for path in tmp_path.iterdir()] == ["a.pt"]


def changed(document, **values):
    document["splats"].update(values)
    return document


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda scene: {"state_dict": {}}, "neither 'splats'.* nor 'pipeline'"),
        (lambda scene: torch.zeros(3), "neither 'splats'"),
        (lambda scene: {"config": argparse.Namespace()}, r"tensors and numbers \(it has argparse\.Namespace\)"),
        (lambda scene: {"pipeline": {"_model.means": 1}}, r"; nerfstudio before 1\.1 wrote it: export"),
        (lambda scene: {"splats": [1, 2]}, "neither 'splats'"),
        (lambda scene: {"splats": {"features": torch.zeros(3, 32)}}, "has no means, .*, shN; .* without app_opt"),
        (lambda scene: {"pipeline": {}}, r"has no _model\.gauss_params\.means"),
        (lambda scene: changed(gsplat_document(scene), quats=3), "quats is no array"),
        (lambda scene: changed(gsplat_document(scene), means=torch.tensor(1.0)), "means is no array"),
        (lambda scene: changed(gsplat_document(scene), means=torch.zeros(3, 3).to_sparse()), "means is no array"),
        (lambda scene: changed(gsplat_document(scene), means=torch.zeros(3, 3, dtype=torch.int32)), "means is no"),
        (lambda scene: changed(gsplat_document(scene), means=torch.zeros(3, 1).expand(3, 10**10)), "means is no"),
        (lambda scene: changed(gsplat_document(scene), scales=torch.zeros(3, 2)), r"scales is .*\(3, 2\); it must be"),
        (lambda scene: changed(gsplat_document(scene), opacities=torch.zeros(2)), "opacities is .* must be"),
        (lambda scene: changed(gsplat_document(scene), sh0=torch.zeros(3, 1)), "sh0 is .* must be"),
        (lambda scene: changed(gsplat_document(scene), shN=torch.zeros(3, 14, 3)), r"shN has shape \(3, 14, 3\)"),
    ],
)
def test_other_contents(tmp_path, change, message):
    with pytest.raises(InvalidSceneError, match=rf"^a\.pt.*{message}"):
        read_checkpoint(saved(tmp_path / "a.pt", change(made_scene(3, 1))))


@pytest.mark.parametrize("data", [b"", b"text", b"PK\3\4", b"PK\5\6" + bytes(18), bytes(1000)])
def test_files_that_are_none(tmp_path, data):
    path = tmp_path / "a.ckpt"
    path.write_bytes(data)
    with pytest.raises(InvalidSceneError):
        read_checkpoint(path)
    with pytest.raises(InvalidSceneError, match=r"cannot read .*b\.ckpt: there is no such file"):
        read_checkpoint(tmp_path / "b.ckpt")


def repacked(path, compression, pickle=None):
    """Write the entries of a checkpoint as other zip programs do."""
    with zipfile.ZipFile(path) as archive:
        entries = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w", compression) as archive:
        for name, data in entries.items():
            archive.writestr(name, pickle if pickle and name.endswith("data.pkl") else data)
    return path


def test_a_checkpoint_that_was_compressed_again_is_refused(tmp_path):
    """torch maps tensors into memory without looking at the compression: their bytes were taken for numbers."""
    scene = made_scene(30, 1)
    path = saved(tmp_path / "a.pt", gsplat_document(scene))
    assert_equal(read_checkpoint(repacked(path, zipfile.ZIP_STORED)), scene)
    with pytest.raises(InvalidSceneError, match=r"^a\.pt was compressed .*; save it again with torch\.save$"):
        read_checkpoint(repacked(path, zipfile.ZIP_DEFLATED))
    with pytest.raises(InvalidSceneError, match=r"holds much more than tensors"):
        read_checkpoint(repacked(path, zipfile.ZIP_STORED, bytes(1 << 25)))
    torch.save(gsplat_document(scene), path, _use_new_zipfile_serialization=False)
    with pytest.raises(InvalidSceneError, match=r"no zip.*; save it again, by torch 1\.6 or newer$"):
        read_checkpoint(path)


def test_checkpoints_are_read_from_files_of_their_endings(tmp_path):
    data = saved(tmp_path / "a.pt", gsplat_document(made_scene(3, 1))).read_bytes()
    assert "from a file whose name ends in .pt or .ckpt" in failure("convert", "-", tmp_path / "a.ply", stdin=data)


def test_tensors_of_unusual_kinds(tmp_path):
    scene, document = made_scene(3, 1), gsplat_document(made_scene(3, 1))
    values = document["splats"]
    values["means"] = torch._neg_view(-values["means"])
    values["quats"] = torch.nn.Parameter(values["quats"])
    values["quats"].detach = values["quats"].layout2 = 1
    assert_equal(read_checkpoint(saved(tmp_path / "a.pt", document)), scene)
    with concurrent.futures.ThreadPoolExecutor(8) as pool:  # what may be unpickled is a list of the whole process
        splatfacto = saved(tmp_path / "a.ckpt", splatfacto_document(scene))
        for found in pool.map(read_checkpoint, [splatfacto] * 80):
            assert_equal(found, scene)


def test_damaged_copies_are_a_scene_or_refused(tmp_path):
    whole = bytearray(saved(tmp_path / "a.pt", gsplat_document(made_scene(4, 1))).read_bytes())
    rng = np.random.default_rng(1)
    for _ in range(60):
        data = whole.copy()
        for at in rng.integers(0, len(data), 3):
            data[at] = rng.integers(0, 256)
        (tmp_path / "a.pt").write_bytes(data[: rng.choice([len(data), len(data) // 2])])
        with contextlib.suppress(KissgsError):
            assert read_checkpoint(tmp_path / "a.pt").sh_degree < len(COEFFICIENTS)


def test_without_torch(tmp_path, monkeypatch):
    path = saved(tmp_path / "a.pt", gsplat_document(made_scene(3, 1)))
    monkeypatch.setitem(sys.modules, "torch", None)
    assert "needs torch, which is missing: pip install torch" in failure("info", path)


def test_commands_take_checkpoints(tmp_path):
    path = saved(tmp_path / "ckpt_29999_rank0.pt", gsplat_document(made_scene(40, 1, extremes=False)))
    assert b"checkpoint of a trainer" in run("info", path).stdout
    run("convert", path, tmp_path / "a.ply")
    assert_equal(kissgs.load(tmp_path / "a.ply"), kissgs.load(path))
    assert run("compress", path, "--preset", "fast").returncode == 0
    assert len(kissgs.load(tmp_path / "ckpt_29999_rank0.zip")) > 35
