"""Oracle: the parts called one by one, the same work without interruption, and pictures of the scene as it was."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.training_scenes import around, cloud, same
from PIL import Image

import kissgs
from kissgs import CompactSettings, OutputError, UnsupportedError
from kissgs.cameras.views import View, Views, black
from kissgs.compaction.budget import compact_scene
from kissgs.compaction.popspa import popspa
from kissgs.compaction.scoring import highest_indices, prune_by_score
from kissgs.core.splats import ATTRIBUTES
from kissgs.rendering.camera import look_at
from kissgs.rendering.coverage import Coverage
from kissgs.rendering.rasterizer import render
from kissgs.training.checkpoint import Checkpoint
from kissgs.training.supervision import SupervisionViews, supervision_views
from kissgs.training.targets import training_targets

SHORT = {"sparsify_steps": 8, "refine_steps": 6, "prune_rounds": 2, "min_keep_per_scoring": 0.6, "admm_interval": 3}


def taught():
    return SupervisionViews(around(5), around(5), around(3), black(), "five views")


def settings(**changes):
    return CompactSettings(**{**SHORT, **changes})


def error(scene, original, views):
    pictures = [[render(one, view.camera)[0] for one in (scene, original)] for view in views]
    return np.mean([(a - b) ** 2 for a, b in pictures])


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"prune_rounds": 1},
        {"prune_rounds": 8},
        {"prune_rounds": 1000},
        {"sparsify_steps": 0},
        {"refine_steps": 0},
        {"sparsify_steps": 0, "refine_steps": 0},
        {"initial_prune_fraction": 0.0},
        {"initial_prune_fraction": 1.0},
        {"admm_rho": 0.0},
        {"erank_weight": 0.1, "min_scale_weight": 0.1},
    ],
)
@pytest.mark.parametrize("count", [1, 13, 59])
def test_exactly_so_many_are_left_and_it_says_which(count, changes):
    scene = cloud(60)
    result = popspa(scene, count, settings(**changes), taught())
    assert len(result.splats) == len(result.index) == result.report.count == count
    assert result.report.source_count == 60
    assert (np.diff(result.index) > 0).all()
    assert all(np.isfinite(getattr(result.splats, name)).all() for name in ATTRIBUTES)
    near = np.linalg.norm(result.splats.means - scene.means[result.index], axis=1)
    assert near.max() < 0.2, "each is where it was, or not far"
    counts = [step.count for step in result.report.steps]
    assert counts[0] == 60
    assert counts == sorted(counts, reverse=True)


@pytest.mark.parametrize(("captured", "least"), [(True, 0.05), (False, 0.3)])
def test_without_training_it_is_pruning_alone(captured, least):
    """What no camera shows counts little where people said from where they look, and more where nobody did."""
    scene, target_source = cloud(60), replace(taught(), captured=captured)
    result = popspa(scene, 20, settings(sparsify_steps=0, refine_steps=0), target_source)
    kept = prune_by_score(scene, target_source.train, black(), 20, min_keep_per_scoring=0.6, min_score=least)
    assert (result.index == kept).all()
    assert same(result.splats, scene.select(kept))
    assert result.report.target_source == "nothing"


def test_training_makes_up_for_what_went():
    scene, target_source = cloud(200), taught()
    pruned = popspa(scene, 60, settings(sparsify_steps=0, refine_steps=0), target_source)
    fitted = popspa(scene, 60, settings(sparsify_steps=60, refine_steps=120), target_source)
    assert error(fitted.splats, scene, target_source.train) < 0.5 * error(pruned.splats, scene, target_source.train)


def test_the_steps_are_told():
    result = popspa(cloud(100), 20, settings(initial_prune_fraction=0.5), taught(), judges=True)
    names = [step.name for step in result.report.steps]
    assert names == ["input", "prune", "sparsify", "prune", "sparsify", "prune", "refine"]
    assert [step.count for step in result.report.steps] == [100, 45, 45, 30, 30, 20, 20]
    first, *others = result.report.steps
    assert first.psnr == float("inf")
    assert first.ssim == 1
    assert all(0 < step.psnr < 100 and step.ssim < 1 and step.bytes < first.bytes for step in others)
    assert result.report.as_dict()["steps"][0]["psnr"] is None


def test_the_same_seed_gives_the_same_scene_whatever_the_threads():
    found = [popspa(cloud(300, 2), 50, settings(), taught(), threads=threads) for threads in (1, 2, 3)]
    assert same(found[0].splats, found[1].splats)
    assert same(found[0].splats, found[2].splats)
    assert not same(found[0].splats, popspa(cloud(300, 2), 50, settings(seed=1), taught()).splats)


class Interrupted(Exception):
    pass


def stopping_after(steps):
    left = itertools.count(steps - 1, -1)

    def progress(stage, fraction, note=""):
        if note and next(left) < 0:
            raise Interrupted

    return progress


@pytest.mark.parametrize("steps", [0, 3, 4, 7])
def test_opacities_that_are_made_sparse_are_taken_up_too(tmp_path, monkeypatch, steps):
    """Before the first step there is a checkpoint, and no z and u in it."""
    monkeypatch.setattr(Checkpoint, "due", True)
    chosen, path = settings(admm_rho=0.01, admm_interval=1), tmp_path / "c.npz"
    whole = popspa(cloud(80), 20, chosen, taught())
    assert not same(whole.splats, popspa(cloud(80), 20, settings(admm_rho=0.0), taught()).splats)
    with pytest.raises(Interrupted):
        popspa(cloud(80), 20, chosen, taught(), checkpoint=path, progress=stopping_after(steps))
    assert same(whole.splats, popspa(cloud(80), 20, chosen, taught(), checkpoint=path).splats)


@pytest.mark.parametrize("steps", [0, 2, 4, 5, 9, 10, 13, 15])
def test_what_was_interrupted_ends_as_if_it_had_not_been(tmp_path, monkeypatch, steps):
    monkeypatch.setattr(Checkpoint, "due", True)
    whole = popspa(cloud(80), 20, settings(), taught(), judges=True)
    path = tmp_path / "c.npz"
    with pytest.raises(Interrupted):
        popspa(cloud(80), 20, settings(), taught(), judges=True, checkpoint=path, progress=stopping_after(steps))
    assert path.exists()
    resumed = []
    again = popspa(
        *(cloud(80), 20, settings(), taught()),
        judges=True,
        checkpoint=path,
        progress=lambda stage, fraction, note="": resumed.append(stage),
    )
    assert same(whole.splats, again.splats)
    assert (whole.index == again.index).all()
    told = [[(step.name, step.count, step.psnr, step.bytes) for step in one.report.steps] for one in (whole, again)]
    assert told[0] == told[1]
    assert steps <= 10 or "sparsify" not in resumed
    begun = []
    third = popspa(
        *(cloud(80), 20, settings(), taught()),
        judges=True,
        checkpoint=path,
        progress=lambda stage, fraction, note="": begun.append(stage),
    )
    assert same(whole.splats, third.splats), "what was finished is not done again"
    assert set(begun) == {"kernels", "targets"}


def test_what_was_begun_without_figures_is_not_taken_up_for_figures(tmp_path, monkeypatch):
    """The steps before would have none."""
    monkeypatch.setattr(Checkpoint, "due", True)
    path = tmp_path / "c.npz"
    with pytest.raises(Interrupted):
        popspa(cloud(80), 20, settings(), taught(), checkpoint=path, progress=stopping_after(9))
    with pytest.raises(OutputError, match="other work"):
        popspa(cloud(80), 20, settings(), taught(), judges=True, checkpoint=path)


def test_a_disk_that_fills_later_does_not_end_the_work(tmp_path, monkeypatch):
    monkeypatch.setattr(Checkpoint, "due", True)
    saves, whole = [], Checkpoint.save

    def save(self, state):
        saves.append(1)
        if len(saves) > 3:
            raise OutputError("cannot write c.npz: no space left on device")
        whole(self, state)

    monkeypatch.setattr(Checkpoint, "save", save)
    result = popspa(cloud(80), 20, settings(), taught(), checkpoint=tmp_path / "c.npz")
    assert len(result.splats) == 20
    assert result.report.note == "the work went on without a checkpoint: cannot write c.npz: no space left on device"


def test_a_file_that_is_no_checkpoint_stays(tmp_path):
    path = tmp_path / "thesis.npz"
    for steps in ({}, {"sparsify_steps": 0, "refine_steps": 0}):
        path.write_text("years of work")
        with pytest.raises(OutputError, match="is no checkpoint of kissgs"):
            popspa(cloud(80), 20, settings(**steps), taught(), checkpoint=path)
        assert path.read_text() == "years of work"


@pytest.mark.parametrize("compact", [{}, {"count": 1000}])
def test_where_nothing_is_trained_no_file_is_touched(tmp_path, compact):
    path = tmp_path / "thesis.npz"
    path.write_text("years of work")
    chosen = kissgs.Settings.from_preset("fast", compact=compact)
    kissgs.compress(cloud(50), tmp_path / "o.zip", settings=chosen, checkpoint=path)
    assert path.read_text() == "years of work"


@pytest.mark.parametrize("turn", [0.0, 0.1])
def test_all_cameras_in_one_place(turn):
    """A tripod: their extent is 0, or what rounding leaves of it, and says nothing of the size of the world."""
    place, up = np.array([1.3, -2.7, 1.9]), np.array([0.0, -1, 0])
    targets = [np.array([turn * n, 0.0, 0.0]) for n in range(5)]
    cameras = [look_at(place, target, up, fov=0.9, width=40, height=32) for target in targets]
    turned = tuple(View(f"{n}", camera) for n, camera in enumerate(cameras))
    extent = training_targets(cloud(5), turned, black()).extent
    assert extent < 1e-10
    assert (extent > 0) == (turn > 0)
    scene = cloud(60)
    result = popspa(
        scene,
        30,
        settings(min_scale_weight=1.0, erank_weight=0.1),
        SupervisionViews(turned, turned, turned, black(), ""),
    )
    assert np.abs(result.splats.means - scene.means[result.index]).max() > 1e-4
    assert np.abs(result.splats.scales - scene.scales[result.index]).max() < 0.15, "and flatness has not run away"


def test_the_scene_as_it_was_teaches_the_smaller_one():
    """``reference`` is for those that are pruned already."""
    scene, target_source = cloud(200), taught()
    pruned = scene.select(np.arange(0, 200, 3))
    steps = settings(sparsify_steps=0, refine_steps=80)
    apart = [
        error(popspa(pruned, len(pruned), steps, target_source, reference=reference).splats, scene, target_source.train)
        for reference in (scene, pruned)
    ]
    assert apart[0] < 0.7 * apart[1]


@pytest.mark.parametrize("other", ["scene", "count", "settings", "views"])
def test_the_checkpoint_of_other_work_is_refused(tmp_path, monkeypatch, other):
    monkeypatch.setattr(Checkpoint, "due", True)
    path = tmp_path / "c.npz"
    with pytest.raises(Interrupted):
        popspa(cloud(80), 20, settings(), taught(), checkpoint=path, progress=stopping_after(3))
    work = {
        "scene": (cloud(80, seed=5), 20, settings(), taught()),
        "count": (cloud(80), 21, settings(), taught()),
        "settings": (cloud(80), 20, settings(admm_rho=1e-3), taught()),
        "views": (cloud(80), 20, settings(), SupervisionViews(around(4), around(4), around(3), black(), "four views")),
    }
    with pytest.raises(OutputError, match="checkpoint of other work"):
        popspa(*work[other], checkpoint=path)
    assert path.exists()


def test_a_full_disk_is_told(tmp_path, monkeypatch):
    monkeypatch.setattr(Checkpoint, "due", True)
    with pytest.raises(OutputError, match="there is no folder"):
        popspa(cloud(80), 20, settings(), taught(), checkpoint=tmp_path / "nowhere" / "c.npz")


def test_virtual_views_teach_where_there_is_no_capture():
    scene = kissgs.sample_scene(400, sh_degree=0)
    found = supervision_views(scene, None, settings(views=64, view_size=50))
    assert 56 <= len(found.train) <= 4 * 56  # several regions
    scored = len(range(0, len(found.train), 4))
    assert [view.camera.width for view in found.score] == [30] * scored + [7] * 4 * scored
    for part in (found.score[:scored], found.score[scored:]):
        assert [view.background[0] for view in part[:4]] == [0.0, 0.5, 1.0, 0.0]
    other = supervision_views(scene, None, settings(views=64, view_size=50, seed=9)).score[-1].camera.position
    assert not np.array_equal(found.score[-1].camera.position, other)
    assert [view.background for view in found.train] == [None] * len(found.train)
    assert len(found.test) == min(-(-len(found.train) // 7), 16)
    assert all(max(view.camera.width, view.camera.height) <= 50 for view in found.train)
    pruned = supervision_views(scene, None, settings(views=64, view_size=50), scoring_stride=1)
    assert len(pruned.score) == len(found.score)
    assert supervision_views(scene, None, settings(views=64, view_size=50), scoring_stride=0).score == ()
    result = popspa(scene, 100, settings(), found)
    assert result.report.target_source == "renderings"
    assert result.report.source.startswith(f"{len(found.train)} virtual cameras, and ")


@pytest.mark.parametrize(("around_it", "virtual"), [(0.0, 0), (0.1, 1), (0.5, 5)])
def test_a_capture_has_virtual_views_around_it(around_it, virtual):
    """Its own views come first, and those held out are never learned from."""
    capture = Views(around(5), around(3), black(), "a capture")
    found = supervision_views(kissgs.sample_scene(400, sh_degree=0), capture, settings(synthetic_view_share=around_it))
    assert len(found.train) == 5 + virtual
    assert [view.name for view in found.train[:5]] == [view.name for view in capture.train]
    assert [view.name for view in found.test] == [view.name for view in capture.test]
    assert found.score == found.train
    assert found.source == "a capture" + (f", and {virtual} virtual cameras" if virtual else "")


@pytest.mark.parametrize("photos", [0, 2, 4])
def test_a_capture_that_holds_no_view_out(tmp_path, photos):
    """It is judged by views that it learned from, which is said; with photographs or without, never by both."""
    train = list(around(4))
    for n in range(photos):
        Image.new("RGB", (40, 32), (50, 90, 20)).save(tmp_path / f"{n}.png")
        train[n] = View(train[n].name, train[n].camera, tmp_path / f"{n}.png")
    scene = cloud(60)
    found = supervision_views(
        scene, Views(tuple(train), (), black(), "a capture", "a note"), settings(synthetic_view_share=0.5)
    )
    assert len(found.test) == (photos or 4)
    result = popspa(scene, 20, settings(), found, judges=True)
    assert result.report.note.startswith("a note; no view is held out")
    assert result.report.target_source == ("photos" if photos else "renderings")


def test_nothing_is_seen():
    """All cameras look away: every score is 0, and those stay that a camera nearby would see most of."""
    scene = cloud(30)
    far = replace(scene, means=scene.means + np.float32(500))
    pruned = popspa(far, 10, settings(sparsify_steps=0, refine_steps=0), taught())
    assert pruned.index.tolist() == highest_indices(Coverage(far).close_up, 10).tolist()
    result = popspa(far, 10, settings(admm_rho=0), taught())
    large = np.exp(np.sort(far.scales, axis=1)[:, 1:].sum(axis=1)) / (1 + np.exp(-far.opacities)) ** 2
    assert np.median(large[result.index]) > 2 * np.median(np.delete(large, result.index))
    assert same(result.splats, far.select(result.index))


def test_prunings_are_by_the_same_factor():
    chosen = settings(sparsify_steps=10, prune_rounds=3, initial_prune_fraction=0.0)
    steps = popspa(cloud(100), 10, chosen, taught()).report.steps
    assert [step.count for step in steps if step.name == "prune"] == [100, 46, 22, 10]
    assert [step.name for step in steps] == ["input", "prune", *["sparsify", "prune"] * 3, "refine"]


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device here")
def test_a_gpu_trains_as_well():
    scene, views = cloud(200), taught()
    here, there = (popspa(scene, 60, settings(), views, device=device) for device in ("cpu", "cuda"))
    assert len(there.splats) == 60
    assert error(there.splats, scene, views.test) < 1.2 * error(here.splats, scene, views.test)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device here")
def test_no_gpu_is_said_before_the_work():
    with pytest.raises(UnsupportedError, match="torch finds no CUDA device"):
        compact_scene(cloud(60), settings(count=20), device="cuda", progress=None)
