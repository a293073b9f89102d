"""A server with the interface of Amazon S3, of the package moto, in a process of its own."""

from __future__ import annotations

import contextlib
import re
import shutil
import socket
import subprocess
import time
import uuid
from pathlib import Path

import httpx
import pytest

ROOT = Path(__file__).parents[2]

PROGRAM = "moto_server"

CREDENTIALS = {"AWS_ACCESS_KEY_ID": "test-id", "AWS_SECRET_ACCESS_KEY": "test-secret", "AWS_REGION": "us-east-1"}


def program() -> str | None:
    """Return the path of the server's program, which has an environment of its own (``make setup-s3``)."""
    return next(
        (found for place in (ROOT / ".venv-s3" / "bin", None) if (found := shutil.which(PROGRAM, path=place))), None
    )


class S3Server:
    """Server for use as ``with S3Server(folder) as server``, with files in memory."""

    def __init__(self, folder: Path) -> None:
        self.log = folder / "s3.log"
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = probe.getsockname()[1]
        self.url = f"http://127.0.0.1:{self.port}"

    def __enter__(self) -> S3Server:
        found = program()
        if found is None:
            pytest.skip(f"{PROGRAM} is not installed (make setup-s3)")
        with self.log.open("ab") as log:
            self.process = subprocess.Popen(
                [found, "-H", "127.0.0.1", "-p", str(self.port)], stdout=log, stderr=log, start_new_session=True
            )
        for _ in range(600):
            with contextlib.suppress(httpx.HTTPError):
                httpx.get(self.url, trust_env=False)
                return self
            if self.process.poll() is not None:
                break
            time.sleep(0.05)
        raise AssertionError(f"the S3 server did not start: {self.log.read_text()[-2000:]}")

    def __exit__(self, *error: object) -> None:
        self.process.kill()
        self.process.wait()

    def bucket(self) -> Bucket:
        """Create a bucket."""
        return Bucket(self.url, f"bucket-{uuid.uuid4().hex[:12]}")


class Bucket:
    """A bucket of the server, with a client that is independent of the service's."""

    def __init__(self, server: str, name: str) -> None:
        self.server, self.name = server, name
        self._http = httpx.Client(base_url=f"{server}/{name}", trust_env=False, headers={"Authorization": _SIGNED})
        assert self._http.put("", content=b"", headers={"Content-Type": "text/plain"}).status_code == 200

    @property
    def variables(self) -> dict[str, str]:
        """Variables of the environment of a service that uses the bucket."""
        return {
            "KISSGS_STORAGE": f"s3://{self.name}/a/prefix",
            "AWS_ENDPOINT_URL": self.server,
            **CREDENTIALS,
        }

    def names(self) -> list[str]:
        """Return all keys, without the prefix."""
        text = self._http.get("", params={"list-type": "2"}).text
        assert "<IsTruncated>true" not in text
        return [key.removeprefix("a/prefix/") for key in re.findall("<Key>([^<]*)</Key>", text)]

    def get(self, key: str) -> bytes:
        """Return the content of a key."""
        answer = self._http.get(f"/a/prefix/{key}")
        assert answer.status_code == 200, answer.text
        return answer.content

    def delete(self, key: str) -> None:
        """Remove a key."""
        self._http.delete(f"/a/prefix/{key}")

    def put(self, key: str, data: bytes) -> None:
        """Store a key."""
        assert self._http.put(f"/a/prefix/{key}", content=data).status_code == 200


_SIGNED = (
    "AWS4-HMAC-SHA256 Credential=test-id/20260101/us-east-1/s3/aws4_request, SignedHeaders=host, Signature=" + "0" * 64
)
"""A signature, which the server reads the name of the service from, but does not check."""
