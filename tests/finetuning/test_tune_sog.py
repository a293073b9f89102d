"""Fine-tuning of SOG. Oracle: uninterrupted work, readers of the files, and the container before fine-tuning."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.reference_sog import read_files
from helpers.training_scenes import around, cloud
from helpers.tuning_scenes import Interrupted, chosen, stopping_after

import kissgs
from kissgs import FinetuneSettings, OutputError, Settings, decompress
from kissgs.cameras.views import Views, black
from kissgs.core.progress import silent
from kissgs.core.splats import ATTRIBUTES
from kissgs.evaluation.evaluate import evaluate
from kissgs.finetuning.tune import Tuner
from kissgs.sog.decode import decode
from kissgs.sog.encode import SOG, write_files
from kissgs.sogxt.container import zip_bytes
from kissgs.training.checkpoint import Checkpoint

SHORT = {"enabled": True, "steps": 12, "lr": 0.2, "codebook_lr": 0.3, "synthetic_lr_scale": 1.0}
SHORT |= {"views": 16, "view_size": 60}
COARSE = {"scale_step": 0.4, "opacity_step": 1.0, "sh0_step": 0.3, "quat_step": 0.1}


def tuner(scene, **changes):
    capture = Views(around(12), around(7)[1:3], black(), "circle")
    settings = FinetuneSettings(**{**SHORT, "synthetic_view_share": 0.0, **changes})
    return Tuner.of(scene, settings, capture, threads=1, container=SOG, decode=decode)


def written(scene):
    def files(plan, steps, progress):
        return write_files(plan, Settings.from_preset("fast", **COARSE).encode, threads=1)

    return files


def tuned(scene, *, checkpoint=None, progress=silent, work=None, **changes):
    plan = chosen(scene, "fast", SOG, **COARSE)
    work = replace(work or tuner(scene, **changes), progress=progress)
    return work(plan, plan, scene, written(scene), checkpoint)


@pytest.mark.parametrize("degree", [2, 0])
@pytest.mark.quick(0)
def test_fine_tuning_raises_the_psnr_to_the_original_scene(degree):
    scene = cloud(150, degree)
    encoded, report = tuned(scene, steps=300, lr=0.01, codebook_lr=0.03)  # for 8 seeds by 0.75 dB at least
    assert report.kept
    assert report.psnr_after > report.psnr_before + 0.4
    assert report.bytes_after == len(zip_bytes(encoded.files))
    measured = evaluate(scene, decompress(encoded.files), Views((), around(7)[1:3], black(), "circle"), threads=1)
    assert measured.mean.candidate.psnr == pytest.approx(report.psnr_after, abs=1e-6)


def test_a_worse_container_is_not_kept():
    scene = cloud(80)
    encoded, report = tuned(scene, lr=5.0, codebook_lr=5.0, final_lr_scale=1.0)
    assert not report.kept
    assert report.psnr_after < report.psnr_before
    assert encoded.files == written(scene)(chosen(scene, "fast", SOG, **COARSE), 0, silent).files


def test_the_result_does_not_depend_on_threads():
    scene, found, before = cloud(200, 1), [], torch.get_num_threads()
    for threads in (1, 3):
        torch.set_num_threads(threads)
        found.append(tuned(scene, work=replace(tuner(scene), threads=threads))[0].files)
    torch.set_num_threads(before)
    assert found[0] == found[1]


@pytest.mark.parametrize("steps", [5, 0, 1, 12])
@pytest.mark.quick(1)
def test_interrupted_work_resumes_to_the_same_bytes(tmp_path, monkeypatch, steps):
    monkeypatch.setattr(Checkpoint, "due", True)
    scene, path = cloud(150, 1), tmp_path / "c.npz"
    whole = tuned(scene)[0]
    with pytest.raises(Interrupted):
        tuned(scene, checkpoint=path, progress=stopping_after(steps))
    done = []
    again = tuned(scene, checkpoint=path, progress=lambda stage, fraction, note="": done.append(bool(note)))[0]
    assert again.files == whole.files
    assert done.count(True) == 12 - steps + 1


def test_a_checkpoint_belongs_to_one_container_and_its_tables(tmp_path, monkeypatch):
    monkeypatch.setattr(Checkpoint, "due", True)
    scene, path = cloud(60), tmp_path / "c.npz"
    with pytest.raises(Interrupted):
        tuned(scene, checkpoint=path, progress=stopping_after(3))
    plan = chosen(scene, "fast", SOG, **COARSE)
    scales = plan.fields["scales"]
    other = replace(plan, fields={**plan.fields, "scales": replace(scales, table=scales.table + np.float32(0.01))})
    for work, start in (
        (tuner(scene), other),
        (replace(tuner(scene), container=replace(SOG, tables=replace(SOG.tables, last_drawn=253))), plan),
    ):
        with pytest.raises(OutputError, match="other work"):
            work(start, start, scene, written(scene), path)


@pytest.mark.parametrize("degree", [3, 0, 1, 2])
@pytest.mark.quick(1)
def test_compress_fine_tunes_sog_of_every_degree(tmp_path, degree):
    scene = cloud(120, degree)
    settings = Settings.from_preset("fast", finetune=SHORT, **COARSE)
    result = kissgs.compress(scene, tmp_path / "a.sog", settings=settings)
    report = result.report.finetuning
    assert report.steps == 12
    assert result.report.container_bytes == (report.bytes_after if report.kept else report.bytes_before)
    plain = kissgs.compress(scene, settings=Settings.from_preset("fast", **COARSE), container="sog")
    assert (result.files == plain.files) == (not report.kept)
    found, other = kissgs.load(tmp_path / "a.sog"), read_files(result.files)
    assert found.sh_degree == degree
    for name in ATTRIBUTES:
        np.testing.assert_allclose(getattr(found, name), other[name], rtol=2e-6, atol=2e-6, err_msg=name)


@pytest.mark.quick(0)
def test_a_fine_tuned_container_meets_a_target_size():
    common = {"sensitivity_views": 4, "sensitivity_view_size": 60}
    scene = cloud(600, 1)
    plain = kissgs.compress(scene, settings=Settings(encode=common), container="sog")
    size = int(0.8 * plain.report.container_bytes)
    settings = Settings.from_preset("balanced", finetune={**SHORT, "lr": 0.05}, target_size=size, **common)
    found = kissgs.compress(scene, settings=settings, container="sog")
    assert found.report.container_bytes <= size
    assert found.report.finetuning is not None


@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.quick(1)
def test_scenes_of_few_gaussians(count):
    scene = cloud(9).select(np.arange(count))
    for preset in ("fast", "balanced"):
        result = kissgs.compress(scene, settings=Settings.from_preset(preset, finetune=SHORT), container="sog")
        assert len(decompress(result.to_zip())) == count
