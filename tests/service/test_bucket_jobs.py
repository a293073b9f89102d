"""Jobs on nodes that share no disk with the service. Oracle: kissgs.compress of the scene, and the bucket's keys."""

import asyncio
import json
import os
import re
import threading
import time
from concurrent.futures import Future
from pathlib import Path

import pytest
from helpers.data_folders import add_a_job, service
from helpers.job_rows import job as job_row
from helpers.service import FAST, SMALL

import kissgs
from kissgs.runners import Outcome as ItemOutcome
from kissgs.runners import RunHandle, WorkItem
from kissgs.sog.encode import FILES as SOG_FILES
from kissgs.sogxt.names import FILES as SOGXT_FILES
from kissgs.training.checkpoint import finetune_checkpoint_path
from service.core.disk_estimates import RESULT_BYTES, RESULT_BYTES_PER_GAUSSIAN
from service.core.formats import CHECKPOINT_FILES, CONTAINER_FILES
from service.core.models import State
from service.core.settings import ServiceSettings
from service.jobs import bucket_job, transfer, workplace
from service.jobs.runner import COMPRESS_IN_BUCKET, JobRunner, Outcome
from service.jobs.transfer import NodeDiskError, StorageAccessError
from service.storage.s3_storage import S3Storage

EXPECTED = kissgs.compress(SMALL, settings=kissgs.Settings(preset="fast"))
TRAINED = {"preset": "fast", "compact": {"count": 100, "sparsify_steps": 4, "refine_steps": 4}}


def silent(stage, fraction, note=""):
    pass


@pytest.fixture
def storage(tmp_path, bucket, monkeypatch):
    for name, value in bucket.variables.items():
        if name.startswith("AWS_"):
            monkeypatch.setenv(name, value)
    it = S3Storage(bucket.variables["KISSGS_STORAGE"], tmp_path / "data")
    it.replica = "0" * 16
    yield it
    it.close()


@pytest.fixture
def new_job(storage):
    """``new_job(options)`` adds the files of a job and returns its row."""

    def add(options=None, content=SMALL, name="scene.ply"):
        row = job_row(options=json.loads(FAST) if options is None else options, gaussians=300, work_bytes=1000)
        upload = storage.new_upload()
        upload.write_bytes(content)
        storage.adopt(upload, row.id, name)
        return row

    return add


@pytest.fixture
def node(tmp_path, monkeypatch):
    """Current folder of this process, as that of an item's process."""
    folder = tmp_path / "node"
    folder.mkdir()
    monkeypatch.chdir(folder)
    for name in [name for name in os.environ if name.startswith(("AWS_", "KISSGS_"))]:
        monkeypatch.delenv(name)
    return folder


@pytest.fixture
def place_of(storage):
    return lambda job: workplace.BucketWorkplace(storage, job, 600)


def task_of(place):
    return {**place.task(), "threads": 1, "device": "cpu"}


def names(bucket, job):
    return sorted(key.split("/", 2)[2] for key in bucket.names() if job.id in key)


def test_the_names_of_files_are_those_of_the_library():
    assert set(CONTAINER_FILES["sogxt"].contents) == set(SOGXT_FILES)
    assert set(CONTAINER_FILES["sog"].contents) == set(SOG_FILES)
    first, second = CHECKPOINT_FILES
    assert finetune_checkpoint_path(Path(first)) == Path(second)


@pytest.mark.parametrize("container", ["sogxt", "sog"])
def test_a_node_needs_only_its_task(storage, bucket, new_job, place_of, node, container):
    job = new_job({"preset": "fast", "format": container})
    place = place_of(job)
    text = json.dumps(task_of(place))
    assert str(storage._local.root) not in text
    assert bucket.variables["AWS_SECRET_ACCESS_KEY"] not in text
    summary = bucket_job.compress(json.loads(text), silent)
    assert place.finished() == summary
    place.keep()
    expected = kissgs.compress(SMALL, settings=kissgs.Settings(preset="fast"), container=container)
    name = CONTAINER_FILES[container].name
    assert bucket.get(f"jobs/{job.id}/{place.folder}/{name}") == expected.to_zip()
    for file, content in expected.files.items():
        assert bucket.get(f"jobs/{job.id}/{place.folder}/files/{file}") == content
    assert sum(path.stat().st_size for path in (node / "result").rglob("*")) < RESULT_BYTES + 300 * (
        RESULT_BYTES_PER_GAUSSIAN
    )


def test_starts_do_not_touch_each_other_s_results(storage, bucket, new_job, place_of, node, tmp_path, monkeypatch):
    """The first start was given up, but its node still works and is the last to end."""
    job = new_job()
    first, second = place_of(job), place_of(job)
    late, task = task_of(first), task_of(second)
    summary = bucket_job.compress(task, silent)
    kept = {name: bucket.get(f"jobs/{job.id}/{name}") for name in names(bucket, job)}
    (tmp_path / "other").mkdir()
    monkeypatch.chdir(tmp_path / "other")
    bucket_job.compress(late, silent)
    assert {name: bucket.get(f"jobs/{job.id}/{name}") for name in kept} == kept
    assert second.finished() == summary
    storage.settle(job.id, second.folder, keep_upload=True)
    assert names(bucket, job) == sorted(kept)


def test_a_result_without_its_last_file_is_none(bucket, new_job, place_of, node):
    job = new_job()
    place, task = place_of(job), None
    task = task_of(place)
    task["store"][bucket_job.SUMMARY] = "http://127.0.0.1:1/"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(transfer, "PAUSES", ())
        with pytest.raises(StorageAccessError):
            bucket_job.compress(task, silent)
    assert f"{place.folder}/scene.zip" in names(bucket, job)
    assert place.finished() is None
    with pytest.raises(FileNotFoundError):
        place.keep()
    place.clear(kept=False)
    assert names(bucket, job) == ["scene.ply"]


def test_an_error_has_no_paths(new_job, place_of, node):
    task = task_of(place_of(new_job(content=SMALL[:-10])))
    with pytest.raises(kissgs.InvalidSceneError) as raised:
        bucket_job.compress(task, silent)
    assert "is cut short" in str(raised.value)
    assert str(node) not in str(raised.value)


def test_a_node_without_space(new_job, place_of, node):
    task = task_of(place_of(new_job()))
    with pytest.raises(NodeDiskError, match=r"free disk space .* and the job may need 1e\+09 GB"):
        bucket_job.compress({**task, "space": 10**18}, silent)
    assert list(node.iterdir()) == []


def test_a_disk_that_is_full_at_the_end(new_job, place_of, node, monkeypatch):
    def full(task, progress):
        try:
            raise OSError(28, "No space left on device")
        except OSError as error:
            raise kissgs.OutputError("cannot write scene.zip: no space left on device") from error

    monkeypatch.setattr(bucket_job.job_process, "compress", full)
    with pytest.raises(NodeDiskError, match="is full: no space left on device"):
        bucket_job.compress(task_of(place_of(new_job())), silent)


# Checkpoints ---------------------------------------------------------------------------------------------------------


def training(saves, then):
    """Return a stand-in for compression: it saves these checkpoints, each once the last one is stored."""

    def compress(task, progress):
        for content, stored in saves:
            Path(task["checkpoint"]).write_bytes(content)
            assert stored is None or stored.wait(60)
        return then(task)

    return compress


def wait_for(condition):
    event = threading.Event()

    def look():
        end = time.monotonic() + 60
        while not condition() and time.monotonic() < end:
            time.sleep(0.01)
        event.set()

    threading.Thread(target=look, daemon=True).start()
    return event


def test_checkpoints_are_stored_meanwhile_and_continued(bucket, new_job, place_of, node, monkeypatch, tmp_path):
    job = new_job(TRAINED)
    key = f"jobs/{job.id}/checkpoint.npz"

    def stored(content):
        return wait_for(lambda: key in bucket.names() and bucket.get(key) == content)

    def lose(task):
        raise StorageAccessError("the network is gone")

    monkeypatch.setattr(bucket_job, "CHECKPOINT_SECONDS", 0.01)
    saves = [(b"one", stored(b"one")), (b"two", stored(b"two"))]
    monkeypatch.setattr(bucket_job.job_process, "compress", training(saves, lose))
    with pytest.raises(StorageAccessError):
        bucket_job.compress(task_of(place_of(job)), silent)
    assert bucket.get(key) == b"two"

    monkeypatch.setattr(bucket_job, "CHECKPOINT_SECONDS", 3600)
    (tmp_path / "other").mkdir()
    monkeypatch.chdir(tmp_path / "other")

    def continue_and_lose(task):
        found.append(Path("checkpoint.npz").read_bytes())
        Path("checkpoint.npz").write_bytes(b"three")
        lose(task)

    found = []
    monkeypatch.setattr(bucket_job.job_process, "compress", training([], continue_and_lose))
    with pytest.raises(StorageAccessError):
        bucket_job.compress(task_of(place_of(job)), silent)
    assert found == [b"two"]
    assert bucket.get(key) == b"three"  # stored at the end, because the job is started again


@pytest.mark.parametrize("change", ["removed", "larger", "smaller"])
def test_a_checkpoint_that_another_start_has_changed(bucket, new_job, place_of, node, monkeypatch, change):
    """Nodes that were given up may store checkpoints while the next start fetches them."""
    job = new_job(TRAINED)
    first, second = (f"jobs/{job.id}/{name}" for name in CHECKPOINT_FILES)
    bucket.put(first, b"0123456789")
    bucket.put(second, b"0123456789")
    task = task_of(place_of(job))
    match change:
        case "removed":
            bucket.delete(second)
        case "larger":
            bucket.put(second, b"0123456789+")
        case "smaller":
            bucket.put(second, b"012345678")

    def compress(task, progress):
        found.append([path.name for path in node.iterdir()])
        raise kissgs.InvalidSceneError("enough")

    found = []
    monkeypatch.setattr(bucket_job.job_process, "compress", compress)
    with pytest.raises(kissgs.InvalidSceneError):
        bucket_job.compress(task, silent)
    assert found == [["scene.ply"]]


def test_training_continues_from_a_stored_checkpoint(bucket, new_job, place_of, node, tmp_path, monkeypatch):
    pytest.importorskip("torch")
    from kissgs.training import checkpoint

    options = {"preset": "fast", "compact": {**TRAINED["compact"], "views": 24, "view_size": 48}}
    job = new_job(options)
    monkeypatch.setattr(checkpoint, "SAVE_INTERVAL", 0.0)
    monkeypatch.setattr(checkpoint.Checkpoint, "due", property(lambda self: True))

    def stop(stage, fraction, note=""):
        if stage == "refine" and fraction > 0.3:
            raise StorageAccessError("the network is gone")

    with pytest.raises(StorageAccessError):
        bucket_job.compress(task_of(place_of(job)), stop)
    assert names(bucket, job) == ["checkpoint.npz", "scene.ply"]
    (tmp_path / "other").mkdir()
    monkeypatch.chdir(tmp_path / "other")
    place, stages = place_of(job), []
    bucket_job.compress(task_of(place), lambda stage, fraction, note="": stages.append(stage))
    assert "refine" in stages
    assert "sparsify" not in stages
    expected = kissgs.compress(SMALL, settings=kissgs.Settings.model_validate(options)).to_zip()
    assert bucket.get(f"jobs/{job.id}/{place.folder}/scene.zip") == expected


# What the service makes of it ----------------------------------------------------------------------------------------


class Recorder:
    """A runner that records items and gives each the same outcome."""

    def __init__(self, outcome):
        self.items, self.outcome = [], outcome

    def submit(self, item, progress):
        self.items.append(item)
        future = Future()
        future.set_result(self.outcome)
        return RunHandle("1", future)

    def cancel(self, item_id):
        pass


async def ignore(stage, fraction, note):
    pass


@pytest.mark.parametrize(
    ("code", "expected"), [("storage", "cannot use the storage"), ("disk-full", "have no disk space")]
)
def test_a_node_that_cannot_work_leads_to_another_start(new_job, place_of, code, expected):
    runner = Recorder(ItemOutcome("error", code=code, message="http://host/key?X-Amz-Signature=secret"))
    settings = ServiceSettings(job_threads=1)
    task = place_of(new_job()).task()
    outcome = asyncio.run(JobRunner(settings, runner, runner).process().run(task, ignore))
    assert (outcome.kind, outcome.data["code"]) == ("lost", code)
    assert expected in outcome.data["detail"]
    assert "secret" not in str(outcome)
    (item,) = runner.items
    assert item.function == f"service.jobs.{COMPRESS_IN_BUCKET}"
    assert item.folder is None
    assert WorkItem.from_dict(json.loads(json.dumps(item.as_dict()))) == item
    assert isinstance(outcome, Outcome)


@pytest.mark.parametrize(("seconds", "expected"), [(3600, 3600 + 86_400), (10 * 86_400, 7 * 86_400)])
def test_addresses_are_valid_for_the_time_limit_and_a_day(storage, new_job, seconds, expected):
    settings = ServiceSettings(runner="ray", job_seconds=seconds)
    task = workplace.workplace(settings, storage, new_job(TRAINED)).task()
    addresses = [task["scene"]["url"], *task["store"].values()]
    assert {re.search("X-Amz-Expires=([0-9]+)", address)[1] for address in addresses} == {str(expected)}
    assert set(task["store"]) == {
        *(f"result/{name}" for name in ("scene.zip", "report.json", "summary.json")),
        *(f"result/files/{name}" for name in SOGXT_FILES),
        *CHECKPOINT_FILES,
    }


def test_such_a_job_is_started_again_and_fails_with_the_reason_at_last(tmp_path, no_variables):
    with service(tmp_path / "data") as context:
        job_id = add_a_job(context)
        limit = context.settings.job_starts
        for start in range(1, limit + 1):
            job = context.store.claim()
            assert (job.id, job.starts) == (job_id, start)
            place = workplace.workplace(context.settings, context.storage, job)
            lost = Outcome("lost", {"code": "storage", "detail": "no machine can use the storage"})
            asyncio.run(context.worker._finish(job, lost, place))
        ended = context.store.get(job_id)
        assert (ended.state, ended.problem["code"]) == (State.FAILED, "storage")
        assert ended.problem["retryable"]
