"""Replicas on one PostgreSQL database and one bucket; oracles: kissgs.compress of the scenes, and the bucket's keys."""

import contextlib
import json
import os
import re
import signal
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
from helpers.data_folders import add_a_job, command
from helpers.job_rows import job as job_row
from helpers.replica_kills import SETTINGS, kill_a_replica, kill_at_random_moments
from helpers.s3_server import CREDENTIALS, S3Server
from helpers.service import FAST, SMALL, Replicas, problem, scene_bytes

import kissgs
from service.core.models import State
from service.core.settings import ServiceSettings, SettingsError
from service.http.app import build
from service.jobs.replica_watch import ReplicaWatch
from service.storage.database_health import DatabaseReplacedError
from service.storage.job_records import LimitExceeded
from service.storage.replicas import LAPSE_BEATS, LapseObserver, Replica

EXPECTED = kissgs.compress(SMALL, settings=kissgs.Settings(preset="fast")).to_zip()
MEDIUM = scene_bytes(6_000, 2)


@pytest.fixture
def two(tmp_path, bucket, new_database):
    with Replicas(tmp_path / "two", 2, bucket, new_database()) as it:
        yield it


def starts_in_logs(replicas):
    """Return the ids of jobs that were started, once for each start."""
    text = "".join(replica.log.read_text() for replica in replicas.replicas)
    return re.findall(r"job ([0-9a-f]{32}) starts:", text)


def result_of(service, job):
    status = service.ended(job, seconds=120)
    assert status["state"] == "succeeded", status
    return service.http.get(status["links"]["result"]).content


# Processes -----------------------------------------------------------------------------------------------------------


def test_jobs_run_once_and_on_both(two):
    jobs = [two.submit(scene_bytes(40, 0, seed=i)) for i in range(8)]
    ended = [two.ended(job) for job in jobs]
    assert {(job["state"], job["starts"]) for job in ended} == {("succeeded", 1)}
    assert sorted(starts_in_logs(two)) == sorted(job["id"] for job in jobs)
    for replica in two.replicas:
        assert "starts:" in replica.log.read_text()
    assert two.leftovers() == []


def test_news_and_cancellation_reach_the_other_replica(two):
    """Oracle: the limits on delays that the guide states."""
    first, second = (replica.http for replica in two.replicas)
    (running, _) = two.occupy()
    waiting = two.submit()
    with second.stream("GET", f"/v1/jobs/{waiting['id']}/events") as answer:
        begun = time.monotonic()
        assert first.post(f"/v1/jobs/{waiting['id']}/cancel").json()["state"] == "cancelled"
        assert "cancelled" in answer.read().decode()
        assert time.monotonic() - begun < 2
    begun = time.monotonic()
    for client in (first, second):  # one of them does not run the job
        assert client.post(f"/v1/jobs/{running['id']}/cancel").json()["state"] == "cancelled"
    assert time.monotonic() - begun < 3
    assert len(two.children()) == 1
    assert running["id"] not in two.stored()


def test_a_killed_replica_s_job_continues_on_the_other(two):
    jobs = [two.submit(MEDIUM) for _ in range(2)]
    for job in jobs:
        two.running(job)
    dead, alive = two.replicas
    dead.kill(signal.SIGKILL)
    ended = [alive.ended(job, seconds=60) for job in jobs]
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
    ended = [awake.ended(job, seconds=90) for job in jobs]
    assert sorted((job["state"], job["starts"]) for job in ended) == [("succeeded", 1), ("succeeded", 2)]
    for process in (*children, asleep.process.pid):
        os.kill(process, signal.SIGCONT)
    end = time.monotonic() + 30
    while "it ends them and joins anew" not in asleep.log.read_text() and time.monotonic() < end:
        time.sleep(0.2)
    while asleep.http.get("/readyz").status_code != 200 and time.monotonic() < end:
        time.sleep(0.2)
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


def test_a_stopped_replica_leaves_no_row(two):
    two.ended(two.submit())
    assert two.kill(signal.SIGTERM) == 0
    two.restart()
    assert result_of(two, two.submit()) == EXPECTED
    for replica in two.replicas:
        assert "have died" not in replica.log.read_text()


# One process, without HTTP -------------------------------------------------------------------------------------------


@pytest.fixture
def member(tmp_path, bucket, new_database, monkeypatch):
    """``member()`` opens a replica in this process; ``member.die(context)`` makes it one of an ended process."""
    for name in os.environ:
        if name.startswith(("KISSGS_", "AWS_")):
            monkeypatch.delenv(name)
    variables = {**bucket.variables, "KISSGS_DATABASE_URL": new_database()}
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    opened = []

    def join():
        context = build(ServiceSettings(data_dir=tmp_path / f"member{len(opened)}"))
        opened.append(context)
        set_process(context, os.getppid())  # else it would be taken for a former process with the same number
        return context

    def set_process(context, number):
        with context.store._writing.begin() as session:
            session.get(Replica, context.store.replica).process = number

    def die(context):
        set_process(context, 2**22 + 1)
        return context.store.replica

    join.die = die
    yield join
    for context in opened:
        with contextlib.suppress(Exception):
            context.store.close()
        context.storage.close()


def write_result(context, job_id, complete=True):
    """Store a result as the worker does, but for the last file if it is not ``complete``."""
    work = context.storage.new_work(job_id)
    folder = work / "result"
    (folder / "files").mkdir(parents=True)
    contents = {"scene.zip": b"PK", "report.json": b"{}", "files/meta.json": b"{} "}
    for name, content in contents.items():
        (folder / name).write_bytes(content)
    sizes = {name: {"bytes": len(content), "sha256": "0" * 64} for name, content in contents.items()}
    summary = {
        "container": sizes["scene.zip"], "report": sizes["report.json"],
        "files": {"meta.json": {**sizes["files/meta.json"], "stored": 3}},
        "count": 3, "seconds": {"total": 1.0}, "cpu_seconds": 1.0,
    }  # fmt: skip
    (folder / "summary.json").write_text(json.dumps(summary))
    kept = context.storage.new_result()
    context.storage.keep_result(job_id, kept, work)
    if not complete:
        context.storage._objects.delete([f"jobs/{job_id}/{kept}/summary.json"])
    return kept


def add(context):
    """Add a queued job as a submission does; return its id."""
    context.store.take_claim(job_id := f"{len(context.store.ids()):032x}")
    upload = context.storage.new_upload()
    upload.write_bytes(b"ply")
    context.storage.adopt(upload, job_id)
    row = job_row(disk_bytes=3, upload_bytes=3)
    row.id = job_id
    context.admission.add(row)
    return job_id


def names(bucket, job_id):
    return sorted(key.split("/", 2)[2] for key in bucket.names() if key.startswith(f"jobs/{job_id}/"))


@pytest.mark.parametrize(
    "moment", ["before the row", "half a result", "a whole result", "cancelled", "deleted", "decoded"]
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
        job_id = add(first)
        number = first.store.claim().number
        kept = write_result(first, job_id, complete=moment not in ("half a result", "cancelled"))
    second = member()
    match moment:
        case "cancelled":
            second.store.move(number, State.CANCELLED)
        case "deleted":
            second.store.forget(number)
        case "decoded":
            summary = first.storage.read_result(job_id, kept, "scene.zip")
            first.worker.completion.succeed(first.store.get(job_id), summary, kept)
            first.store.take_claim(job_id)
            bucket.put(f"jobs/{job_id}/decoded.ply", b"half")
    before = names(bucket, job_id)
    dead = member.die(first)
    watch = ReplicaWatch(second)
    watch.recover()
    watch.recover()
    after, job = names(bucket, job_id), second.store.get(job_id)
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
    job_id = add(first)
    for start in range(first.settings.job_starts):
        assert first.store.claim().starts == start + 1
        member.die(first)
        first = member()
        ReplicaWatch(first).recover()
    job = first.store.get(job_id)
    assert (job.state, job.problem["code"]) == (State.FAILED, "crashed")
    assert names(bucket, job_id) == []


def test_recovery_does_not_touch_jobs_of_the_living(member, bucket):
    first = member()
    running, waiting = add(first), add(first)
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
    job_id = add(first)
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
    add(first)
    bucket.put(f"jobs/{'d' * 32}/scene.ply", b"of an older database")
    before = bucket.names()
    second = member()
    ReplicaWatch(second).recover()
    assert second.storage.orphaned_note() == f"jobs in {second.storage.place} that the database does not know: 1"
    assert bucket.names() == before


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
    jobs = [add(members[0]) for _ in range(10)]
    with ThreadPoolExecutor(8) as pool:
        claimed = list(pool.map(lambda i: members[i % 2].store.claim(), range(16)))
    assert sorted(job.id for job in claimed if job) == jobs


def test_checkpoints_reach_other_replicas(member, bucket):
    first, second = member(), member()
    job_id = add(first)
    first.store.claim()
    first.storage.new_work(job_id)
    for content in (b"one", b"two"):
        first.storage.checkpoint(job_id).write_bytes(content)
        first.storage.store_checkpoints(job_id)
        first.storage.store_checkpoints(job_id)
    first.storage.remove_work(job_id)
    assert names(bucket, job_id) == ["checkpoint.npz", "scene.ply"]
    second.storage.new_work(job_id)
    second.storage.fetch_checkpoints(job_id)
    assert second.storage.checkpoint(job_id).read_bytes() == b"two"
    second.storage.remove_work(job_id)
    second.storage.store_checkpoints(job_id)  # there are none any more
    first.worker.completion.succeed(first.store.get(job_id), *result_in(first, job_id))
    assert "checkpoint.npz" not in names(bucket, job_id)


def result_in(context, job_id):
    folder = write_result(context, job_id)
    return context.storage.read_result(job_id, folder, "scene.zip"), folder


def test_lapses():
    """Oracle: the definition, a number of readings without a change."""
    observer = LapseObserver()

    def rows(*beats):
        return [Replica(id=str(i), machine=1, process=1, beats=value) for i, value in enumerate(beats)]

    for i in range(LAPSE_BEATS):
        assert observer.lapsed(rows(i, 7, i // 3)) == []
    assert [row.id for row in observer.lapsed(rows(LAPSE_BEATS, 7, 8))] == ["1"]
    assert observer.lapsed(rows(LAPSE_BEATS, 8)) == []


# Starts that are refused -------------------------------------------------------------------------------------------

WRONG = {
    "bucket": ({"KISSGS_STORAGE": "s3://no-such-bucket/x"}, "there is no bucket 'no-such-bucket' at http://127.0.0.1:"),
    "endpoint": (
        {"AWS_ENDPOINT_URL": "http://127.0.0.1:1"},
        "http://127.0.0.1:1 cannot be reached; check AWS_ENDPOINT",
    ),
    "no endpoint": ({"AWS_ENDPOINT_URL": "nonsense"}, "AWS_ENDPOINT_URL: it is no address such as https://"),
    "credentials": ({"AWS_ACCESS_KEY_ID": ""}, "AWS_ACCESS_KEY_ID"),
    "sqlite": ({"KISSGS_DATABASE_URL": "sqlite:///x"}, "needs PostgreSQL; set KISSGS_DATABASE_URL, too"),
    "form": ({"KISSGS_STORAGE": "http://bucket"}, "it is not s3://BUCKET or s3://BUCKET/PREFIX"),
}


@pytest.mark.parametrize("wrong", WRONG)
@pytest.mark.quick(3)
def test_wrong_settings(tmp_path, bucket, new_database, wrong):
    """The message is one line, without the secret."""
    settings, text = WRONG[wrong]
    chosen = {"KISSGS_DATABASE_URL": new_database(), **bucket.variables, **settings}
    ended = command(tmp_path / "data", **{name: value for name, value in chosen.items() if value})
    assert (ended.returncode, ended.stdout) == (2, "")
    lines = ended.stderr.splitlines()
    assert len(lines) == 1, ended.stderr
    assert text in lines[0]
    assert CREDENTIALS["AWS_SECRET_ACCESS_KEY"] not in ended.stderr


def test_storage_database_and_folder_belong_together(member, tmp_path, bucket, new_database, s3_server, monkeypatch):
    first = member()
    add(first)
    monkeypatch.setenv("KISSGS_STORAGE", first.settings.storage + "/other")
    with pytest.raises(SettingsError, match="this database belongs to another storage"):
        member()
    monkeypatch.setenv("KISSGS_STORAGE", first.settings.storage)
    monkeypatch.setenv("KISSGS_DATABASE_URL", new_database())
    with pytest.raises(SettingsError, match="has the files of 1 jobs, but the job database is new"):
        member()
    monkeypatch.delenv("KISSGS_STORAGE")
    single = build(ServiceSettings(data_dir=tmp_path / "single", database_url=None))
    add_a_job(single)
    single.store.close()
    single.storage.close()
    monkeypatch.setenv("KISSGS_STORAGE", first.settings.storage)
    with pytest.raises(SettingsError, match="belongs to a service without KISSGS_STORAGE"):
        build(ServiceSettings(data_dir=tmp_path / "single"))
    assert len(list((tmp_path / "single" / "jobs").iterdir())) == 1


def test_simultaneous_first_starts(tmp_path, bucket, new_database):
    with Replicas(tmp_path / "many", 3, bucket, new_database()) as it:
        it.kill(signal.SIGKILL)
        with ThreadPoolExecutor(3) as pool:
            list(pool.map(lambda replica: replica.restart(), it.replicas))


# The bucket fails --------------------------------------------------------------------------------------------------


def test_an_emptied_bucket(two, bucket):
    job = two.ended(two.submit())
    number = bucket.get("identity")
    bucket.delete("identity")
    for replica in two.replicas:
        end = time.monotonic() + 20
        while replica.http.get("/readyz").status_code == 200 and time.monotonic() < end:
            time.sleep(0.2)
        assert "was emptied or replaced" in replica.http.get("/readyz").json()["checks"]["disk"]
    for _ in range(2):
        problem(two.http.post("/v1/jobs", content=SMALL, params={"options": FAST}), 503, "storage")
    bucket.put("identity", number)
    for replica in two.replicas:
        end = time.monotonic() + 20
        while replica.http.get("/readyz").status_code != 200 and time.monotonic() < end:
            time.sleep(0.2)
    assert result_of(two, two.submit()) == two.http.get(job["links"]["result"]).content


def test_a_bucket_that_cannot_be_reached(tmp_path, new_database):
    with S3Server(tmp_path) as server, Replicas(tmp_path / "one", 1, server.bucket(), new_database()) as it:
        job = it.ended(it.submit())
        server.process.kill()
        end = time.monotonic() + 30
        while (ready := it.http.get("/readyz")).status_code == 200 and time.monotonic() < end:
            time.sleep(0.2)
        assert f"{server.url} cannot be reached" in ready.json()["checks"]["disk"]
        problem(it.http.post("/v1/jobs", content=SMALL, params={"options": FAST}), 503, "storage")
        problem(it.http.get(job["links"]["report"]), 503, "storage")
        assert it.status(job)["state"] == "succeeded"
        assert CREDENTIALS["AWS_SECRET_ACCESS_KEY"] not in it.log.read_text()


def test_a_file_that_vanishes(two, bucket):
    job = two.ended(two.submit())
    row = [key for key in bucket.names() if key.endswith("scene.zip")]
    bucket.delete(row[0])
    problem(two.http.get(job["links"]["result"]), 410, "gone")
