"""What goes over the wire, as pydantic models: they are the OpenAPI document."""

from __future__ import annotations

from datetime import datetime
from typing import Any

from pydantic import BaseModel, ConfigDict, Field

import kissgs
from service.core.models import NOTE_CHARS, State
from service.core.problems import Problem

COMPACTED = "+compact"
TUNED = "+finetune"
SOUGHT = "+seek"
"""After the preset, in the kind of a job."""


class JobOptions(kissgs.Settings):
    """How to compress: a preset, and single settings of its stages replaced."""

    model_config = ConfigDict(
        title="JobOptions",
        json_schema_extra={
            "examples": [
                {"preset": "balanced"},
                {"preset": "small", "encode": {"seed": 7}},
                {"compact": {"ratio": 0.2}},
                {"finetune": {"enabled": True}},
            ]
        },
    )

    evaluate: bool = Field(False, description="Also render both scenes and compare the pictures (PSNR, SSIM); slower.")

    @property
    def kind(self) -> str:
        """What its duration depends on beside the scene: the preset, and what is done beside encoding it once."""
        stages = {
            COMPACTED: self.compact.enabled,
            TUNED: self.finetune.enabled,
            SOUGHT: self.searches,
        }
        return "".join([self.preset, *(suffix for suffix, wanted in stages.items() if wanted)])

    @property
    def retrains(self) -> bool:
        """Whether Gaussians that stay are to be fitted to pictures of the scene."""
        return self.compact.enabled and self.compact.trains

    @property
    def trains(self) -> bool:
        """Whether these are, or levels."""
        return self.retrains or self.finetune.enabled

    @property
    def resumable(self) -> bool:
        """Whether its training can be taken up where it was left: searches, which train several times, cannot."""
        tunes_once = self.finetune.enabled and not self.encode.has_goal
        compacts_once = self.compact.max_psnr_drop is None and not self.compact.auto_count
        return compacts_once and (self.retrains or tunes_once)


class Wire(BaseModel):
    """Of all answers."""

    model_config = ConfigDict(frozen=True)


class Progress(Wire):
    """Where a running job is, in the library's own words."""

    stage: str = Field(description="What is being done.", examples=["codebook"])
    fraction: float = Field(ge=0, le=1, description="Of that stage.")
    note: str | None = Field(
        None,
        max_length=NOTE_CHARS,
        description="For people: what training has come to. Other stages have none.",
        examples=["15,890 Gaussians, loss 0.0123, PSNR 31.20"],
    )


class Estimate(Wire):
    """When it will be done, judged by earlier jobs of the same preset. A guess, made anew at every look."""

    seconds_left: float = Field(ge=0, description="Until the result is there, waiting included.")
    ready_at: datetime = Field(description="The same as a time.")


class Timings(Wire):
    """What happened when."""

    created_at: datetime
    started_at: datetime | None = Field(None, description="Of the latest start.")
    finished_at: datetime | None = None
    queue_seconds: float | None = Field(None, description="From upload to start.")
    run_seconds: float | None = Field(None, description="From start to end, or until now.")
    stages: dict[str, float] | None = Field(None, description="Wall seconds of each stage.")
    cpu_seconds: float | None = Field(None, description="Of all threads.")


class Sizes(Wire):
    """What came out, in bytes."""

    container: int
    files: dict[str, int] = Field(description="Of each file, as the container has it: text is deflated there.")
    ratio: float = Field(description="Upload over container.")
    bytes_per_gaussian: float = Field(description="Of the container, per Gaussian of the upload.")


class Links(Wire):
    """Where to go from here: paths on this server, those that lead somewhere now."""

    self: str
    events: str
    cancel: str | None = None
    result: str | None = None
    files: str | None = Field(None, description="A template: put a name of sizes.files for {name}.")
    decoded: str | None = None
    source: str | None = None
    report: str | None = None
    preview: str | None = Field(None, description="A page that shows the container in the browser.")


class JobStatus(Wire):
    """All there is to know of a job."""

    id: str
    name: str = Field(description="Of the scene, as uploaded.")
    state: State
    position: int | None = Field(None, ge=1, description="In the queue; 1 is next.")
    progress: Progress | None = None
    estimate: Estimate | None = None
    options: JobOptions
    upload_bytes: int = Field(description="Of the upload.")
    gaussians: int = Field(description="In the upload.")
    sh_degree: int = Field(ge=0, le=3)
    kept: int | None = Field(None, description="Gaussians in the container.")
    compacted: int | None = Field(None, description="Gaussians left out by compaction, whose work others do.")
    invisible: int | None = Field(None, description="Gaussians left out because no renderer would draw them.")
    cleaned: dict[str, int] | None = Field(None, description="What was wrong with the upload and was mended, counted.")
    evaluation: dict[str, Any] | None = Field(
        None,
        description="PSNR and SSIM to the upload's own renderings from cameras drawn over the whole scene: means, the "
        "worst view and where its camera stands, the fifth percentile of PSNR, and the share of the scene that the "
        "views show. A PSNR of null is infinite.",
    )
    finetuning: dict[str, Any] | None = Field(
        None, description="What fine-tuning gave: PSNR and bytes before and after, and whether it was kept."
    )
    sizes: Sizes | None = None
    timings: Timings
    starts: int = Field(description="How often its work was begun: more than once after a crash or a restart.")
    problem: Problem | None = None
    links: Links
    expires_at: datetime | None = Field(None, description="When the result is removed.")


class JobPage(Wire):
    """Some jobs, newest first."""

    jobs: list[JobStatus]
    next: str | None = Field(None, description="Cursor of the next page; null on the last.")


class Limits(Wire):
    """What the service takes. null is no limit."""

    formats: list[str] = Field(description="Of uploads.")
    max_upload_bytes: int
    max_header_bytes: int
    max_gaussians: int
    max_sh_degree: int
    max_queue: int
    max_jobs_per_key: int | None
    max_uploads: int
    job_seconds: float
    job_memory_bytes: int
    keep_seconds: float
    sync_seconds: float
    max_wait_seconds: float
    keys_required: bool
    training: bool = Field(
        description="Whether anything can train here; if not, nothing is fine-tuned and only the preset fast compacts."
    )


class PresetFacts(Wire):
    """A point on the curve of speed, size and quality, with what it gave on a real scene."""

    name: kissgs.Preset
    title: str
    description: str
    settings: dict[str, Any] = Field(description="All of them.")
    bytes_per_gaussian: float = Field(description="Measured on the scene that `measured_on` names.")
    psnr_change: float = Field(description="Decibels, of renderings to held-out photographs, against the upload's.")
    cpu_seconds_per_million: float = Field(description="Encoding, both cores of a small server together.")


class Presets(Wire):
    """All presets, and where their figures come from."""

    default: kissgs.Preset
    measured_on: str = Field(description="The scene behind the figures.")
    measured_by: str = Field(description="The command that gave them.")
    presets: list[PresetFacts]


class ProblemKind(Wire):
    """A code and what it means."""

    code: str
    status: int
    title: str
    retryable: bool


class Version(Wire):
    """Which software this is."""

    kissgs: str
    api: str
    container: str


class Health(Wire):
    """Whether the service does its work, and which part does not."""

    ready: bool
    checks: dict[str, str] = Field(description='Of each part: "ok", or what is wrong.')
