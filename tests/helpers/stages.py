"""Fractions of stages, for tests that stop work in the middle of one: receivers get those of whole jobs."""

from kissgs.core.context import JobProgress


def by_stages(monkeypatch):
    """Let jobs pass on the fraction of each stage, as they receive it."""

    def receive(job, stage, fraction, note=""):
        job._receive(stage, fraction, note, None)

    monkeypatch.setattr(JobProgress, "__call__", receive)
