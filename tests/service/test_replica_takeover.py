"""Replicas that die, and others that take over their jobs. Oracle: kissgs.compress of the scenes, the bucket's keys."""

import os
import signal
import sys

import pytest
from helpers.job_rows import job as job_row
from helpers.replica_kills import SETTINGS, kill_a_replica, kill_at_random_moments
from helpers.replica_members import add_job, files_of_job, write_result
from helpers.running import wait_until
from helpers.service import Replicas, scene_bytes

import kissgs
from service.core.models import State
from service.jobs.replica_watch import ReplicaWatch
from service.storage.database_health import DatabaseReplacedError
from service.storage.replicas import LAPSE_BEATS, LapseObserver, Replica

MEDIUM = scene_bytes(6_000, 2)


def test_a_killed_replica_s_job_continues_on_the_other(two):
    jobs = [two.submit(MEDIUM) for _ in range(2)]
    for job in jobs:
        two.running(job)
    dead, alive = two.replicas
    dead.kill(signal.SIGKILL)
    ended = [alive.ended(job) for job in jobs]
    assert sorted((job["state"], job["starts"]) for job in ended) == [("succeeded", 1), ("succeeded", 2)]
    expected = kissgs.compress(MEDIUM, settings=kissgs.Settings(preset="fast")).to_zip()
    assert {alive.http.get(job["links"]["result"]).content for job in ended} == {expected}
    dead.restart()
    assert two.leftovers() == []


@pytest.mark.quick(0)
def test_a_suspended_replica_joins_again(two):
    """After its jobs were taken over, it writes nothing, and later runs others."""
    jobs = [two.submit(MEDIUM) for _ in range(2)]
    for job in jobs:
        two.running(job)
    asleep, awake = two.replicas
    children = asleep.children()
    for process in (asleep.process.pid, *children):
        os.kill(process, signal.SIGSTOP)
    ended = [awake.ended(job) for job in jobs]
    assert sorted((job["state"], job["starts"]) for job in ended) == [("succeeded", 1), ("succeeded", 2)]
    for process in (*children, asleep.process.pid):
        os.kill(process, signal.SIGCONT)
    wait_until(lambda: "it ends them and joins anew" in asleep.log.read_text())
    wait_until(lambda: asleep.http.get("/readyz").status_code == 200)
    assert two.http.get("/readyz").status_code == 200
    assert [two.status(job)["starts"] for job in jobs] == [job["starts"] for job in ended]
    assert two.leftovers() == []
    two.occupy()


@pytest.mark.parametrize("kills", [2, 10])
@pytest.mark.quick(1)
def test_replicas_are_killed_at_random_moments(tmp_path, bucket, new_database, kills):
    two = Replicas(tmp_path / "kills", 2, bucket, new_database(), **SETTINGS)
    found = kill_at_random_moments(two, kill_a_replica, kills=kills, jobs=4, seed=kills)
    sys.stdout.write(f"starts of the jobs: {found.starts}\n")
    assert found.lost == found.different == 0
    assert found.leftovers == []


@pytest.mark.parametrize(
    "moment", ["before the row", "half a result", "a whole result", "recorded", "cancelled", "deleted", "decoded"]
)
def test_what_a_dead_replica_leaves(member, bucket, moment):
    first = member()
    if moment == "before the row":
        job_id = "f" * 32
        first.store.take_claim(job_id)
        upload = first.storage.new_upload()
        upload.write_bytes(b"ply")
        first.storage.adopt(upload, job_id)
    else:
        job_id = add_job(first)
        number = first.store.claim().number
        kept = write_result(first, job_id, complete=moment not in ("half a result", "cancelled"))
    second = member()
    match moment:
        case "cancelled":
            second.store.move(number, State.CANCELLED)
        case "deleted":
            second.store.forget(number)
        case "recorded":  # but not settled: neither the upload nor the checkpoint is needed
            bucket.put(f"jobs/{job_id}/checkpoint.npz", b"half")
            first.store.move(number, State.SUCCEEDED, result={"folder": kept}, upload_kept=False)
        case "decoded":
            summary = first.storage.read_result(job_id, kept, "scene.zip")
            first.worker.completion.succeed(first.store.get(job_id), summary, kept)
            first.store.take_claim(job_id)
            bucket.put(f"jobs/{job_id}/decoded.ply", b"half")
    before = files_of_job(bucket, job_id)
    dead = member.die(first)
    watch = ReplicaWatch(second)
    watch.recover()
    watch.recover()
    after, job = files_of_job(bucket, job_id), second.store.get(job_id)
    assert second.store.claims_of_the_dead() == []
    assert dead not in [row.id for row in second.store.other_replicas()]
    match moment:
        case "before the row" | "deleted":
            assert (job, after) == (None, [])
        case "half a result":
            assert (job.state, after) == (State.QUEUED, ["scene.ply"])
            assert second.store.claim().starts == 2
        case "a whole result":
            assert (job.state, after) == (State.SUCCEEDED, before)
            assert second.storage.open(job_id, f"{job.result['folder']}/scene.zip").size == 2
        case "recorded":
            assert (job.state, after) == (State.SUCCEEDED, [name for name in before if name.startswith(kept)])
        case "cancelled":
            assert (job.state, after) == (State.CANCELLED, [])
        case "decoded":
            assert (job.state, after) == (State.SUCCEEDED, before)
            assert second.storage.read_decoded(job_id) is None
    if moment != "a whole result":
        with pytest.raises(DatabaseReplacedError, match="took this one for dead"):
            first.store.claim()


def test_a_job_that_ends_its_replica_fails_after_its_last_start(member, bucket):
    first = member()
    job_id = add_job(first)
    for start in range(first.settings.job_starts):
        assert first.store.claim().starts == start + 1
        member.die(first)
        first = member()
        ReplicaWatch(first).recover()
    job = first.store.get(job_id)
    assert (job.state, job.problem["code"]) == (State.FAILED, "crashed")
    assert files_of_job(bucket, job_id) == []


def test_recovery_does_not_touch_jobs_of_the_living(member, bucket):
    first = member()
    running, waiting = add_job(first), add_job(first)
    first.store.claim()
    write_result(first, running, complete=False)
    first.store.take_claim("e" * 32)  # an upload in progress
    bucket.put(f"jobs/{'e' * 32}/scene.ply", b"ply")
    before = bucket.names()
    second = member()
    ReplicaWatch(second).recover()
    assert bucket.names() == before
    assert second.storage.orphaned_note() is None
    assert [second.store.get(job).state for job in (running, waiting)] == [State.RUNNING, State.QUEUED]
    assert second.store.claim().id == waiting


def test_a_replica_that_was_taken_for_dead_adds_and_records_nothing(member, bucket):
    first, second = member(), member()
    job_id = add_job(first)
    job = first.store.claim()
    first.store.take_claim("e" * 32)
    member.die(first)
    ReplicaWatch(second).recover()
    assert second.store.claim().id == job_id
    with pytest.raises(DatabaseReplacedError):
        first.store.move(job.number, State.SUCCEEDED)
    first.storage.replica = first.store.join()
    row = job_row()
    row.id = "e" * 32
    with pytest.raises(DatabaseReplacedError, match="send the request again"):  # its files were removed
        first.store.add(row, max_queue=9, max_owner=9)
    assert not first.store.move(job.number, State.SUCCEEDED, dead="0" * 16)
    assert second.store.get(job_id).state == State.RUNNING


def test_files_of_unknown_jobs_are_reported_and_kept(member, bucket):
    first = member()
    add_job(first)
    bucket.put(f"jobs/{'d' * 32}/scene.ply", b"of an older database")
    before = bucket.names()
    second = member()
    ReplicaWatch(second).recover()
    assert second.storage.orphaned_note() == f"jobs in {second.storage.place} that the database does not know: 1"
    assert bucket.names() == before


def test_lapses():
    """Oracle: the definition, a number of readings without a change."""
    observer = LapseObserver()

    def rows(*beats):
        return [Replica(id=str(i), machine=1, process=1, beats=value) for i, value in enumerate(beats)]

    for i in range(LAPSE_BEATS):
        assert observer.lapsed(rows(i, 7, i // 3)) == []
    assert [row.id for row in observer.lapsed(rows(LAPSE_BEATS, 7, 8))] == ["1"]
    assert observer.lapsed(rows(LAPSE_BEATS, 8)) == []
