"""Limited time. Oracle: the limit itself, and what the container shows of the work that was done."""

import math
from dataclasses import replace

import numpy as np
import pytest
from helpers.photographed import FEW_VIEWS, photographs, with_photographs
from helpers.training_scenes import cloud

import kissgs
from kissgs import Settings, UnsupportedError
from kissgs.core.context import Deadline
from kissgs.pipeline import limited_time as machine_speed
from kissgs.pipeline.limited_time import WITH_GOAL, SearchTime, encode_seconds, in_time, save_speed
from kissgs.settings import Preset
from kissgs.training.supervision import SupervisionViews

LONG = 1e5


@pytest.fixture(autouse=True)
def no_saved_speed(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def plan_of(seconds, count=100_000, *, photographs=True, **changes):
    requested = Settings.research(changes.pop("preset", "balanced"), time_limit=seconds, **changes)
    resolved = requested.resolved(photographs=photographs or None, torch=True)
    time = SearchTime(Deadline.after(seconds), encode_seconds(resolved.preset, count, 2))
    return in_time(requested, resolved, time, count=count, captured=photographs, torch=True)


def trains(plan):
    return bool(plan.settings.compact.auto_count), bool(plan.settings.finetune.enabled)


def test_training_is_chosen_where_there_is_time_and_a_capture():
    plain = encode_seconds(Preset.BALANCED, 100_000, 2)
    assert trains(plan_of(10 * plain)) == (True, True)
    assert plan_of(10 * plain).settings.encode.max_psnr_drop == 0.1
    assert trains(plan_of(2 * plain)) == (False, False)
    assert plan_of(2 * plain).settings.encode.has_goal is False
    note = "there was too little time for training"
    assert plan_of(2 * plain).note == f"{note}, so nothing limits the loss but the preset"
    assert plan_of(2 * plain, max_psnr_drop=0.3).note == note
    assert trains(plan_of(10 * plain, photographs=False)) == (False, True)  # levels alone, on renderings
    assert trains(plan_of(10 * plain, photographs=False, finetune={"enabled": False})) == (False, False)
    assert trains(plan_of(10 * plain, photographs=False, psnr=40)) == (False, False)
    assert trains(plan_of(3 * plain, photographs=False)) == (False, False)
    assert trains(plan_of(10 * plain, photographs=False, max_psnr_drop=0.3)) == (True, True)
    assert trains(plan_of(3 * plain, photographs=False, max_psnr_drop=0.3)) == (False, False)
    assert trains(plan_of(10 * plain, count=10_000_000)) == (False, False)
    assert trains(plan_of(10 * plain, count=1)) == (False, False)


def test_a_preset_that_takes_too_long_becomes_the_fastest():
    plain = encode_seconds(Preset.BALANCED, 100_000, 2)
    short = plan_of(0.5 * plain)
    assert short.settings.preset == Preset.FAST
    assert "encoded with the preset fast: balanced would take about" in short.note
    assert plan_of(2 * plain).settings.preset == Preset.BALANCED
    assert plan_of(0.5 * plain, target_size=9000).settings.encode.target_size == 9000  # a goal comes first
    assert plan_of(0.5 * plain, sh_step=2).settings.encode.sh_step == 2  # and so does what was requested
    assert plan_of(0.01, preset="fast").note == ""


def test_a_goal_keeps_its_value():
    assert plan_of(LONG, max_psnr_drop=0.3).settings.encode.max_psnr_drop == 0.3
    assert plan_of(LONG, rd_lambda=1e-9).settings.encode.has_goal is False
    assert trains(plan_of(LONG, psnr=40)) == (False, False)


def test_more_time_makes_more_containers():
    for time_only in (True, False):
        plans = [
            SearchTime(Deadline.after(10 * units), 10).plan(photographs=True, time_only=time_only)
            for units in (3, 6, 12, 30, 90)
        ]
        assert [plan.containers for plan in plans] == sorted(plan.containers for plan in plans)
        assert [plan.number for plan in plans] == sorted(plan.number for plan in plans)
        assert (plans[0].containers, plans[-1].containers) == (1, 3)
    rendered = [
        SearchTime(Deadline.after(10 * units), 10).plan(photographs=False, time_only=False) for units in (4, 20, 40, 90)
    ]
    assert [plan.containers for plan in rendered] == [0, 1, 2, 3]


def test_the_shares_of_a_search_fill_its_time():
    time = SearchTime(Deadline.after(1000), 10)
    spent = 0.0
    for points in (3, 2, 1):
        spent += SearchTime(Deadline.after(1000 - spent), 10).for_point(points, 2).seconds
    spent += SearchTime(Deadline.after(1000 - spent), 10).for_container(2).seconds
    spent += SearchTime(Deadline.after(1000 - spent), 10).for_container(1).seconds
    assert spent == pytest.approx(1000, abs=1)
    assert time.for_point(3, 2).seconds < time.for_container(2).seconds


def test_the_saved_speed_counts(tmp_path):
    usual = encode_seconds(Preset.BALANCED, 50_000)
    save_speed(usual / 4, Preset.BALANCED, 50_000)
    assert encode_seconds(Preset.BALANCED, 50_000) == pytest.approx(usual / 4)
    assert encode_seconds(Preset.FAST, 1_000_000, 1) >= encode_seconds(Preset.FAST, 1_000_000, 2)


@pytest.mark.parametrize(
    "text", ["", "[]", "{}", '{"speed_per_processor": "x"}', '{"speed_per_processor": NaN}', "\xff"]
)
def test_a_damaged_speed_file_is_ignored(text):
    usual = encode_seconds(Preset.BALANCED, 50_000)
    path = machine_speed._speed_file()
    path.parent.mkdir(parents=True)
    path.write_text(text, encoding="latin-1")
    assert encode_seconds(Preset.BALANCED, 50_000) == usual


def test_a_speed_that_cannot_be_saved_is_one_sentence(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    with pytest.raises(kissgs.OutputError, match=r"cannot write .*speed\.json"):
        save_speed(1.0, Preset.BALANCED, 9)


def test_scoring_takes_a_share_of_the_time():
    """100 units are left: 0.15 of them for 4 rounds of 0.004 each per view."""
    assert SearchTime(Deadline.after(1000), 10).scoring_views(4) == pytest.approx(937, abs=2)
    assert SearchTime(Deadline.after(10), 10).scoring_views(4) == 16
    views = SupervisionViews((), tuple(range(10)), (), np.zeros(3, np.float32), "")
    assert views.with_scoring(4).score == (0, 3, 6, 9)
    assert views.with_scoring(40).score == views.score


@pytest.mark.quick(0)
def test_time_alone_trains_and_keeps_the_closest_container(tmp_path, monkeypatch):
    """The photographs are the scene's own renderings, so that nothing can be lost without missing the aim."""
    monkeypatch.setattr("kissgs.pipeline.search.RECOVERABLE_DB", math.inf)
    scene = cloud(200)
    views = photographs(scene, tmp_path, brightness=1.0)
    requested = with_photographs().model_copy(update={"time_limit": LONG})
    found = kissgs.compress(scene, settings=requested, views=views)
    assert found.report.compaction.count < 200
    assert found.report.finetuning.steps == 24  # the usual number, and no more
    assert len(found.report.trials) > 1
    assert found.report.settings["encode"]["max_psnr_drop"] is None
    assert found.report.settings["time_limit"] == LONG
    assert min(trial.drop for trial in found.report.trials) > 0.1
    (kept,) = {trial.drop for trial in found.report.trials if trial.bytes == len(found.to_zip())}
    assert kept == min(trial.drop for trial in found.report.trials)
    again = Settings.model_validate(found.report.settings)
    assert again.compact.auto_count is None
    assert again.time_limit == LONG


@pytest.mark.quick(0)
@pytest.mark.parametrize(("units", "fewer"), [(12.0, False), (1e6, True)])
def test_a_scene_that_training_does_not_recover_is_encoded_whole(tmp_path, monkeypatch, units, fewer):
    """Photographs that are the scene's own renderings lose without limit; with much time, fewer Gaussians follow."""
    scene = cloud(200)
    views = photographs(scene, tmp_path, brightness=1.0)
    monkeypatch.setattr("kissgs.pipeline.limited_time.encode_seconds", lambda *found: LONG / units)
    requested = with_photographs().model_copy(update={"time_limit": LONG})
    found = kissgs.compress(scene, settings=requested, views=views)
    counts = [trial.count for trial in found.report.trials]
    assert counts[0] == 200
    assert (min(counts) < 200) == fewer
    (kept,) = {trial.drop for trial in found.report.trials if trial.bytes == len(found.to_zip())}
    assert kept == min(trial.drop for trial in found.report.trials)
    if not fewer:
        assert "no smaller number of Gaussians that was tried" in found.report.compaction.note
        assert found.report.finetuning is None  # which would have to recover more


class StopAt:
    """Receiver that ends the search at the first event of a stage after another one."""

    def __init__(self, stage, after):
        self.stage, self.after, self.seen, self.done = stage, after, False, False

    def __call__(self, stage, fraction, note=""):
        self.seen |= stage == self.after
        if self.seen and stage == self.stage and not self.done:
            self.done = True
            raise kissgs.StopSearch


@pytest.mark.quick(0)
@pytest.mark.parametrize(("stage", "after"), [("sensitivity", "sparsify"), ("evaluate", "images")])
def test_ctrl_c_while_all_gaussians_are_encoded_keeps_them(tmp_path, monkeypatch, stage, after):
    scene, receiver = cloud(200), StopAt(stage, after)
    views = photographs(scene, tmp_path, brightness=1.0)
    requested = with_photographs().model_copy(update={"time_limit": LONG})
    found = kissgs.compress(scene, settings=requested, views=views, progress=receiver)
    assert receiver.done
    assert {trial.count for trial in found.report.trials} == {200}
    assert len(found.to_zip()) in {trial.bytes for trial in found.report.trials}


@pytest.mark.quick(0)
def test_a_goal_that_training_does_not_recover_is_met_by_the_encoder(tmp_path, monkeypatch):
    scene = cloud(200)
    views = photographs(scene, tmp_path)
    monkeypatch.setattr("kissgs.pipeline.search.RECOVERABLE_DB", -math.inf)
    monkeypatch.setattr("kissgs.pipeline.limited_time.encode_seconds", lambda *found: LONG / 12.0)
    requested = with_photographs(max_psnr_drop=0.5).model_copy(update={"time_limit": LONG})
    found = kissgs.compress(scene, settings=requested, views=views)
    assert found.report.trials[0].count == 200
    assert min(trial.drop for trial in found.report.trials if trial.bytes == len(found.to_zip())) <= 0.5
    impossible = with_photographs(max_psnr_drop=1e-9).model_copy(update={"time_limit": LONG})
    with pytest.raises(UnsupportedError, match="max_psnr_drop 1e-09 dB cannot be met"):
        kissgs.compress(scene, settings=impossible, views=photographs(scene, tmp_path, brightness=1.0))


@pytest.mark.quick(0)
def test_much_time_makes_twice_the_usual_steps_on_renderings():
    tuning = {"steps": 6, "views": 24, "view_size": 40}
    settings = Settings.research("balanced", finetune=tuning, time_limit=LONG, **FEW_VIEWS)
    tuned = kissgs.compress(cloud(200), settings=settings).report.finetuning
    assert (tuned.steps, tuned.target_source) == (12, "renderings")


@pytest.mark.quick(0)
def test_little_time_makes_one_container_with_few_steps(tmp_path, monkeypatch):
    scene = cloud(200)
    views = photographs(scene, tmp_path)
    monkeypatch.setattr("kissgs.pipeline.limited_time.encode_seconds", lambda *found: 1.5)
    settings = with_photographs({"steps": 10_000}).model_copy(update={"time_limit": 9.0})
    found = kissgs.compress(scene, settings=settings, views=views)
    assert len(found.report.trials) == 1
    assert 0 < found.report.finetuning.steps < 20_000
    assert f"finetune_steps: {found.report.finetuning.steps}" in found.files["container_meta.yaml"].decode()


def test_a_short_search_prunes_no_further_than_it_trains(tmp_path, monkeypatch):
    scene = cloud(200)
    views = photographs(scene, tmp_path)
    monkeypatch.setattr("kissgs.pipeline.limited_time.encode_seconds", lambda *found: 1e-3)
    monkeypatch.setattr(SearchTime, "plan", lambda self, photographs, time_only: WITH_GOAL[0][1])
    requested = with_photographs(max_psnr_drop=0.5).model_copy(update={"time_limit": LONG})
    found = kissgs.compress(scene, settings=requested, views=views)
    assert found.report.trials[0].count == round(200 * 0.8**2)
    assert found.report.compaction.target_source == "photos"


def test_a_checkpoint_and_a_time_limit_are_refused_together(tmp_path):
    with pytest.raises(UnsupportedError, match="no checkpoint is kept with a time limit"):
        kissgs.compress(cloud(9), settings=Settings(time_limit=5), checkpoint=tmp_path / "state")


def test_the_note_says_what_torch_would_have_bought(tmp_path, monkeypatch):
    scene = cloud(60)
    views = photographs(scene, tmp_path)
    monkeypatch.setattr("kissgs.pipeline.limited_time.has_torch", lambda: False)
    for capture in (views, None):
        plenty, little = (Settings.research("balanced", time_limit=t, **FEW_VIEWS) for t in (LONG, 1e-3))
        assert "needs torch, which is missing" in kissgs.compress(scene, settings=plenty, views=capture).report.note
        assert "needs torch, which is missing" not in kissgs.compress(scene, settings=little, views=capture).report.note


@pytest.mark.quick(1)
def test_a_goal_comes_before_the_time():
    scene = cloud(400)
    plain = kissgs.compress(scene, settings=Settings.research("balanced", **FEW_VIEWS))
    wanted = round(0.8 * len(plain.to_zip()))
    settings = Settings.research("balanced", time_limit=1e-3, target_size=wanted, **FEW_VIEWS)
    found = kissgs.compress(scene, settings=settings)
    assert len(found.to_zip()) <= wanted
    assert found.report.trials[-1].bytes == len(found.to_zip())  # the search ended with the first that fits


@pytest.mark.parametrize(
    ("text", "seconds"),
    [("30s", 30), ("2min", 120), ("1.5 h", 5400), ("90", 90), (45, 45), ("2 MIN", 120), (".5m", 30)],
)
def test_times_have_units(text, seconds):
    assert Settings(time_limit=text).time_limit == seconds


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"time_limit": "2 days"}, "setting time_limit: write 30s, 2min, 1h or a number of seconds, not '2 days'"),
        ({"time_limit": "-3s"}, "write 30s, 2min"),
        ({"time_limit": 0}, "setting time_limit: input should be greater than 0"),
        (
            {"time_limit": "1min", "compact": {"ratio": 0.2}},
            "time_limit does not apply to compaction by a given budget",
        ),
        ({"time_limit": "nan"}, "write 30s, 2min"),
    ],
)
def test_impossible_times_are_refused(settings, message):
    with pytest.raises(UnsupportedError) as failed:
        Settings.research("balanced", **settings)
    assert message in str(failed.value)


@pytest.mark.quick(0)
def test_size_and_quality_must_both_hold_and_come_before_the_time():
    scene = kissgs.sample_scene(1500, sh_degree=1, seed=5)
    views = {"sensitivity_views": 4, "sensitivity_view_size": 48}
    alone = kissgs.compress(scene, settings=Settings.research("balanced", psnr=36, **views))
    both = Settings.research("balanced", psnr=36, target_size=len(alone.to_zip()), **views)
    assert kissgs.compress(scene, settings=both).files == alone.files
    hurried = Settings.research("balanced", psnr=36, target_size=len(alone.to_zip()), time_limit=1e-3, **views)
    assert len(kissgs.compress(scene, settings=hurried).to_zip()) <= len(alone.to_zip())
    with pytest.raises(
        UnsupportedError, match=f"target_size and psnr cannot be met together.*{len(alone.to_zip()):,} bytes"
    ):
        kissgs.compress(scene, settings=Settings.research("balanced", psnr=36, target_size=900, **views))


def test_captures_without_held_out_photographs_are_not_trained_on(tmp_path):
    scene = cloud(60)
    views = replace(photographs(scene, tmp_path), test=())
    found = kissgs.compress(scene, settings=with_photographs().model_copy(update={"time_limit": LONG}), views=views)
    assert found.report.finetuning is None
    assert found.report.compaction is None
