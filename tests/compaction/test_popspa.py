"""POPSpa. Oracle: its parts called one by one, the same work without interruption, and renderings of the original."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.training_scenes import around, cloud, same, targets_of
from helpers.tuning_scenes import Interrupted, stopping_after
from PIL import Image

import kissgs
from kissgs import CompactSettings, OutputError, Settings, UnsupportedError
from kissgs.cameras.views import View, Views, black
from kissgs.cameras.virtual.samples import scene_views
from kissgs.compaction.budget import compact_scene
from kissgs.compaction.popspa import Popspa
from kissgs.compaction.scoring import highest_indices, prune_by_score
from kissgs.core.context import Context
from kissgs.core.splats import ATTRIBUTES
from kissgs.rendering.camera import look_at
from kissgs.rendering.rasterizer import render
from kissgs.rendering.sensitivity import Coverage
from kissgs.training.checkpoint import Checkpoint
from kissgs.training.supervision import SupervisionViews, supervision_views, training_targets

SHORT = {"sparsify_steps": 8, "refine_steps": 6, "prune_rounds": 2, "min_keep_per_scoring": 0.6, "admm_interval": 3}
NO_TRAINING = {"sparsify_steps": 0, "refine_steps": 0}


def five_views():
    return SupervisionViews(around(5), around(5), around(3), black(), "five views")


def settings(**changes):
    return CompactSettings(**{**SHORT, **changes})


def error(scene, original, views):
    images = [[render(one, view.camera)[0] for one in (scene, original)] for view in views]
    return np.mean([(a - b) ** 2 for a, b in images])


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"prune_rounds": 1},
        {"prune_rounds": 1000},
        {"sparsify_steps": 0},
        {"refine_steps": 0},
        NO_TRAINING,
        {"initial_prune_fraction": 0.0},
        {"initial_prune_fraction": 1.0},
        {"erank_weight": 0.1, "min_scale_weight": 0.1},
    ],
)
@pytest.mark.parametrize("count", [1, 59])
@pytest.mark.quick(3)
def test_the_result_has_exactly_the_requested_count_and_its_indices(count, changes):
    scene = cloud(60)
    result = Popspa(scene, settings(**changes), five_views())(count)
    assert len(result.splats) == len(result.index) == result.report.count == count
    assert result.report.source_count == 60
    assert (np.diff(result.index) > 0).all()
    assert all(np.isfinite(getattr(result.splats, name)).all() for name in ATTRIBUTES)
    moved = np.linalg.norm(result.splats.means - scene.means[result.index], axis=1)
    assert moved.max() < 0.2, "each is near its original position"
    counts = [step.count for step in result.report.steps]
    assert counts[0] == 60
    assert counts == sorted(counts, reverse=True)


@pytest.mark.parametrize(("captured", "min_score"), [(True, 0.05), (False, 0.3)])
def test_without_training_the_scene_is_only_pruned(captured, min_score):
    """The lowest score of unseen Gaussians is smaller with a capture, whose cameras show what matters."""
    scene, supervision = cloud(60), replace(five_views(), captured=captured)
    result = Popspa(scene, settings(**NO_TRAINING), supervision)(20)
    kept = prune_by_score(scene, supervision.train, black(), 20, min_keep_per_scoring=0.6, min_score=min_score)
    assert (result.index == kept).all()
    assert same(result.splats, scene.select(kept))
    assert result.report.target_source == "nothing"


def test_preset_paper_prunes_what_no_view_shows_first():
    """Oracle: scores of 0, which the lowest score of other presets replaces."""
    scene = cloud(60)
    means = scene.means.copy()
    means[:20] += 500
    compact = Settings.from_preset("paper").compact
    for floor in (1.0, compact.score_floor):
        result = Popspa(replace(scene, means=means), settings(score_floor=floor, **NO_TRAINING), five_views())(40)
        assert (result.index.min() >= 20) == (floor == 0)


def test_preset_paper_trains_as_3dgs_would_go_on(monkeypatch):
    """Effective rank is a term while opacities are sparsified; rates of positions are those of steps 30,000 to 40,000
    in units of the extent of all cameras."""
    plans, models = [], []

    def spied(scene, targets, plan, context, **others):
        plans.append(plan)
        models.append(scene)

    monkeypatch.setattr("kissgs.training.loop.train", spied)
    views = five_views()
    Popspa(cloud(60), Settings.from_preset("paper").compact, views)(20)
    terms = [[type(term).__name__ for term in plan.regularizers] for plan in plans]
    assert terms == [["ShapeRegularizer", "AdmmSparsifier"], []]
    rates = [plan.rates(done)["means"] for plan in plans for done in (0.0, 1.0)]
    wanted = [1.6e-4 * 0.01 ** (step / 30_000) for step in (30_000, 35_000, 35_000, 40_000)]
    assert rates == pytest.approx(wanted)
    assert plans[1].rates(0.5)["opacities"] == 5e-2
    extent = targets_of(cloud(60), views.train).extent
    assert models[0]._adam._leaves["means"].factors.numpy() == pytest.approx(extent)


def test_training_reduces_the_error_of_pruning():
    scene, supervision = cloud(200), five_views()
    pruned = Popspa(scene, settings(**NO_TRAINING), supervision)(60)
    trained = Popspa(scene, settings(sparsify_steps=60, refine_steps=120), supervision)(60)
    assert error(trained.splats, scene, supervision.train) < 0.5 * error(pruned.splats, scene, supervision.train)


def test_steps_are_reported():
    result = Popspa(cloud(100), settings(initial_prune_fraction=0.5), five_views())(20, evaluate=True)
    names = [step.name for step in result.report.steps]
    assert names == ["input", "prune", "sparsify", "prune", "sparsify", "prune", "refine"]
    assert [step.count for step in result.report.steps] == [100, 45, 45, 30, 30, 20, 20]
    first, *others = result.report.steps
    assert first.psnr == float("inf")
    assert first.ssim == first.ms_ssim == 1
    assert all(
        0 < step.psnr < 100 and step.ssim < 1 and 0 < step.ms_ssim < 1 and step.bytes < first.bytes for step in others
    )
    assert result.report.as_dict()["steps"][0]["psnr"] is None
    even = Popspa(cloud(100), settings(sparsify_steps=10, prune_rounds=3, initial_prune_fraction=0.0), five_views())(10)
    assert [step.count for step in even.report.steps if step.name == "prune"] == [100, 46, 22, 10]


def test_the_result_depends_on_the_seed_but_not_on_threads():
    before = torch.get_num_threads()
    found = [Popspa(cloud(300, 2), settings(), five_views(), Context(threads))(50) for threads in (1, 3)]
    assert torch.get_num_threads() == before
    assert same(found[0].splats, found[1].splats)
    assert not same(found[0].splats, Popspa(cloud(300, 2), settings(seed=1), five_views())(50).splats)


@pytest.mark.parametrize("steps", [0, 3, 4, 9, 13, 15])
@pytest.mark.quick(1)
def test_interrupted_work_resumes_to_the_same_result(tmp_path, monkeypatch, steps):
    """The state of ADMM is resumed, too; a checkpoint before the first step has none."""
    monkeypatch.setattr(Checkpoint, "due", True)
    task = Popspa(cloud(80), settings(admm_rho=0.01, admm_interval=1), five_views())
    whole = task(20, evaluate=True)
    assert not same(whole.splats, replace(task, settings=settings(admm_rho=0.0))(20).splats)
    path = tmp_path / "c.npz"
    with pytest.raises(Interrupted):
        replace(task, context=Context(progress=stopping_after(steps)))(20, evaluate=True, checkpoint=path)
    assert path.exists()
    stages = []
    listening = replace(task, context=Context(progress=lambda stage, fraction, note="": stages.append(stage)))
    again = listening(20, evaluate=True, checkpoint=path)
    assert same(whole.splats, again.splats)
    assert (whole.index == again.index).all()
    reported = [[(step.name, step.count, step.psnr, step.bytes) for step in one.report.steps] for one in (whole, again)]
    assert reported[0] == reported[1]
    assert steps <= 10 or "sparsify" not in stages
    stages.clear()
    third = listening(20, evaluate=True, checkpoint=path)
    assert same(whole.splats, third.splats), "completed work is not repeated"
    assert set(stages) == {"kernels"}


def test_training_continues_if_a_later_checkpoint_cannot_be_saved(tmp_path, monkeypatch):
    monkeypatch.setattr(Checkpoint, "due", True)
    saves, whole = [], Checkpoint.save

    def save(self, state):
        saves.append(1)
        if len(saves) > 3:
            raise OutputError("cannot write c.npz: no space left on device")
        whole(self, state)

    monkeypatch.setattr(Checkpoint, "save", save)
    result = Popspa(cloud(80), settings(), five_views())(20, checkpoint=tmp_path / "c.npz")
    assert len(result.splats) == 20
    assert result.report.note == "the work went on without a checkpoint: cannot write c.npz: no space left on device"


def test_a_file_that_is_no_checkpoint_is_not_overwritten(tmp_path):
    path = tmp_path / "thesis.npz"
    for steps in ({}, NO_TRAINING):
        path.write_text("years of work")
        with pytest.raises(OutputError, match="is no checkpoint of kissgs"):
            Popspa(cloud(80), settings(**steps), five_views())(20, checkpoint=path)
        assert path.read_text() == "years of work"


@pytest.mark.parametrize("compact", [{"method": "prune"}, {"method": "prune", "count": 1000}])
def test_without_training_the_checkpoint_file_is_not_touched(tmp_path, compact):
    path = tmp_path / "thesis.npz"
    path.write_text("years of work")
    fast = kissgs.Settings.research("fast", compact=compact)
    kissgs.compress(cloud(50), tmp_path / "o.zip", settings=fast, checkpoint=path)
    assert path.read_text() == "years of work"


@pytest.mark.parametrize("turn", [0.0, 0.1])
def test_cameras_at_one_position(turn):
    """A tripod: the extent of the cameras is 0 or a rounding error, and unrelated to the size of the scene."""
    position, up = np.array([1.3, -2.7, 1.9]), np.array([0.0, -1, 0])
    aims = [np.array([turn * n, 0.0, 0.0]) for n in range(5)]
    cameras = [look_at(position, aim, up, fov=0.9, width=40, height=32) for aim in aims]
    rotated = tuple(View(f"{n}", camera) for n, camera in enumerate(cameras))
    extent = targets_of(cloud(5), rotated).extent
    assert extent < 1e-10
    assert (extent > 0) == (turn > 0)
    scene = cloud(60)
    supervision = SupervisionViews(rotated, rotated, rotated, black(), "")
    result = Popspa(scene, settings(min_scale_weight=1.0, erank_weight=0.1), supervision)(30)
    assert np.abs(result.splats.means - scene.means[result.index]).max() > 1e-4
    assert np.abs(result.splats.scales - scene.scales[result.index]).max() < 0.15, "the smallest scales do not collapse"


def test_a_checkpoint_of_other_work_is_rejected(tmp_path, monkeypatch):
    monkeypatch.setattr(Checkpoint, "due", True)
    path = tmp_path / "c.npz"
    task = Popspa(cloud(80), settings(), five_views())
    with pytest.raises(Interrupted):
        replace(task, context=Context(progress=stopping_after(3)))(20, checkpoint=path)
    four_views = SupervisionViews(around(4), around(4), around(3), black(), "four views")
    sampled = tuple(replace(view, camera=replace(view.camera, dilation=0.1)) for view in task.supervision.train)
    others = {
        "dilation": (replace(task, supervision=replace(task.supervision, train=sampled)), 20, False),
        "scene": (replace(task, splats=cloud(80, seed=5)), 20, False),
        "settings": (replace(task, settings=settings(admm_rho=1e-3)), 20, False),
        "views": (replace(task, supervision=four_views), 20, False),
        "count": (task, 21, False),
        "evaluation": (task, 20, True),  # earlier steps would have no metrics
    }
    for name, (other, count, evaluate) in others.items():
        with pytest.raises(OutputError, match="checkpoint of other work"):
            other(count, evaluate=evaluate, checkpoint=path)
        assert path.exists(), name


def test_a_checkpoint_that_cannot_be_written_is_reported_first(tmp_path, monkeypatch):
    monkeypatch.setattr(Checkpoint, "due", True)
    with pytest.raises(OutputError, match="there is no folder"):
        Popspa(cloud(80), settings(), five_views())(20, checkpoint=tmp_path / "nowhere" / "c.npz")


@pytest.mark.quick(0)
def test_virtual_views_train_without_a_capture():
    scene = kissgs.sample_scene(400, sh_degree=0)
    found = supervision_views(scene, None, settings(views=64, view_size=50))
    assert 56 <= len(found.train) <= 4 * 56  # several regions
    scoring = len(range(0, len(found.train), 4))
    assert [view.camera.width for view in found.score] == [30] * scoring + [7] * 4 * scoring
    for part in (found.score[:scoring], found.score[scoring:]):
        assert [view.background[0] for view in part[:4]] == [0.0, 0.5, 1.0, 0.0]
    other = supervision_views(scene, None, settings(views=64, view_size=50, seed=9)).score[-1].camera.position
    assert not np.array_equal(found.score[-1].camera.position, other)
    assert [view.background for view in found.train] == [None] * len(found.train)
    assert len(found.test) == min(-(-len(found.train) // 7), 16)
    assert all(max(view.camera.width, view.camera.height) <= 50 for view in found.train)
    only_scoring = supervision_views(scene, None, settings(views=64, view_size=50), scoring_stride=1)
    assert abs(len(only_scoring.score) - len(found.score)) <= 10, "as many, but for regions of a few views"
    assert supervision_views(scene, None, settings(views=64, view_size=50), scoring_stride=0).score == ()
    result = Popspa(scene, settings(), found)(100)
    assert result.report.target_source == "renderings"
    assert result.report.source.startswith(f"{len(found.train)} virtual cameras, and ")


@pytest.mark.parametrize(("share", "some"), [(0.0, 0), (0.1, 1), (0.5, 5)])
def test_a_capture_is_mixed_with_synthetic_views(share, some):
    """The capture's views come first; held-out views are never used for training."""
    capture = Views(around(5), around(3), black(), "a capture")
    scene = kissgs.sample_scene(400, sh_degree=0)
    found = supervision_views(scene, capture, settings(synthetic_view_share=share))
    virtual = 64 if share else 0
    assert (len(found.train), found.synthetic, found.synthetic_per_epoch) == (5 + virtual, virtual, some)
    assert [view.name for view in found.train[:5]] == [view.name for view in capture.train]
    assert [view.name for view in found.test] == [view.name for view in capture.test]
    scoring = found.train[: 7 if share else 5]
    assert [(view.name, view.photo, view.background) for view in found.score] == [
        (view.name, view.photo, view.background) for view in scoring
    ]
    assert all(one.camera is other.camera for one, other in zip(found.score, scoring, strict=True))
    assert [view.background[0] for view in found.train[5:9]] == ([0.0, 0.5, 1.0, 0.0] if share else [])
    assert found.source == "a capture" + (f", and {virtual} virtual cameras, of which 2 score" if virtual else "")
    assert len(supervision_views(scene, capture, settings(), scoring_stride=0).score) == 5


def test_synthetic_views_are_of_two_kinds_in_random_order():
    capture = Views(around(40), (), black(), "a capture")
    scene = kissgs.sample_scene(400, sh_degree=0)
    found, other = (supervision_views(scene, capture, settings(seed=seed)) for seed in (0, 1))
    side = found.train[-1].camera.width
    regions = {tuple(view.camera.position) for view in scene_views(scene, width=side, height=side, count=16).all}
    kinds = [tuple(view.camera.position) in regions for view in found.train[40:]]
    assert sum(kinds) == 16
    assert 0 < sum(kinds[:10]) < 10, "both score"
    places = [{tuple(view.camera.position) for view in each.train[40:]} for each in (found, other)]
    assert places[0] & places[1] == regions
    many = supervision_views(scene, capture, settings(synthetic_view_share=0.75))
    assert (many.synthetic, many.synthetic_per_epoch) == (120, 120)
    small = supervision_views(scene, capture, settings(view_size=20))
    assert {view.camera.width for view in small.train[40:]} == {12}
    whole = found.train[-1].camera.width
    np.testing.assert_allclose([view.camera.dilation for view in small.train[40:]], 0.3 * (12 / whole) ** 2)
    assert {(view.camera.width, view.camera.dilation) for view in small.score[40:]} == {(12, 0.3)}


def test_preset_paper_trains_on_whole_photographs():
    scene, compact, finetune = cloud(60), Settings.from_preset("paper").compact, Settings.from_preset("paper").finetune
    capture = Views(around(3, 4000), around(1, 4000), black(), "")
    for chosen in (compact, finetune):
        found = supervision_views(scene, capture, chosen)
        assert [view.camera.width for view in (*found.train, *found.score)] == [4000] * 6


@pytest.mark.parametrize(("size", "stride"), [((60, 2), 1), ((61, 50), 2), ((1, 130), 3)])
def test_training_views_are_samples_of_larger_photographs(tmp_path, size, stride):
    """Oracle: the photographs' pixels; consecutive views begin at different ones."""
    rng, views = np.random.default_rng(0), []
    for n in range(10):
        pixels = rng.integers(0, 256, (size[1], size[0], 3), dtype=np.uint8)
        Image.fromarray(pixels).save(tmp_path / f"{n}.png")
        camera = look_at(
            np.array([0, 0, -3.0]), np.zeros(3), np.array([0, -1.0, 0]), fov=0.8, width=size[0], height=size[1]
        )
        views.append(View(f"{n}", camera, tmp_path / f"{n}.png"))
    found = supervision_views(
        cloud(60), Views(tuple(views[1:]), tuple(views[:1]), black(), ""), settings(photo_size=60)
    )
    assert found.test == (views[0],), "evaluation takes the whole photograph"
    targets, starts = training_targets(cloud(60), found), set()
    for n in range(9):
        whole, camera = views[n + 1].load_photo(), targets.cameras[n]
        assert targets.images[n].shape == (camera.height, camera.width, 3)
        assert max(camera.width, camera.height) <= 60
        (start,) = {
            (c, r)
            for c in range(min(stride, size[0]))
            for r in range(min(stride, size[1]))
            if np.array_equal(whole[r::stride, c::stride], targets.images[n])
        }
        starts.add(start)
        np.testing.assert_allclose(camera.K, views[n + 1].camera.sampled(stride, start).K)
    assert len(starts) == min(stride, size[0]) * min(stride, size[1])


@pytest.mark.parametrize("photos", [0, 2, 4])
@pytest.mark.quick(1)
def test_a_capture_without_held_out_views_is_evaluated_in_training_views(tmp_path, photos):
    """The note says so; all evaluation views have photographs, or none has."""
    train = list(around(4))
    for n in range(photos):
        Image.new("RGB", (40, 32), (50, 90, 20)).save(tmp_path / f"{n}.png")
        train[n] = View(train[n].name, train[n].camera, tmp_path / f"{n}.png")
    scene = cloud(60)
    found = supervision_views(
        scene, Views(tuple(train), (), black(), "a capture", "a note"), settings(synthetic_view_share=0.5)
    )
    assert len(found.test) == (photos or 4)
    result = Popspa(scene, settings(), found)(20, evaluate=True)
    assert result.report.note.startswith("a note; no view is held out")
    assert result.report.target_source == ("photos" if photos else "renderings")


def test_a_scene_that_no_camera_sees():
    """All scores are 0: the Gaussians are kept that cameras nearby would see most of."""
    scene = cloud(30)
    far = replace(scene, means=scene.means + np.float32(500))
    pruned = Popspa(far, settings(**NO_TRAINING), five_views())(10)
    assert pruned.index.tolist() == highest_indices(Coverage(far).close_up, 10).tolist()
    result = Popspa(far, settings(admm_rho=0), five_views())(10)
    visible_area = np.exp(np.sort(far.scales, axis=1)[:, 1:].sum(axis=1)) / (1 + np.exp(-far.opacities)) ** 2
    assert np.median(visible_area[result.index]) > 2 * np.median(np.delete(visible_area, result.index))
    assert same(result.splats, far.select(result.index))


@pytest.mark.cuda
def test_a_gpu_trains_as_well_as_the_cpu():
    scene, views = cloud(200), five_views()
    on_cpu, on_gpu = (Popspa(scene, settings(), views, Context(device=device))(60) for device in ("cpu", "cuda"))
    assert len(on_gpu.splats) == 60
    assert error(on_gpu.splats, scene, views.test) < 1.2 * error(on_cpu.splats, scene, views.test)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device here")
def test_a_missing_gpu_is_reported_before_the_work():
    with pytest.raises(UnsupportedError, match="torch finds no CUDA device"):
        compact_scene(cloud(60), settings(count=20), context=Context(device="cuda", progress=None))
