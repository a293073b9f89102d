"""Fine-tuning. Oracle: uninterrupted work, and the container and its renderings before fine-tuning."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
import yaml
from helpers.reference_sog import read_files
from helpers.training_scenes import around, cloud, targets_of
from helpers.tuning_scenes import Interrupted, chosen, stopping_after

import kissgs
from kissgs import FinetuneSettings, OutputError, Settings, UnsupportedError, decompress
from kissgs.cameras.views import Views, black
from kissgs.compaction.popspa import Phase, Popspa, SceneTraining
from kissgs.core.context import Context
from kissgs.core.splats import ATTRIBUTES
from kissgs.evaluation.evaluate import evaluate
from kissgs.finetuning.quantized_scene import QuantizedScene
from kissgs.finetuning.tune import Tuner, _Result
from kissgs.io.containers import zip_bytes
from kissgs.pipeline.encoding import model_of, write_files
from kissgs.pipeline.scene_files import describe
from kissgs.planning import rotation_forms
from kissgs.rendering.sensitivity import measure_sensitivity
from kissgs.sog.decode import decode as decode_sog
from kissgs.sogxt import YAML_NAME
from kissgs.sogxt.decode import decode as decode_sogxt
from kissgs.training.checkpoint import Checkpoint
from kissgs.training.loop import train
from kissgs.training.supervision import supervision_views, training_targets

SHORT = {"enabled": True, "steps": 12, "lr": 0.2, "codebook_lr": 0.3, "synthetic_lr_scale": 1.0}
SHORT |= {"views": 16, "view_size": 60}
GENTLE = {"steps": 60, "lr": 0.05, "codebook_lr": 0.05}
COARSE = {"scale_step": 0.4, "opacity_step": 1.0, "sh0_step": 0.3, "quat_step": 0.1}


both = pytest.mark.parametrize("container", ["sogxt", "sog"])


def tuner(scene, container="sogxt", size=40, **changes):
    capture = Views(around(12, size), around(7, size)[1:3], black(), "circle")
    settings = FinetuneSettings(**{**SHORT, "synthetic_view_share": 0.0, **changes})
    made_for = {"container": model_of(container), "decode": decode_sog if container == "sog" else decode_sogxt}
    supervision = supervision_views(scene, capture, settings, Context(1), scoring_stride=0)
    targets = training_targets(scene, supervision, Context(1))
    return Tuner(scene, settings, supervision, targets, Context(1), **made_for)


def written(settings, container="sogxt"):
    def files(plan, steps, context):
        return write_files(container, plan, settings, context, finetune_steps=steps)

    return files


def tuned(
    scene, container="sogxt", *, checkpoint=None, progress=None, preset="fast", encode=COARSE, work=None, **changes
):
    work = work or tuner(scene, container, **changes)
    if progress is not None:
        work = replace(work, context=replace(work.context, progress=progress))
    settings = Settings.research(preset, **encode).encode
    plan = chosen(scene, preset, model_of(container), **encode)
    return work(plan, plan, scene, written(settings, container), checkpoint)


@pytest.mark.parametrize(("degree", "rate_weight", "gain"), [(2, 0.0, 0.8), (0, 0.0, 0.3), (2, 2.0, 0)])
@pytest.mark.quick(2)
def test_fine_tuning_raises_the_psnr_to_the_original_scene(degree, rate_weight, gain):
    """Gains are 2.4 dB of degree 2 and 0.4 of degree 0, with twelve images; a weight of bits trades some for bytes."""
    encoded, report = tuned(cloud(150, degree), steps=150, rate_weight=rate_weight)
    assert report.kept
    assert report.psnr_after > report.psnr_before + gain
    assert report.bytes_after < (0.97 if rate_weight else 2) * report.bytes_before
    assert report.bytes_after == len(zip_bytes(encoded.files))
    assert report.target_source == "renderings"
    assert len(decompress(encoded.files)) == 150


@pytest.mark.cuda
def test_a_gpu_fine_tunes_as_well_as_the_cpu():
    works = [replace(tuner(cloud(150, 2), steps=100), context=Context(1, device)) for device in ("cpu", "cuda")]
    on_cpu, on_gpu = (tuned(cloud(150, 2), work=work)[1] for work in works)
    assert on_gpu.psnr_before == pytest.approx(on_cpu.psnr_before, abs=0.02)
    assert on_gpu.psnr_after == pytest.approx(on_cpu.psnr_after, abs=0.3)


@pytest.mark.parametrize(
    ("preset", "weights", "stage"), [("balanced", (0.3, 5.0), "finetune"), ("paper", (0.2, 0.0), "compact")]
)
def test_training_has_the_loss_of_the_settings(preset, weights, stage, monkeypatch):
    plans, scene = [], cloud(40, 1)
    monkeypatch.setattr(f"kissgs.{'finetuning.tune' if stage == 'finetune' else 'training.loop'}.train", capture(plans))
    settings = getattr(Settings.from_preset(preset), stage)
    work = tuner(scene, steps=2, ssim_weight=settings.ssim_weight, mse_weight=settings.mse_weight)
    if stage == "finetune":
        plan = chosen(scene, "fast")
        files = written(Settings.from_preset("fast").encode)
        work(plan, plan, scene, files)
    else:
        training = SceneTraining(Popspa(scene, settings, work.supervision, targets=work.targets), np.arange(len(scene)))
        training.begin()
        training.train(Phase("refine", 1, 40), 0, Context(1))
    assert [(plan.ssim_weight, plan.mse_weight) for plan in plans] == [weights]


def test_the_derivative_of_the_loss_contains_the_weight_of_the_squared_error():
    scene = cloud(100, 1)
    quantized = QuantizedScene(chosen(scene, "fast"), 1)
    found = [tuner(scene, mse_weight=weight)._loss_per_error(quantized) for weight in (0.0, 7.0)]
    assert found[1] - found[0] == pytest.approx(7)


def capture(plans):
    """Return a function in place of the training loop, which keeps the plan."""

    def train(scene, targets, plan, context, **others):
        plans.append(plan)

    return train


@pytest.mark.parametrize("degree", [2, 0])
@pytest.mark.quick(1)
def test_fine_tuning_of_sog_raises_the_psnr_that_others_measure(degree):
    scene = cloud(150, degree)
    encoded, report = tuned(scene, "sog", steps=300, lr=0.01, codebook_lr=0.03)  # for 8 seeds by 0.75 dB at least
    assert report.kept
    assert report.psnr_after > report.psnr_before + 0.4
    assert report.bytes_after == len(zip_bytes(encoded.files))
    measured = evaluate(scene, decompress(encoded.files), Views((), around(7)[1:3], black(), "circle"), threads=1)
    assert measured.mean.candidate.psnr == pytest.approx(report.psnr_after, abs=1e-6)


@both
def test_a_worse_container_is_not_kept(container):
    scene = cloud(80)
    encoded, report = tuned(scene, container, lr=5.0, codebook_lr=5.0, final_lr_scale=1.0)
    assert not report.kept
    assert "did not help" in report.note
    assert report.psnr_after < report.psnr_before
    settings = Settings.research("fast", **COARSE).encode
    plan = chosen(scene, "fast", model_of(container), **COARSE)
    assert encoded.files == written(settings, container)(plan, 0, Context(1)).files


def test_preset_paper_repeats_pras_twice_and_keeps_the_result(monkeypatch):
    """It has no attraction, and its learning rates are those of 3DGS after 40,000 steps."""
    made, plans, usual = [], [], rotation_forms.pras_forms
    monkeypatch.setattr(rotation_forms, "pras_forms", lambda *given, **named: made.append(1) or usual(*given, **named))
    monkeypatch.setattr(
        "kissgs.finetuning.tune.train", lambda *given, **named: plans.append(given[2]) or train(*given, **named)
    )
    published = Settings.from_preset("paper").finetune
    own = {name: getattr(published, name) for name in ("lr_offset", "attraction", "pras_at", "keeps_better")}
    work = tuner(cloud(70), **own, rate_weight=0.0, steps=10)
    scores = iter([_Result(10, 40.0, 1e-4), _Result(99, 20.0, 1e-2)])
    monkeypatch.setattr(Tuner, "_evaluate", lambda *given: next(scores))
    done = []
    work = replace(work, context=replace(work.context, progress=lambda *event: done.append((len(made), *event))))
    _, report = tuned(cloud(70), work=work, preset="paper", encode={})
    assert report.kept
    assert len(made) == 3
    notes = [event for event in done if event[1] == "finetune" and len(event) > 3]
    before = {round(10 * event[2]): event[0] for event in notes}
    assert [before[step] for step in range(10)] == [1, 1, 1, 1, 1, 1, 2, 2, 3, 3]
    (plan,) = plans
    extent = work.targets.extent
    for done_part, step in ((0.0, 40_000), (1.0, 40_010)):
        rates = plan.rates(done_part)
        assert rates.pop("attraction") == 0
        assert rates["means"] == pytest.approx(extent * 1.6e-4 * 0.01 ** (step / 30_000))
        others = {"opacities": 5e-2, "scales": 5e-3, "quaternions": 1e-3, "f_dc": 2.5e-3, "f_rest_centroids": 1.25e-4}
        assert {name: rates[name] for name in others} == others


@pytest.mark.parametrize(("container", "batch"), [("sogxt", 3), ("sog", 1)])
def test_the_result_depends_on_the_seed_but_not_on_threads(container, batch):
    scene, found, before = cloud(200, 1), [], torch.get_num_threads()
    for threads in (1, 3):
        torch.set_num_threads(threads)
        work = replace(tuner(scene, container, batch=batch), context=Context(threads))
        encoded, report = tuned(scene, container, work=work)
        found.append((encoded.files, report.psnr_after))
    torch.set_num_threads(before)
    assert found[0] == found[1]
    assert found[0][1] != tuned(scene, container, batch=batch, seed=1)[1].psnr_after


@pytest.mark.parametrize(("steps", "container"), [(5, "sogxt"), (5, "sog"), (0, "sogxt"), (1, "sog"), (12, "sogxt")])
@pytest.mark.quick(2)
def test_interrupted_work_resumes_to_the_same_bytes(tmp_path, monkeypatch, steps, container):
    """The third and the last SOG-XT choose forms anew, before the interruption and after it."""
    monkeypatch.setattr(Checkpoint, "due", True)
    scene, path = cloud(150, 1), tmp_path / "c.npz"
    forms = (
        {"lr_offset": 40_000, "pras_at": (0.3, 0.6), "rate_weight": 0.0} if (steps, container) != (0, "sogxt") else {}
    )
    work = partial(tuned, scene, container, **forms)
    whole = work()[0]
    with pytest.raises(Interrupted):
        work(checkpoint=path, progress=stopping_after(steps, "finetune"))
    assert path.exists() == (steps > 0)
    done = []
    again = work(checkpoint=path, progress=lambda stage, fraction, note="": done.append(bool(note)))[0]
    assert again.files == whole.files
    assert done.count(True) == 12 - steps + 1


def test_a_checkpoint_of_other_work_is_rejected(tmp_path, monkeypatch):
    monkeypatch.setattr(Checkpoint, "due", True)
    path = tmp_path / "c.npz"
    with pytest.raises(Interrupted):
        tuned(cloud(60), checkpoint=path, progress=stopping_after(3, "finetune"))
    for other in (
        partial(tuned, cloud(60), lr=0.03),
        partial(tuned, cloud(61)),
        partial(tuned, cloud(60), preset="paper", encode={}),
    ):
        with pytest.raises(OutputError, match="other work"):
            other(checkpoint=path)


def test_a_checkpoint_belongs_to_one_sog_container_and_its_tables(tmp_path, monkeypatch):
    monkeypatch.setattr(Checkpoint, "due", True)
    scene, path = cloud(60), tmp_path / "c.npz"
    with pytest.raises(Interrupted):
        tuned(scene, "sog", checkpoint=path, progress=stopping_after(3, "finetune"))
    plan, model = chosen(scene, "fast", model_of("sog"), **COARSE), model_of("sog")
    scales = plan.fields["scales"]
    other = replace(plan, fields={**plan.fields, "scales": replace(scales, table=scales.table + 0.01)})
    work, files = tuner(scene, "sog"), written(Settings.research("fast", **COARSE).encode, "sog")
    narrower = replace(work, container=replace(model, tables=replace(model.tables, last_drawn=253)))
    for tuning, start in ((work, other), (narrower, plan)):
        with pytest.raises(OutputError, match="other work"):
            tuning(start, start, scene, files, path)


def test_training_continues_if_a_checkpoint_cannot_be_saved(tmp_path, monkeypatch):
    monkeypatch.setattr(Checkpoint, "due", True)
    saves, whole, expected = [], Checkpoint.save, tuned(cloud(60))[0].files

    def save(self, state):
        saves.append(1)
        if len(saves) > 3:
            raise OutputError("no space left")
        whole(self, state)

    monkeypatch.setattr(Checkpoint, "save", save)
    found, report = tuned(cloud(60), checkpoint=tmp_path / "c.npz")
    assert "went on without a checkpoint: no space left" in report.note
    assert found.files == expected


def test_compress_fine_tunes_and_reports_it(tmp_path):
    settings = Settings.research("fast", finetune=SHORT)
    result = kissgs.compress(cloud(200), tmp_path / "a.zip", settings=settings, checkpoint=tmp_path / "c.npz")
    report = result.report
    assert report.finetuning.steps == 12
    assert report.as_dict()["finetuning"]["target_source"] == "renderings"
    assert report.finetuning.source.endswith("virtual cameras")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.zip"]
    again = kissgs.compress(cloud(200), settings=settings, checkpoint=tmp_path / "c.npz")
    assert again.to_zip() == result.to_zip()
    assert [path.name for path in again.checkpoints] == ["c-finetune.npz"]
    written_settings = describe(tmp_path / "a.zip").details["settings"]
    assert written_settings.get("finetune_steps", 0) == (12 if report.finetuning.kept else 0)


@pytest.mark.parametrize("degree", [3, 0])
def test_compress_fine_tunes_sog_of_every_degree(tmp_path, degree):
    scene = cloud(120, degree)
    settings = Settings.research("fast", finetune=SHORT, **COARSE)
    result = kissgs.compress(scene, tmp_path / "a.sog", settings=settings)
    report = result.report.finetuning
    assert report.steps == 12
    assert result.report.container_bytes == (report.bytes_after if report.kept else report.bytes_before)
    plain = kissgs.compress(scene, settings=Settings.research("fast", **COARSE), container="sog")
    assert (result.files == plain.files) == (not report.kept)
    found, other = kissgs.load(tmp_path / "a.sog"), read_files(result.files)
    assert found.sh_degree == degree
    for name in ATTRIBUTES:
        np.testing.assert_allclose(getattr(found, name), other[name], rtol=2e-6, atol=2e-6, err_msg=name)


@pytest.mark.parametrize(
    ("encode", "finetune", "fewer"), [(10, 80, True), (10, 10, False), (90, 80, False), (0, 80, False)]
)
@pytest.mark.quick(0)
def test_more_gaussians_are_pruned_before_fine_tuning(monkeypatch, encode, finetune, fewer):
    """The number is that of the threshold without fine-tuning, and 0 if pruning is off."""
    scene = cloud(600, 1)
    common = {"quality_offset_db": -12, "sensitivity_views": 4, "sensitivity_view_size": 60}

    def better_after_training(self, encoded, progress):
        return _Result(len(zip_bytes(encoded.files)), psnr=30.0, error=1.0 - (b"finetune" in encoded.files[YAML_NAME]))

    monkeypatch.setattr(Tuner, "_evaluate", better_after_training)

    def compressed(threshold, tuning=None):
        return kissgs.compress(
            scene, settings=Settings.research("balanced", **common, prune_threshold_bits=threshold, finetune=tuning)
        )

    found = compressed(encode, SHORT | {"prune_threshold_bits": finetune})
    assert found.report.pruned_by_rd == compressed(max(encode, finetune) if encode else 0).report.pruned_by_rd
    assert found.report.finetuning.bytes_before == compressed(encode).report.container_bytes
    assert (found.report.pruned_by_rd > compressed(encode).report.pruned_by_rd) == fewer
    threshold = float(max(encode, finetune) if encode else 0)
    settings = yaml.safe_load(found.files[YAML_NAME])["kissgs"]["settings"]
    assert settings["prune_threshold_bits"] == threshold


@pytest.mark.quick(0)
@both
def test_the_fine_tuned_container_meets_a_target_size(container):
    scene, common = cloud(600, 1), {"sensitivity_views": 4, "sensitivity_view_size": 60}
    plain = kissgs.compress(scene, settings=Settings.research("balanced", **common), container=container)
    size = int(0.8 * plain.report.container_bytes)
    settings = Settings.research("balanced", finetune={**SHORT, **GENTLE}, target_size=size, **common)
    found = kissgs.compress(scene, settings=settings, container=container)
    assert found.report.container_bytes <= size
    assert found.report.finetuning is not None
    assert len(found.report.trials) >= 2


@pytest.mark.quick(0)
def test_the_order_is_refined_for_the_trained_levels_too(monkeypatch):
    """The order that is reported is that of the container; each refinement is a stage of its own."""
    scene, stages = cloud(500, 1), []
    settings = Settings.research("fast", order="refined", finetune={**SHORT, **GENTLE})
    monkeypatch.setattr("kissgs.finetuning.tune._Result.cost", lambda result, rd_lambda: result.bytes)
    found = kissgs.compress(scene, settings=settings, progress=lambda stage, *rest: stages.append(stage))
    assert found.report.finetuning.kept
    assert "reorder" in stages[stages.index("finetune") :]
    decoded = decompress(found.files)
    np.testing.assert_allclose(decoded.means, scene.means[found.order], atol=0.05)
    assert len(np.unique(found.order)) == len(decoded)


@pytest.mark.quick(0)
def test_a_target_size_is_met_if_fine_tuned_containers_are_too_large(monkeypatch):
    """The container without fine-tuning is kept."""

    def sizes(files, *, packed):
        return 900 + 900 * (b"finetune" in files[YAML_NAME]), {}

    monkeypatch.setattr("kissgs.pipeline.search.stored_sizes", sizes)
    common = {"target_size": 1000, "sensitivity_views": 4, "sensitivity_view_size": 60}
    gentle = Settings.research("balanced", finetune={**SHORT, **GENTLE}, **common)
    found = kissgs.compress(cloud(60), settings=gentle)
    assert b"finetune" not in found.files[YAML_NAME]
    assert not found.report.finetuning.kept
    assert "this one is not fine-tuned" in found.report.finetuning.note


@pytest.mark.quick(0)
def test_a_search_does_not_change_existing_checkpoints(tmp_path):
    (tmp_path / "c-finetune.npz").write_bytes(b"mine")
    whole = {"auto_count": False}  # the search for the number of Gaussians refuses a checkpoint
    settings = Settings.research(
        "balanced", finetune=SHORT, compact=whole, target_size=50_000, sensitivity_views=4, sensitivity_view_size=60
    )
    found = kissgs.compress(cloud(60), tmp_path / "a.zip", settings=settings, checkpoint=tmp_path / "c.npz")
    assert (tmp_path / "c-finetune.npz").read_bytes() == b"mine"
    assert found.checkpoints == ()


def test_costs_count_views_as_training_does(monkeypatch):
    """Ten synthetic views, one of which has a step in each epoch, count as one of the others."""
    measured = []

    def spy(splats, cameras, **options):
        measured.append(cameras)
        return measure_sensitivity(splats, cameras, **options)

    monkeypatch.setattr("kissgs.finetuning.tune.measure_sensitivity", spy)
    scene = cloud(60)
    work = tuner(scene)
    work.targets = targets_of(scene, around(22), synthetic=10, synthetic_per_epoch=1)
    work._measure_costs(QuantizedScene(chosen(scene, "fast"), scene.sh_degree))
    assert measured[0].weights == pytest.approx([1.0] * 12 + [0.1] * 10)


def test_the_coding_error_does_not_depend_on_compaction():
    scene = cloud(300, 1)
    smaller, found = scene.select(np.arange(100)), []
    for work in (tuner(scene), replace(tuner(scene), original=smaller)):
        settings = Settings.from_preset("fast").encode
        encoded = written(settings)(chosen(smaller, "fast"), 0, Context(1))
        found.append(work._coding_error(encoded, smaller, Context(1)))
    assert found[0] == found[1]


def test_a_psnr_goal_is_rejected_if_photographs_are_the_targets(tmp_path):
    from PIL import Image

    views = []
    for view in around(3):
        Image.new("RGB", (view.camera.width, view.camera.height)).save(tmp_path / f"{view.name}.png")
        views.append(replace(view, photo=tmp_path / f"{view.name}.png"))
    settings = Settings.research("balanced", finetune=SHORT, psnr=30.0, sensitivity_views=4, sensitivity_view_size=60)
    with pytest.raises(UnsupportedError, match="give a target size"):
        kissgs.compress(cloud(60), settings=settings, views=Views(tuple(views), (), black(), "photos"))


def test_an_antialiased_scene_is_fine_tuned_with_the_opacities_that_its_images_show():
    """Training on other images would make all of its small Gaussians fainter."""
    scene = cloud(200)
    scene = replace(scene, scales=scene.scales - np.float32(1.5), antialiased=True)
    result = kissgs.compress(scene, settings=Settings.research("fast", finetune=SHORT))
    report = result.report.finetuning
    assert report.psnr_before > 35
    assert report.psnr_after > report.psnr_before - 5  # the levels of so few steps; 12 less with the wrong images
    assert kissgs.decompress(result.to_zip()).antialiased
