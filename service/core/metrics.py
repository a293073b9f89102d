"""Metrics that ``/metrics`` exposes to Prometheus."""

from __future__ import annotations

from functools import partial

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, Info, ProcessCollector
from prometheus_client.openmetrics.exposition import CONTENT_TYPE_LATEST, generate_latest

import kissgs

from .models import Job, State

CONTENT_TYPE = CONTENT_TYPE_LATEST

_SECONDS = (0.1, 0.25, 0.5, 1, 2.5, 5, 10, 30, 60, 120, 300, 600, 1800, 3600)


class Metrics:
    """All metrics of one service, in a separate registry."""

    def __init__(self) -> None:
        self.registry = r = CollectorRegistry()
        gauge, counter = partial(Gauge, registry=r), partial(Counter, registry=r)
        histogram, seconds = partial(Histogram, registry=r), partial(Histogram, registry=r, buckets=_SECONDS)
        ProcessCollector(registry=r)
        Info("kissgs_build", "Version of the software.", registry=r).info({"version": kissgs.__version__})
        self.queue_limit = gauge("kissgs_queue_limit", "Maximum number of waiting jobs.")
        self.jobs = gauge("kissgs_jobs", "Jobs by state.", ["state"])
        self.busy = gauge("kissgs_workers_busy", "Jobs with a running process.")
        self.disk = gauge("kissgs_disk_bytes", "Bytes on disk of the files of all jobs.")
        self.uploads = gauge("kissgs_uploads_in_flight", "Uploads in progress.")
        self.submitted = counter("kissgs_jobs_submitted", "Jobs accepted, by preset.", ["preset"])
        self.ended = counter("kissgs_jobs_ended", "Jobs ended, by state and code.", ["state", "code"])
        self.restarts = counter("kissgs_job_restarts", "Jobs restarted after a crash.")
        self.bytes_in = counter("kissgs_upload_bytes", "Bytes of accepted uploads.")
        self.bytes_out = counter("kissgs_container_bytes", "Bytes of encoded containers.")
        self.waited = seconds("kissgs_queue_seconds", "Seconds from upload to start.")
        self.ran = seconds("kissgs_job_seconds", "Seconds from start to end, by preset.", ["preset"])
        self.stages = seconds("kissgs_stage_seconds", "Seconds per stage of a job.", ["stage"])
        ratios = (2, 5, 8, 10, 12, 15, 20, 25, 30, 40, 60, 100)
        self.ratio = histogram("kissgs_ratio", "Upload bytes divided by container bytes.", buckets=ratios)
        rates = (1e3, 3e3, 1e4, 3e4, 1e5, 3e5, 1e6, 3e6)
        self.per_second = histogram("kissgs_gaussians_per_second", "Gaussians per second of a job.", buckets=rates)
        labels = ["method", "route", "status"]
        self.requests = counter("kissgs_http_requests", "Requests by method, route and status.", labels)
        text, times = "Seconds to the first byte of the response, by route.", (0.001, 0.0025, 0.005, 0.01, 0.025, 0.05)
        self.latency = histogram("kissgs_http_seconds", text, ["route"], buckets=(*times, 0.1, 0.25, 0.5, 1, 5, 30))

    def job_ended(self, job: Job, state: State, seconds: float | None) -> None:
        """Record a job that has ended after running for ``seconds``; None if it never started."""
        self.ended.labels(state, (job.problem or {}).get("code", "")).inc()
        if state != State.SUCCEEDED or job.result is None:
            return
        for stage, spent in job.result["seconds"].items():
            self.stages.labels(stage).observe(spent)
        self.bytes_out.inc(job.result["container"]["bytes"])
        self.ratio.observe(job.upload_bytes / job.result["container"]["bytes"])
        if seconds is not None:
            self.ran.labels(job.preset).observe(seconds)
            self.per_second.observe(job.gaussians / max(seconds, 1e-3))

    def text(self, counts: dict[State, int], disk_bytes: int) -> bytes:
        """Return the metrics in OpenMetrics format, with the gauges for jobs and disk set to these values."""
        for state, count in counts.items():
            self.jobs.labels(state).set(count)
        self.disk.set(disk_bytes)
        return bytes(generate_latest(self.registry))  # type: ignore[no-untyped-call]
