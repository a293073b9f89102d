"""Jobs and files of replicas that run without HTTP, in the process of the test."""

import json

from helpers.job_rows import job as job_row


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


def result_in(context, job_id):
    """Store a result; return it as the worker reads it, and its folder."""
    folder = write_result(context, job_id)
    return context.storage.read_result(job_id, folder, "scene.zip"), folder


def add_job(context):
    """Add a queued job as a submission does; return its id."""
    context.store.take_claim(job_id := f"{len(context.store.ids()):032x}")
    upload = context.storage.new_upload()
    upload.write_bytes(b"ply")
    context.storage.adopt(upload, job_id)
    row = job_row(disk_bytes=3, upload_bytes=3)
    row.id = job_id
    context.admission.add(row)
    return job_id


def files_of_job(bucket, job_id):
    """Return the names of a job's files in the bucket."""
    return sorted(key.split("/", 2)[2] for key in bucket.names() if key.startswith(f"jobs/{job_id}/"))
