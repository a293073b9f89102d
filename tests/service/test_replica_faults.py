"""Replicas with wrong settings, or whose bucket fails. Oracle: the messages, and what is stored before and after."""

import pytest
from helpers.data_folders import add_a_job, command
from helpers.replica_members import add_job
from helpers.running import wait_until
from helpers.s3_server import CREDENTIALS, S3Server
from helpers.service import FAST, SMALL, Replicas, problem

from service.core.settings import ServiceSettings, SettingsError
from service.http.app import build

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
    add_job(first)
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


def test_an_emptied_bucket(two, bucket):
    job = two.ended(two.submit())
    number = bucket.get("identity")
    bucket.delete("identity")
    for replica in two.replicas:
        wait_until(lambda replica=replica: replica.http.get("/readyz").status_code != 200)
        assert "was emptied or replaced" in replica.http.get("/readyz").json()["checks"]["disk"]
    for _ in range(2):
        problem(two.http.post("/v1/jobs", content=SMALL, params={"options": FAST}), 503, "storage")
    bucket.put("identity", number)
    for replica in two.replicas:
        wait_until(lambda replica=replica: replica.http.get("/readyz").status_code == 200)
    assert two.result(two.submit()) == two.http.get(job["links"]["result"]).content


def test_a_bucket_that_cannot_be_reached(tmp_path, new_database):
    with S3Server(tmp_path) as server, Replicas(tmp_path / "one", 1, server.bucket(), new_database()) as it:
        job = it.ended(it.submit())
        server.process.kill()
        wait_until(lambda: it.http.get("/readyz").status_code != 200)
        assert f"{server.url} cannot be reached" in it.http.get("/readyz").json()["checks"]["disk"]
        problem(it.http.post("/v1/jobs", content=SMALL, params={"options": FAST}), 503, "storage")
        problem(it.http.get(job["links"]["report"]), 503, "storage")
        assert it.status(job)["state"] == "succeeded"
        assert CREDENTIALS["AWS_SECRET_ACCESS_KEY"] not in it.log.read_text()


def test_a_file_that_vanishes(two, bucket):
    job = two.ended(two.submit())
    row = [key for key in bucket.names() if key.endswith("scene.zip")]
    bucket.delete(row[0])
    problem(two.http.get(job["links"]["result"]), 410, "gone")
