"""Training in jobs and its interruption; oracle: the result without interruption."""

import json
import os
import signal
from dataclasses import asdict

import numpy as np
import pytest
from helpers.held_training import HeldTraining
from helpers.service import ROOT, SMALL, events, problem

import kissgs
from kissgs import CompactSettings
from kissgs.compaction.result import CompactionStep
from kissgs.core.errors import OutputError
from service.core.files import STEPS_BYTES, checkpoint_bytes
from service.jobs import job_process

pytest.importorskip("torch")


STEPS = 8
CHANGES = {
    "method": "prune",
    "count": 100,
    "sparsify_steps": STEPS,
    "refine_steps": STEPS,
    "views": 24,
    "view_size": 48,
}
BRIEF = {"preset": "fast", "compact": CHANGES, "for_research": True}
DONE = 3
"""Steps of its stage after which training waits."""

SAVES = {"sparsify": 1 + DONE, "refine": 1 + STEPS + DONE, "finetune": DONE}
"""Number of the checkpoint after these steps; fine-tuning saves none before the first."""


@pytest.fixture(scope="module")
def expected():
    """Container of BRIEF, from the library."""
    return kissgs.compress(SMALL, settings=kissgs.Settings.model_validate(BRIEF)).to_zip()


@pytest.fixture
def start_held(start_process, tmp_path):
    """Start a service and return it with the training of its jobs, which waits after so many checkpoints."""

    def begin(stage, **settings):
        training = HeldTraining(tmp_path, SAVES[stage])
        (tmp_path / "sitecustomize.py").write_text(training.program)
        return start_process(PYTHONPATH=f"{ROOT}{os.pathsep}{tmp_path}", **settings), training

    return begin


def folder_of(service, job):
    return service.folder / "jobs" / job["id"]


def training_events(service, job):
    """Return stage and fraction of the progress events of training, for each start of the job."""
    starts = []
    for _, kind, data in events(service.http.get(job["links"]["events"]).text):
        if kind == "state" and data["state"] == "running":
            starts.append([])
        elif kind == "progress" and data["stage"] in ("sparsify", "refine", "finetune") and data.get("note"):
            starts[-1].append((data["stage"], data["fraction"]))
    return starts


def kill_the_service(service, training):
    service.kill(signal.SIGKILL)
    for folder in (service.folder / "jobs").iterdir():
        (folder / ".kissgs.half.part").write_bytes(b"PK half")  # an incomplete checkpoint
    training.release()
    service.restart()


def stop_the_service(service, training):
    assert service.kill(signal.SIGTERM) == 0
    training.release()
    service.restart()


def kill_the_job(service, training):
    (job,) = service.children()
    training.release()  # the next process must not wait; this one may go on for some steps
    os.kill(job, signal.SIGKILL)


@pytest.mark.parametrize(
    ("stage", "interrupt"), [("sparsify", kill_the_service), ("refine", stop_the_service), ("refine", kill_the_job)]
)
@pytest.mark.quick(0)
def test_training_continues_after_an_interruption(start_held, expected, stage, interrupt):
    service, training = start_held(stage, drain_seconds=0)
    job = service.submit(options=json.dumps(BRIEF))
    training.wait()
    service.running(job, stage)
    interrupt(service, training)
    status = service.ended(job)
    assert status["state"] == "succeeded", status
    assert service.http.get(status["links"]["result"]).content == expected
    before, after = training_events(service, job)
    assert before[0] == ("sparsify", 0.0)
    assert after[0] == (stage, DONE / STEPS)
    assert sorted(path.name for path in folder_of(service, job).iterdir()) == ["result", "scene.ply"]


def damaged(path):
    path.write_bytes(path.read_bytes()[:-100] if path.exists() else b"")


def of_another_version(path):
    np.savez(path, key="another version's")


@pytest.mark.parametrize("damage", [damaged, of_another_version])
@pytest.mark.quick(0)
def test_unusable_checkpoints_are_replaced(start_process, expected, damage):
    service = start_process()
    job = service.submit(options=json.dumps(BRIEF))
    service.running(job)
    service.kill(signal.SIGKILL)
    damage(folder_of(service, job) / "checkpoint.npz")
    service.restart()
    status = service.ended(job)
    assert (status["state"], status["starts"]) == ("succeeded", 2)
    assert service.http.get(status["links"]["result"]).content == expected


@pytest.mark.parametrize("saved", [0, 1])
@pytest.mark.quick(0)
def test_a_full_disk_disables_checkpoints(tmp_path, monkeypatch, expected, saved):
    """The job succeeds without them, and its report does not reveal paths of the server."""
    from kissgs.training import checkpoint

    real, left = checkpoint.atomic_file, [None] * saved

    def full(path, *, overwrite):
        if left:
            left.pop()
            return real(path, overwrite=overwrite)
        raise OutputError(f"cannot write {path}: no space left on device")

    monkeypatch.setattr(checkpoint, "atomic_file", full)
    monkeypatch.setattr(checkpoint, "SAVE_INTERVAL", 0.0)
    work = tmp_path / "work"
    work.mkdir()
    (tmp_path / "scene.ply").write_bytes(SMALL)
    monkeypatch.chdir(tmp_path)
    task = {"source": "scene.ply", "work": "work", "settings": BRIEF, "format": "sogxt", "container": "scene.zip"}
    task |= {"evaluate": False, "checkpoint": "checkpoint.npz", "threads": 0, "device": "cpu"}
    job_process.compress(task, lambda *event: None)
    assert (work / "result" / "scene.zip").read_bytes() == expected
    report = (work / "result" / "report.json").read_text()
    assert ("no space left" in report) == bool(saved)
    assert str(tmp_path) not in report


@pytest.mark.quick(0)
def test_disk_space_for_checkpoints_is_reserved_until_the_job_ends(start_held):
    service, training = start_held("sparsify", KISSGS_MAX_DISK_BYTES=4 * len(SMALL))
    job = service.submit(options=json.dumps(BRIEF))
    training.wait()
    training.release()
    kept = folder_of(service, job) / "checkpoint.npz"
    assert 2 * kept.stat().st_size <= checkpoint_bytes(300, 1)
    problem(service.http.post("/v1/jobs", content=SMALL), 507, "disk-full")
    service.http.post(job["links"]["cancel"])
    assert not folder_of(service, job).exists()
    assert service.ended(service.submit())["state"] == "succeeded"


def test_the_largest_record_of_steps():
    """The record of the maximum number of pruning rounds, each with its training, is below the bound."""
    step = asdict(CompactionStep(name="sparsify", count=20_000_000, seconds=123.456789012345))
    (most,) = [limit.le for limit in CompactSettings.model_fields["prune_rounds"].metadata if hasattr(limit, "le")]
    assert len(json.dumps([step] * (2 * most + 3))) < STEPS_BYTES


TUNING = {"enabled": True, "steps": STEPS, "views": 24, "view_size": 48}
FINETUNED = {"preset": "fast", "finetune": TUNING, "for_research": True}


@pytest.mark.quick(0)
def test_fine_tuning_continues_and_its_gain_is_reported(start_held):
    service, training = start_held("finetune", drain_seconds=0)
    job = service.submit(options=json.dumps(FINETUNED))
    training.wait()
    kept = folder_of(service, job) / "checkpoint-finetune.npz"
    assert 2 * kept.stat().st_size <= checkpoint_bytes(300, 1, compact=False, finetune=True)
    kill_the_service(service, training)
    status = service.ended(job)
    assert status["state"] == "succeeded", status
    expected = kissgs.compress(SMALL, settings=kissgs.Settings.model_validate(FINETUNED))
    assert service.http.get(status["links"]["result"]).content == expected.to_zip()
    gain = expected.report.finetuning.as_dict()
    assert {**status["finetuning"], "seconds": 0} == {**gain, "seconds": 0}
    before, after = training.saves_by_process
    assert before >= DONE
    assert before + after == STEPS  # no step was made twice
    assert all(done >= DONE / STEPS for _, done in training_events(service, job)[1])  # few events, or none, are sent
    assert sorted(path.name for path in folder_of(service, job).iterdir()) == ["result", "scene.ply"]
