"""Training in jobs, and what becomes of it when it is interrupted; oracle: the same work where nothing does that."""

import json
import os
import re
import signal
import time
from dataclasses import asdict

import numpy as np
import pytest
from helpers.service import ROOT, SMALL, events, problem

import kissgs
from kissgs import CompactSettings
from kissgs.compaction.result import CompactionStep
from kissgs.core.errors import OutputError
from service.core.disk_estimates import STEPS_BYTES, checkpoint_bytes
from service.jobs import job_process as child

pytest.importorskip("torch")


def options(steps):
    changes = {"count": 100, "sparsify_steps": steps, "refine_steps": steps, "views": 24, "view_size": 48}
    return {"preset": "fast", "compact": changes}


BRIEF, LONG = options(4), options(600)


@pytest.fixture(scope="module")
def expected():
    """The container of LONG, by the library."""
    return kissgs.compress(SMALL, settings=kissgs.Settings.model_validate(LONG)).to_zip()


@pytest.fixture
def start_saving(start, tmp_path):
    """Starts a service whose jobs save their state all the time, not every half minute."""
    (tmp_path / "sitecustomize.py").write_text(
        "from kissgs.training import checkpoint\ncheckpoint.SAVE_INTERVAL = 0.05\n"
    )
    return lambda **settings: start(PYTHONPATH=f"{ROOT}{os.pathsep}{tmp_path}", **settings)


def folder_of(service, job):
    return service.folder / "jobs" / job["id"]


def training(service, job, stage="sparsify", fraction=0.0):
    """Once its training has come so far, and has been saved."""
    while True:
        progress = service.running(job, stage)["progress"]
        if progress["fraction"] >= fraction and (folder_of(service, job) / "checkpoint.npz").exists():
            return progress
        time.sleep(0.02)


def told(service, job):
    """What was heard of its training, start by start: stage and fraction."""
    starts = []
    for _, kind, data in events(service.http.get(job["links"]["events"]).text):
        if kind == "state" and data["state"] == "running":
            starts.append([])
        elif kind == "progress" and data["stage"] in ("sparsify", "refine", "finetune") and data.get("note"):
            starts[-1].append((data["stage"], data["fraction"]))
    return starts


def kill_the_service(service):
    service.kill(signal.SIGKILL)
    for folder in (service.folder / "jobs").iterdir():
        (folder / ".kissgs.half.part").write_bytes(b"PK half")  # the checkpoint that was being written
    service.restart()


def stop_the_service(service):
    assert service.kill(signal.SIGTERM) == 0
    service.restart()


def kill_the_job(service):
    os.kill(service.children()[0], signal.SIGKILL)


@pytest.mark.parametrize(
    ("stage", "interrupt"), [("sparsify", kill_the_service), ("refine", stop_the_service), ("refine", kill_the_job)]
)
def test_training_is_taken_up_where_it_was_left(start_saving, expected, stage, interrupt):
    service = start_saving(KISSGS_DRAIN_SECONDS=0)
    job = service.submit(options=json.dumps(LONG))
    training(service, job, stage, 0.4)
    interrupt(service)
    status = service.ended(job)
    assert status["state"] == "succeeded", status
    assert service.http.get(status["links"]["result"]).content == expected
    before, after = told(service, job)
    assert before[0] == ("sparsify", 0.0)
    assert after[0] != before[0]  # how far the last checkpoint had come depends on the machine
    assert sorted(path.name for path in folder_of(service, job).iterdir()) == ["result", "scene.ply"]


def damaged(path):
    path.write_bytes(path.read_bytes()[:-100] if path.exists() else b"")


def of_other_work(path):
    np.savez(path, key="another version's")


@pytest.mark.parametrize("spoil", [damaged, of_other_work])
def test_a_checkpoint_of_no_use_is_no_obstacle(start, spoil):
    service = start()
    job = service.submit(options=json.dumps(BRIEF))
    service.running(job)
    service.kill(signal.SIGKILL)
    spoil(folder_of(service, job) / "checkpoint.npz")
    service.restart()
    status = service.ended(job)
    assert (status["state"], status["starts"]) == ("succeeded", 2)
    result = service.http.get(status["links"]["result"]).content
    assert result == kissgs.compress(SMALL, settings=kissgs.Settings.model_validate(BRIEF)).to_zip()


@pytest.mark.parametrize("saved", [0, 1])
def test_a_disk_without_room_for_checkpoints_is_no_obstacle(tmp_path, monkeypatch, saved):
    """Neither at the first one nor later; and the report, which clients read, tells nothing of the server's folders."""
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
    monkeypatch.chdir(work)
    order = {
        "source": str(tmp_path / "scene.ply"),
        "work": str(work),
        "settings": BRIEF,
        "evaluate": False,
        "checkpoint": str(tmp_path / "checkpoint.npz"),
        "threads": 0,
    }
    child._compress(order, lambda event: None)
    result = (work / "result" / "scene.zip").read_bytes()
    assert result == kissgs.compress(SMALL, settings=kissgs.Settings.model_validate(BRIEF)).to_zip()
    report = (work / "result" / "report.json").read_text()
    assert ("no space left" in report) == bool(saved)
    assert str(tmp_path) not in report


def test_room_for_a_checkpoint_is_set_aside_until_the_job_has_ended(start_saving):
    service = start_saving(KISSGS_MAX_DISK_BYTES=4 * len(SMALL))
    job = service.submit(options=json.dumps(LONG))
    training(service, job)
    kept = folder_of(service, job) / "checkpoint.npz"
    assert 2 * kept.stat().st_size <= checkpoint_bytes(300, 1)
    problem(service.http.post("/v1/jobs", content=SMALL), 507, "disk-full")
    service.http.post(job["links"]["cancel"])
    assert not folder_of(service, job).exists()
    assert service.ended(service.submit())["state"] == "succeeded"


def test_the_longest_story_of_a_training_has_room():
    """A pruning and a training for each of as many rounds as there may be."""
    step = asdict(CompactionStep(name="sparsify", count=20_000_000, seconds=123.456789012345))
    (most,) = [limit.le for limit in CompactSettings.model_fields["prune_rounds"].metadata if hasattr(limit, "le")]
    assert len(json.dumps([step] * (2 * most + 3))) < STEPS_BYTES


def test_training_tells_what_it_has_come_to(service):
    job = service.submit(options=json.dumps(LONG))
    note = ""
    while "loss" not in note:  # not before the first step, nor while Gaussians go
        note = training(service, job).get("note", "")
    assert re.fullmatch(r"1\d\d Gaussians, loss 0\.\d{4}, PSNR \d\d\.\d\d", note)
    heard = [data for _, kind, data in events(service.http.get(job["links"]["events"]).text) if kind == "progress"]
    assert {data["stage"] for data in heard if "note" in data} == {"sparsify", "refine"}
    assert any(data.get("note") == note for data in heard)


FINETUNED = {"preset": "fast", "finetune": {"enabled": True, "steps": 300, "views": 24, "view_size": 48}}


def test_fine_tuning_is_taken_up_where_it_was_left_and_its_gain_is_told(start_saving):
    service = start_saving(KISSGS_DRAIN_SECONDS=0)
    job = service.submit(options=json.dumps(FINETUNED))
    kept = folder_of(service, job) / "checkpoint-finetune.npz"
    while not (kept.exists() and service.running(job, "finetune")["progress"]["fraction"] > 0.3):
        time.sleep(0.02)
    assert 2 * kept.stat().st_size <= checkpoint_bytes(300, 1, compact=False, finetune=True)
    kill_the_service(service)
    status = service.ended(job)
    assert status["state"] == "succeeded", status
    expected = kissgs.compress(SMALL, settings=kissgs.Settings.model_validate(FINETUNED))
    assert service.http.get(status["links"]["result"]).content == expected.to_zip()
    gain = expected.report.finetuning.as_dict()
    assert {**status["finetuning"], "seconds": 0} == {**gain, "seconds": 0}
    _, after = told(service, job)
    assert after[0][1] > 0.2
    assert sorted(path.name for path in folder_of(service, job).iterdir()) == ["result", "scene.ply"]
