"""Progress of every kind of work: one fraction, and steps that are expected. Oracle: the stages that are reported."""

import pytest
from helpers.photographed import FEW_VIEWS, photographs, with_photographs

import kissgs
from kissgs import Settings
from kissgs.pipeline.limited_time import Expected, resolved
from kissgs.streaming.compress import compress_streamed

VIEWS = {"views": 24, "view_size": 48}
TRAINED = {"sparsify_steps": 4, "refine_steps": 4, "prune_rounds": 2, **VIEWS}
TUNED = {"enabled": True, "steps": 4, **VIEWS}
UNTUNED = {"enabled": False}


def few(preset="balanced", **changes):
    encode = FEW_VIEWS if preset == "balanced" else {}
    return Settings.research(preset, **encode, **changes)


ONCE = {
    "fast": few("fast"),
    "balanced": few(),
    "paper": Settings.from_preset("paper"),
    "pruned": few("fast", compact={"ratio": 0.5, **VIEWS}),
    "trained": few(compact={"ratio": 0.5, **TRAINED}),
    "merged": few(compact={"ratio": 0.5, "method": "merge"}),
    "tuned": few(finetune=TUNED),
    "trained and tuned": few(compact={"count": 100, **TRAINED}, finetune=TUNED),
    "time": few(time_limit=1e5, finetune=UNTUNED),
}
SEARCHES = {
    "a loss by pruning": few(compact={"max_psnr_drop": 3, **TRAINED}),
    "a loss by merging": few(compact={"max_psnr_drop": 3, "method": "merge"}),
    "a size": few(target_size=6000, finetune=UNTUNED),
    "a size by training": few(target_size=4500, compact=TRAINED, finetune=TUNED),
    "a psnr": few(psnr=38),
    "a quality": few(quality="good", compact=TRAINED, finetune=TUNED),
    "a loss of ssim": few(max_ssim_drop=0.02, finetune=UNTUNED),
}


@pytest.fixture(scope="module")
def scene():
    return kissgs.sample_scene(300, sh_degree=1)


class Recorder:
    """Receives events, and asserts that the fraction never falls."""

    def __init__(self):
        self.stages, self.fraction, self.seconds_left = [], 0.0, None

    def __call__(self, stage, fraction, note="", seconds_left=None):
        assert self.fraction <= fraction <= 1
        assert self.fraction < 1, "an event after the end"
        assert (seconds_left is None and self.seconds_left is None) or seconds_left >= 0
        self.stages.append(stage)
        self.fraction, self.seconds_left = fraction, seconds_left


def expected(scene, settings, views=None):
    return [stage for stage, seconds in Expected.of(scene, resolved(settings, views), views, 0).steps() if seconds > 0]


@pytest.mark.parametrize("name", ONCE)
@pytest.mark.quick(2)
def test_steps_of_one_container_are_expected_in_their_order(scene, name):
    progress = Recorder()
    kissgs.compress(scene, settings=ONCE[name], progress=progress)
    assert set(progress.stages) == set(expected(scene, ONCE[name]))
    first = [at for at, stage in enumerate(progress.stages) if stage not in progress.stages[:at]]
    wanted = [stage for stage in dict.fromkeys(expected(scene, ONCE[name])) if stage not in ("kernels", "cameras")]
    assert [progress.stages[at] for at in first if progress.stages[at] in wanted] == wanted
    assert (progress.fraction, progress.seconds_left) == (1.0, 0.0)


@pytest.mark.parametrize("name", SEARCHES)
@pytest.mark.quick(1)
def test_searches_never_go_back(scene, name):
    progress = Recorder()
    kissgs.compress(scene, settings=SEARCHES[name], evaluate=True, progress=progress)
    assert set(progress.stages) - {"sparsify"} <= {"evaluate", *expected(scene, SEARCHES[name])}
    assert progress.fraction == 1.0


@pytest.mark.parametrize("goal", [{"target_size": 3400}, {"max_psnr_drop": 9}, {"quality": "good"}])
@pytest.mark.quick(1)
def test_searches_on_photographs_never_go_back(scene, tmp_path, goal):
    views, settings, progress = photographs(scene, tmp_path), with_photographs(**goal), Recorder()
    kissgs.compress(scene, settings=settings, views=views, evaluate=True, progress=progress)
    assert set(progress.stages) - {"refit"} <= {"evaluate", *expected(scene, settings, views)}
    assert progress.fraction == 1.0


@pytest.mark.quick(0)
def test_other_work_never_goes_back(scene, tmp_path):
    path, container, levels = tmp_path / "scene.ply", tmp_path / "scene.zip", tmp_path / "lod" / "lod-meta.json"
    kissgs.save(scene, path, progress=Recorder())
    kissgs.compress(path, container, settings=few("fast"), evaluate=True, progress=Recorder())
    for act in (
        lambda progress: kissgs.load(path, progress=progress),
        lambda progress: kissgs.load(container, progress=progress),
        lambda progress: kissgs.decompress(container, tmp_path / "back.ply", progress=progress),
        lambda progress: kissgs.evaluate(scene, scene, progress=progress),
        lambda progress: kissgs.compact(path, tmp_path / "few.ply", settings=ONCE["trained"], progress=progress),
        lambda progress: compress_streamed(path, levels, settings=few("fast"), progress=progress),
    ):
        progress = Recorder()
        act(progress)
        assert progress.fraction == 1.0
