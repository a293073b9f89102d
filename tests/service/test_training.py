"""Training in jobs and its interruption; oracle: the result without interruption."""

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
from service.jobs import job_process

pytest.importorskip("torch")


def options(steps):
    changes = {"count": 100, "sparsify_steps": steps, "refine_steps": steps, "views": 24, "view_size": 48}
    return {"preset": "fast", "compact": changes}


BRIEF, LONG = options(4), options(600)


@pytest.fixture(scope="module")
def expected():
    """Container of LONG, from the library."""
    return kissgs.compress(SMALL, settings=kissgs.Settings.model_validate(LONG)).to_zip()


@pytest.fixture
def start_saving(start, tmp_path):
    """Start a service whose jobs save checkpoints every 0.05 s instead of every half minute."""
    (tmp_path / "sitecustomize.py").write_text(
        "from kissgs.training import checkpoint\ncheckpoint.SAVE_INTERVAL = 0.05\n"
    )
    return lambda **settings: start(PYTHONPATH=f"{ROOT}{os.pathsep}{tmp_path}", **settings)


def folder_of(service, job):
    return service.folder / "jobs" / job["id"]


def training(service, job, stage="sparsify", fraction=0.0):
    """Wait until training has reached a stage and fraction and a checkpoint exists; return the progress."""
    while True:
        progress = service.running(job, stage)["progress"]
        if progress["fraction"] >= fraction and (folder_of(service, job) / "checkpoint.npz").exists():
            return progress
        time.sleep(0.02)


def training_events(service, job):
    """Return stage and fraction of the progress events of training, for each start of the job."""
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
        (folder / ".kissgs.half.part").write_bytes(b"PK half")  # an incomplete checkpoint
    service.restart()


def stop_the_service(service):
    assert service.kill(signal.SIGTERM) == 0
    service.restart()


def kill_the_job(service):
    os.kill(service.children()[0], signal.SIGKILL)


@pytest.mark.parametrize(
    ("stage", "interrupt"), [("sparsify", kill_the_service), ("refine", stop_the_service), ("refine", kill_the_job)]
)
def test_training_continues_after_an_interruption(start_saving, expected, stage, interrupt):
    service = start_saving(KISSGS_DRAIN_SECONDS=0)
    job = service.submit(options=json.dumps(LONG))
    training(service, job, stage, 0.4)
    interrupt(service)
    status = service.ended(job)
    assert status["state"] == "succeeded", status
    assert service.http.get(status["links"]["result"]).content == expected
    before, after = training_events(service, job)
    assert before[0] == ("sparsify", 0.0)
    assert after[0] != before[0]  # the progress of the last checkpoint depends on the machine
    assert sorted(path.name for path in folder_of(service, job).iterdir()) == ["result", "scene.ply"]


def damaged(path):
    path.write_bytes(path.read_bytes()[:-100] if path.exists() else b"")


def of_another_version(path):
    np.savez(path, key="another version's")


@pytest.mark.parametrize("damage", [damaged, of_another_version])
def test_unusable_checkpoints_are_replaced(start, damage):
    service = start()
    job = service.submit(options=json.dumps(BRIEF))
    service.running(job)
    service.kill(signal.SIGKILL)
    damage(folder_of(service, job) / "checkpoint.npz")
    service.restart()
    status = service.ended(job)
    assert (status["state"], status["starts"]) == ("succeeded", 2)
    result = service.http.get(status["links"]["result"]).content
    assert result == kissgs.compress(SMALL, settings=kissgs.Settings.model_validate(BRIEF)).to_zip()


@pytest.mark.parametrize("saved", [0, 1])
def test_a_full_disk_disables_checkpoints(tmp_path, monkeypatch, saved):
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
    monkeypatch.chdir(work)
    task = {
        "source": str(tmp_path / "scene.ply"),
        "work": str(work),
        "settings": BRIEF,
        "evaluate": False,
        "checkpoint": str(tmp_path / "checkpoint.npz"),
        "threads": 0,
    }
    job_process._compress(task, lambda event: None)
    result = (work / "result" / "scene.zip").read_bytes()
    assert result == kissgs.compress(SMALL, settings=kissgs.Settings.model_validate(BRIEF)).to_zip()
    report = (work / "result" / "report.json").read_text()
    assert ("no space left" in report) == bool(saved)
    assert str(tmp_path) not in report


def test_disk_space_for_checkpoints_is_reserved_until_the_job_ends(start_saving):
    service = start_saving(KISSGS_MAX_DISK_BYTES=4 * len(SMALL))
    job = service.submit(options=json.dumps(LONG))
    training(service, job)
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


def test_training_notes(service):
    job = service.submit(options=json.dumps(LONG))
    note = ""
    while "loss" not in note:  # not before the first step, nor while Gaussians are pruned
        note = training(service, job).get("note", "")
    assert re.fullmatch(r"1\d\d Gaussians, loss 0\.\d{4}, PSNR \d\d\.\d\d", note)
    sent = [data for _, kind, data in events(service.http.get(job["links"]["events"]).text) if kind == "progress"]
    assert {data["stage"] for data in sent if "note" in data} == {"sparsify", "refine"}
    assert any(data.get("note") == note for data in sent)


FINETUNED = {"preset": "fast", "finetune": {"enabled": True, "steps": 300, "views": 24, "view_size": 48}}


def test_fine_tuning_continues_and_its_gain_is_reported(start_saving):
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
    _, after = training_events(service, job)
    assert after[0][1] > 0.2
    assert sorted(path.name for path in folder_of(service, job).iterdir()) == ["result", "scene.ply"]
