"""Errors of a bucket, and what is read of it, with stand-ins for requests. Oracle: S3's documented codes."""

import json
import traceback

import pytest

pytest.importorskip("obstore")

from service.storage.job_objects import MAX_SUMMARY_BYTES, JobObjects
from service.storage.object_store import ObjectInfo, ObjectStore, ObjectStoreError

KEY_ID = "AKIAIOSFODNN7EXAMPLE"


def refusal(code):
    """Return an error as the library raises it, whose text has the answer of the storage."""
    return ValueError(f"status code: 403 Forbidden <Error><Code>{code}</Code><AWSAccessKeyId>{KEY_ID}</AWSAccessKeyId>")


@pytest.fixture
def store(monkeypatch):
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:1")
    return ObjectStore("s3://bucket")


@pytest.mark.parametrize(
    ("code", "expected"),
    [
        ("RequestTimeTooSkewed", "the clock of this machine is wrong"),
        ("AccessDenied", "access to the bucket 'bucket' at http://127.0.0.1:1 is denied"),
        ("SignatureDoesNotMatch", "does not accept the credentials"),
    ],
)
def test_one_sentence_and_no_key_in_the_log(store, code, expected):
    def request():
        raise refusal(code)

    with pytest.raises(ObjectStoreError, match=expected) as raised:
        store._try(request)
    assert KEY_ID not in "".join(traceback.format_exception(raised.value))


class Bucket:
    """A job's files in memory; it counts requests for content."""

    def __init__(self, files):
        self.contents, self.read = files, 0

    def files(self, folder):
        return [ObjectInfo(f"{folder}/{name}", len(content), 0.0) for name, content in self.contents.items()]

    def get_bytes(self, key):
        self.read += 1
        return self.contents[key.split("/", 2)[2]]


@pytest.mark.parametrize("extra", [0, 1])
def test_a_summary_of_any_size_is_not_read(extra):
    summary = {
        "container": {"bytes": 2}, "report": {"bytes": 2}, "files": {},
        "count": 1, "seconds": {}, "cpu_seconds": 1.0,
    }  # fmt: skip
    text = json.dumps(summary).encode().ljust(MAX_SUMMARY_BYTES + extra)
    contents = {"result-1/scene.zip": b"PK", "result-1/report.json": b"{}", "result-1/summary.json": text}
    bucket = Bucket(contents)
    found = JobObjects(bucket, "0" * 32).read_result("result-1", "scene.zip")
    assert found == (None if extra else summary)
    assert bucket.read == (0 if extra else 1)
