"""Replicas that share jobs: each runs once, news and limits reach all. Oracle: kissgs.compress, and the logs."""

import re
import signal
from concurrent.futures import ThreadPoolExecutor

from helpers.job_rows import job as job_row
from helpers.replica_members import add_job, files_of_job, result_in
from helpers.service import SMALL, Replicas, scene_bytes

import kissgs
from service.storage.job_records import LimitExceeded


def starts_in_logs(replicas):
    """Return the ids of jobs that were started, once for each start."""
    text = "".join(replica.log.read_text() for replica in replicas.replicas)
    return re.findall(r"job ([0-9a-f]{32}) starts:", text)


def test_jobs_run_once_and_on_both(two):
    jobs = [two.submit(scene_bytes(40, 0, seed=i)) for i in range(8)]
    ended = [two.ended(job) for job in jobs]
    assert {(job["state"], job["starts"]) for job in ended} == {("succeeded", 1)}
    assert sorted(starts_in_logs(two)) == sorted(job["id"] for job in jobs)
    for replica in two.replicas:
        assert "starts:" in replica.log.read_text()
    assert two.leftovers() == []


def test_news_and_cancellation_reach_the_other_replica(two):
    """The stream of a job that waits ends while another one runs, which one of the replicas then ends."""
    first, second = (replica.http for replica in two.replicas)
    (running, _) = two.occupy()
    waiting = two.submit()
    with second.stream("GET", f"/v1/jobs/{waiting['id']}/events") as answer:
        assert first.post(f"/v1/jobs/{waiting['id']}/cancel").json()["state"] == "cancelled"
        assert "cancelled" in answer.read().decode()
    assert two.status(running)["state"] == "running"
    for client in (first, second):  # one of them does not run the job
        assert client.post(f"/v1/jobs/{running['id']}/cancel").json()["state"] == "cancelled"
    assert len(two.children()) == 1
    assert running["id"] not in two.stored()


def test_a_stopped_replica_leaves_no_row(two):
    two.ended(two.submit())
    assert two.kill(signal.SIGTERM) == 0
    two.restart()
    assert two.result(two.submit()) == kissgs.compress(SMALL, settings=kissgs.Settings(preset="fast")).to_zip()
    for replica in two.replicas:
        assert "have died" not in replica.log.read_text()


def test_simultaneous_first_starts(tmp_path, bucket, new_database):
    with Replicas(tmp_path / "many", 3, bucket, new_database()) as it:
        it.kill(signal.SIGKILL)
        with ThreadPoolExecutor(3) as pool:
            list(pool.map(lambda replica: replica.restart(), it.replicas))


def test_limits_hold_for_all_replicas(member):
    """Additions of two replicas at the same time."""
    members = [member(), member()]

    def send(i):
        context, row = members[i % 2], job_row("alice", disk_bytes=10)
        row.id = f"{i:032x}"
        context.store.take_claim(row.id)
        try:
            context.store.add(row, max_queue=100, max_owner=limit["owner"], max_disk=limit["disk"])
        except LimitExceeded as error:
            return error.limit
        return "added"

    limit = {"owner": 5, "disk": 1000}
    with ThreadPoolExecutor(16) as pool:
        found = list(pool.map(send, range(24)))
        assert (found.count("added"), found.count("owner")) == (5, 19)
        limit = {"owner": 100, "disk": 95}
        found = list(pool.map(send, range(24, 48)))
        assert (found.count("added"), found.count("disk")) == (4, 20)


def test_jobs_are_claimed_once(member):
    members = [member(), member()]
    jobs = [add_job(members[0]) for _ in range(10)]
    with ThreadPoolExecutor(8) as pool:
        claimed = list(pool.map(lambda i: members[i % 2].store.claim(), range(16)))
    assert sorted(job.id for job in claimed if job) == jobs


def test_checkpoints_reach_other_replicas(member, bucket):
    first, second = member(), member()
    job_id = add_job(first)
    first.store.claim()
    first.storage.new_work(job_id)
    for content in (b"one", b"two"):
        first.storage.checkpoint(job_id).write_bytes(content)
        first.storage.store_checkpoints(job_id)
        first.storage.store_checkpoints(job_id)
    first.storage.remove_work(job_id)
    assert files_of_job(bucket, job_id) == ["checkpoint.npz", "scene.ply"]
    second.storage.new_work(job_id)
    second.storage.fetch_checkpoints(job_id)
    assert second.storage.checkpoint(job_id).read_bytes() == b"two"
    second.storage.remove_work(job_id)
    second.storage.store_checkpoints(job_id)  # there are none any more
    first.worker.completion.succeed(first.store.get(job_id), *result_in(first, job_id))
    assert "checkpoint.npz" not in files_of_job(bucket, job_id)
