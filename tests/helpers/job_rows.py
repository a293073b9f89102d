"""Rows of the job table."""

import uuid

from service.core.models import Job


def job(owner="", **values):
    fixed = {
        "name": "scene",
        "options": {"preset": "fast"},
        "preset": "fast",
        "evaluate": False,
        "gaussians": 20_000,
        "sh_degree": 1,
        "upload_bytes": 5_000_000_000,
        "upload_sha256": "0" * 64,
        "fingerprint": "f",
        "disk_bytes": 3_000_000_000,
    }
    return Job(id=uuid.uuid4().hex, owner=owner, **{**fixed, **values})


def add(store, owner="", *, max_queue=10, max_owner=3, **values):
    return store.add(job(owner, **values), max_queue=max_queue, max_owner=max_owner)
