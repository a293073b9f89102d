"""Goals at the edge; oracle: sizes on disk, the search without interruption, and containers put in by hand."""

import json
from pathlib import Path

import numpy as np
import pytest

import kissgs
from kissgs import FinetuneReport, OutputError, Settings, Splats, StopSearch, UnsupportedError
from kissgs.core.progress import Annotated, silent
from kissgs.evaluation.cameras import evaluation_views
from kissgs.pipeline.rate_control import Container, RateControl
from kissgs.sogxt.encode import encode

ATTRIBUTES = ("means", "quats", "scales", "opacities", "sh0", "shN")
SCENE = kissgs.sample_scene(600, sh_degree=0, seed=5)
GLANCE = {"sensitivity_views": 4, "sensitivity_view_size": 48}
PRUNE = {"sparsify_steps": 0, "refine_steps": 0, "min_keep_per_scoring": 0.6, "views": 24, "view_size": 48}
TUNE = {"enabled": True, "steps": 4, "views": 16, "view_size": 48}
TUNED = FinetuneReport(
    steps=1,
    target_source="photos",
    source="",
    psnr_before=30.0,
    psnr_after=31.0,
    bytes_before=1,
    bytes_after=1,
    kept=True,
    seconds=1.0,
)


def settings(compact=None, finetune=None, **goal):
    return Settings.from_preset("balanced", compact=compact, finetune=finetune, **GLANCE, **goal)


def enough_at(wanted, number=1):
    """Raises once, when that stage begins for the ``number``-th time."""
    seen = []

    def progress(stage, fraction, note=""):
        if stage == wanted and fraction == 0:
            seen.append(stage)
            if len(seen) == number:
                raise StopSearch

    return progress


@pytest.mark.parametrize("stage", ["write", "evaluate"])
def test_what_is_found_is_written_even_if_it_was_enough(tmp_path, stage):
    """Said after the search: there is nothing left to end."""
    goal = settings(target_size=8000)
    expected = kissgs.compress(SCENE, settings=goal).to_zip()
    told = kissgs.compress(SCENE, tmp_path / "a.zip", settings=goal, evaluate=True, progress=enough_at(stage))
    assert (tmp_path / "a.zip").read_bytes() == expected
    assert told.report.evaluation is not None


def test_enough_while_a_count_is_judged_takes_it():
    found = kissgs.compress(
        SCENE, settings=settings({**PRUNE, "auto_count": True}, target_size=8000), progress=enough_at("evaluate")
    )
    assert len(found.to_zip()) <= 8000
    assert found.report.compaction.trials == ()
    assert "ended before fewer were tried" in found.report.compaction.note


@pytest.mark.parametrize("auto_count", [False, True])
def test_enough_before_fine_tuning_takes_what_is_there(auto_count):
    """Said when it is looked at again to be fine-tuned, or when the first picture to learn from is drawn."""
    compact = {**PRUNE, "auto_count": True, "max_compactions": 1} if auto_count else None
    goal = settings(compact, TUNE, target_size=8000)
    found = kissgs.compress(SCENE, settings=goal, progress=enough_at("targets"))
    assert len(found.to_zip()) <= 8000
    assert found.report.finetuning is None or not found.report.finetuning.kept


@pytest.mark.parametrize("quality_offset_db", [8, -8])
def test_a_loss_is_met_from_far_away(quality_offset_db):
    found = kissgs.compress(SCENE, settings=settings(max_psnr_drop=3, quality_offset_db=quality_offset_db))
    lost = [trial.drop for trial in found.report.trials if trial.drop <= 3]
    assert max(lost) > 2.5  # PSNR jumps, on so small a scene
    assert len(found.to_zip()) == min(trial.bytes for trial in found.report.trials if trial.drop <= 3)


def test_a_folder_is_as_small_as_was_asked_for(tmp_path):
    found = kissgs.compress(SCENE, tmp_path / "a", settings=settings(target_size=12_000))
    written = {path.name: path.stat().st_size for path in (tmp_path / "a").iterdir()}
    assert 0.9 * 12_000 < sum(written.values()) <= 12_000
    assert found.report.container_bytes == sum(written.values())
    assert found.report.file_bytes == written


@pytest.mark.parametrize(("goal", "told"), [({"target_size": 1}, "at most 1 byte,"), ({"target_size": 99}, "99 bytes")])
def test_nothing_takes_bytes_too(goal, told):
    with pytest.raises(UnsupportedError, match=told):
        kissgs.compress(SCENE.select([]), settings=settings(**goal))
    assert len(kissgs.compress(SCENE.select([]), settings=settings(target_size=9000)).to_zip()) <= 9000
    assert len(kissgs.compress(SCENE.select([]), settings=settings(psnr=99.0)).order) == 0


def test_the_smallest_is_best_whoever_made_it():
    """Where pictures are the goal; and that fine-tuning was in vain is told."""
    small, large = (
        encode(SCENE, Settings.from_preset("fast", scale_step=step).encode, threads=1) for step in (0.2, 0.1)
    )
    wanted = settings(psnr=20.0).encode
    search = RateControl(SCENE, wanted, None, 1, Annotated(silent))
    search.run(lambda chosen: Container(small, chosen))
    search.run(lambda chosen: Container(large, chosen, TUNED))
    assert [trial.bytes for trial in search.trials] == sorted(trial.bytes for trial in search.trials)
    found = search.found()
    assert found.encoded is small
    assert found.finetuning is not None
    assert not found.finetuning.kept
    assert "as it was without" in found.finetuning.note
    search.run(lambda chosen: Container(small, chosen))
    assert search.found().encoded is small


def test_the_verdict_is_by_cameras_that_the_search_has_not_used():
    """The same ones found a container good that was chosen because they did."""
    search = RateControl(SCENE, settings(psnr=20.0).encode, None, 1, Annotated(silent))
    search.run(lambda chosen: Container(encode(SCENE, chosen, threads=1), chosen))
    places = [
        {view.camera.viewmat.tobytes() for view in views.test} for views in (search.views, evaluation_views(SCENE))
    ]
    assert not places[0] & places[1]


@pytest.mark.parametrize("goal", [{"psnr": 30.0}, {"max_psnr_drop": 2.0}])
def test_no_goal_is_met_with_an_object_lost(goal):
    """Of two, one as it was: views of that one alone have lost nothing, and made up for the others."""
    away = Splats(**{name: getattr(SCENE, name) + np.float32(1000 * (name == "means")) for name in ATTRIBUTES})
    both = Splats(**{name: np.concatenate([getattr(SCENE, name), getattr(away, name)]) for name in ATTRIBUTES})
    one = encode(SCENE, Settings.from_preset("fast", quality_offset_db=12).encode, threads=1)
    search = RateControl(both, settings(**goal).encode, None, 1, Annotated(silent))
    search.run(lambda chosen: Container(one, chosen))
    trial = search.trials[0]
    assert search.best is None
    assert trial.worst < 20
    assert f"worst view {trial.worst:.1f} dB" in trial.spelled()
    assert {"worst", "fifth_percentile"} <= set(trial.as_dict())


@pytest.mark.parametrize("worse", [True, False])
def test_the_best_pictures_are_best_where_a_size_is_the_goal(worse):
    """A fine-tuned container that is smaller than need be may be worse than one that is not fine-tuned."""
    small, large = (
        encode(SCENE, Settings.from_preset("fast", scale_step=step).encode, threads=1) for step in (0.2, 0.1)
    )
    search = RateControl(SCENE, settings(target_size=10**6).encode, None, 1, Annotated(silent))
    search.run(lambda chosen: Container(large, chosen))
    report = FinetuneReport(**{**TUNED.as_dict(), "psnr_after": 29.0 if worse else 31.0})
    search.run(lambda chosen: Container(small, chosen, report))
    assert search.found().encoded is (large if worse else small)


@pytest.mark.parametrize("goal", [{"max_psnr_drop": 0.3}, {"max_psnr_drop": 0.2, "max_encodes": 3}, {"psnr": 36.0}])
def test_the_report_tells_how_to_make_it_again(goal):
    found = kissgs.compress(SCENE, settings=settings(**goal))
    told = found.report.settings["encode"]
    assert {name: told[name] for name in goal} == goal
    again = {**told, "psnr": None, "max_psnr_drop": None, "rd_lambda": found.report.rd_lambda}
    assert kissgs.compress(SCENE, settings=Settings(encode=again)).to_zip() == found.to_zip()


def test_what_is_infinite_is_null_for_machines():
    faint = kissgs.Splats(**{**{name: getattr(SCENE, name) for name in ATTRIBUTES}, "opacities": SCENE.opacities - 99})
    told = kissgs.compress(faint, settings=settings(psnr=40.0)).report.as_dict()
    assert json.dumps(told["trials"], allow_nan=False)
    assert told["trials"][0]["psnr"] is None


@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="only Linux has a folder that nobody can write to")
@pytest.mark.parametrize("name", ["a.zip", "a"])
def test_a_folder_that_cannot_be_written_to_is_told_before_the_work(name):
    begun = []
    with pytest.raises(OutputError, match="cannot write /proc/a"):
        kissgs.compress(SCENE, Path("/proc") / name, progress=lambda *told: begun.append(told))
    assert begun == []


@pytest.mark.parametrize("stage", ["images", "write"])
def test_without_a_search_enough_cancels(tmp_path, stage):
    with pytest.raises(StopSearch):
        kissgs.compress(SCENE, tmp_path / "a.zip", settings=settings(), progress=enough_at(stage))
    assert list(tmp_path.iterdir()) == []


def test_enough_ends_a_search_for_fewer_gaussians_and_no_more():
    """What was found is encoded, whatever is said later."""
    said = [enough_at("score", 3), enough_at("images")]

    def progress(stage, fraction, note=""):
        for one in said:
            one(stage, fraction, note)

    found = kissgs.compress(SCENE, settings=settings({**PRUNE, "max_psnr_drop": 1.0}), progress=progress)
    assert 1 <= len(found.report.compaction.trials) <= 2
    assert len(kissgs.decompress(found.files)) == found.report.compaction.count - found.report.pruned_by_rd
