"""Edge cases of goals. Oracle: sizes on disk, an uninterrupted search, and containers inserted by hand."""

from pathlib import Path

import numpy as np
import pytest
from helpers.stages import by_stages

import kissgs
from kissgs import OutputError, Settings, Splats, StopSearch, UnsupportedError
from kissgs.compaction.search_evaluation import SearchEvaluation
from kissgs.core.context import Context
from kissgs.core.splats import ATTRIBUTES
from kissgs.pipeline.goal import Attempt, Goal
from kissgs.sogxt.encode import encode


@pytest.fixture(autouse=True)
def fractions_of_stages(monkeypatch):
    """Receivers stop at fractions of stages, not of the whole work."""
    by_stages(monkeypatch)


SCENE = kissgs.sample_scene(600, sh_degree=0, seed=5)
FEW_VIEWS = {"sensitivity_views": 4, "sensitivity_view_size": 48}
PRUNE = {"sparsify_steps": 0, "refine_steps": 0, "min_keep_per_scoring": 0.6, "views": 24, "view_size": 48}
TUNE = {"enabled": True, "steps": 4, "views": 16, "view_size": 48}


def settings(compact=None, finetune=None, **goal):
    finetune = finetune or {"enabled": False}
    return Settings.research("balanced", compact=compact, finetune=finetune, **FEW_VIEWS, **goal)


def stop_at(wanted, number=1):
    """Return a receiver that raises StopSearch once, when a stage begins for the ``number``-th time."""
    begun = []

    def progress(stage, fraction, note=""):
        if stage == wanted and fraction == 0:
            begun.append(stage)
            if len(begun) == number:
                raise StopSearch

    return progress


@pytest.mark.parametrize("stage", ["write", "evaluate"])
@pytest.mark.quick(1)
def test_stopping_after_the_search_has_no_effect(tmp_path, stage):
    goal = settings(target_size=8000)
    expected = kissgs.compress(SCENE, settings=goal).to_zip()
    result = kissgs.compress(SCENE, tmp_path / "a.zip", settings=goal, evaluate=True, progress=stop_at(stage))
    assert (tmp_path / "a.zip").read_bytes() == expected
    assert result.report.evaluation is not None


def test_stopping_while_a_count_is_evaluated_keeps_it():
    goal = settings({**PRUNE, "auto_count": True}, TUNE, target_size=8000)
    found = kissgs.compress(SCENE, settings=goal, progress=stop_at("evaluate"))
    assert len(found.to_zip()) <= 8000
    assert found.report.compaction.trials == ()
    assert "stopped before a smaller number was tried" in found.report.compaction.note


@pytest.mark.parametrize("auto_count", [False, True])
@pytest.mark.quick(0)
def test_stopping_before_fine_tuning_keeps_the_result(auto_count):
    """Stopped when sensitivity is measured again for fine-tuning, or when the first training target is rendered."""
    compact = {**PRUNE, "auto_count": True, "max_compactions": 1} if auto_count else None
    goal = settings(compact, TUNE, target_size=8000)
    found = kissgs.compress(SCENE, settings=goal, progress=stop_at("targets"))
    assert len(found.to_zip()) <= 8000
    assert found.report.finetuning is None or not found.report.finetuning.kept


def test_a_folder_meets_a_target_size(tmp_path):
    found = kissgs.compress(SCENE, tmp_path / "a", settings=settings(target_size=12_000))
    written = {path.name: path.stat().st_size for path in (tmp_path / "a").iterdir()}
    assert 0.9 * 12_000 < sum(written.values()) <= 12_000
    assert found.report.container_bytes == sum(written.values())
    assert found.report.file_bytes == written


def test_an_empty_scene_takes_bytes_too():
    for size, message in ((1, "target_size 1 byte cannot"), (99, "99 bytes cannot")):
        with pytest.raises(UnsupportedError, match=message):
            kissgs.compress(SCENE.select([]), settings=settings(target_size=size))
    assert len(kissgs.compress(SCENE.select([]), settings=settings(target_size=9000)).to_zip()) <= 9000
    assert len(kissgs.compress(SCENE.select([]), settings=settings(psnr=99.0)).order) == 0


def test_no_goal_is_met_if_an_object_is_lost():
    """One of two objects is missing: the mean over views hid that, as views of the other object lose nothing."""
    away = Splats(**{name: getattr(SCENE, name) + np.float32(1000 * (name == "means")) for name in ATTRIBUTES})
    both = Splats(**{name: np.concatenate([getattr(SCENE, name), getattr(away, name)]) for name in ATTRIBUTES})
    one = encode(SCENE, Settings.research("fast", quality_offset_db=12).encode, Context(1))
    found = SearchEvaluation(both, None)(kissgs.decompress(one.files))
    for goal in ({"psnr": 30.0}, {"max_psnr_drop": 2.0}):
        limits = Goal.of(settings(**goal).encode)
        attempt = Attempt(len(SCENE), None, 0).with_evaluation(found)
        assert limits.margin(attempt) < 0
        assert attempt.worst < 20
        assert f"worst view {attempt.worst:.1f} dB" in attempt.summary()
        assert {"worst", "fifth_percentile"} <= set(attempt.as_dict())


@pytest.mark.parametrize("goal", [{"max_psnr_drop": 0.3}, {"max_psnr_drop": 0.2, "max_encodes": 3}, {"psnr": 36.0}])
@pytest.mark.quick(1)
def test_the_reported_settings_reproduce_the_container(goal):
    found = kissgs.compress(SCENE, settings=settings(**goal))
    report = found.report.settings["encode"]
    assert {name: report[name] for name in goal} == goal
    again = {**report, "psnr": None, "max_psnr_drop": None, "rd_lambda": found.report.rd_lambda}
    assert kissgs.compress(SCENE, settings=Settings.research(**again)).to_zip() == found.to_zip()


@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="only Linux has a folder that nobody can write to")
@pytest.mark.parametrize("name", ["a.zip", "a"])
def test_a_read_only_folder_is_refused_before_the_work(name):
    begun = []
    with pytest.raises(OutputError, match="cannot write /proc/a"):
        kissgs.compress(SCENE, Path("/proc") / name, progress=lambda *event: begun.append(event))
    assert begun == []


@pytest.mark.parametrize("stage", ["images", "write"])
def test_without_a_search_stopping_cancels(tmp_path, stage):
    with pytest.raises(StopSearch):
        kissgs.compress(SCENE, tmp_path / "a.zip", settings=settings(), progress=stop_at(stage))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.quick(0)
def test_stopping_ends_the_search_for_a_count_only():
    """The result is encoded, although a later stage asks to stop again."""
    receivers = [stop_at("score", 3), stop_at("images")]

    def progress(stage, fraction, note=""):
        for receiver in receivers:
            receiver(stage, fraction, note)

    found = kissgs.compress(SCENE, settings=settings({**PRUNE, "max_psnr_drop": 1.0}), progress=progress)
    assert 1 <= len(found.report.compaction.trials) <= 2
    assert len(kissgs.decompress(found.files)) == found.report.compaction.count - found.report.pruned_by_rd
