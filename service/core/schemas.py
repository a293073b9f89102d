"""Request and response models of the REST interface; OpenAPI is generated from them."""

from __future__ import annotations

from datetime import datetime
from typing import Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError

import kissgs
from kissgs.formats import CONTAINERS

from .files import DEFAULT, Format
from .models import NOTE_CHARS, State
from .problems import Problem

COMPACTED = "+compact"
FINETUNED = "+finetune"
SEARCHED = "+search"
CAPTURED = "+photos"
TIMED = "+time"  # suffixes of the preset's name in kind

_GROUPS: dict[str, type[BaseModel]] = {
    "compact": kissgs.CompactSettings,
    "encode": kissgs.EncodeSettings,
    "finetune": kissgs.FinetuneSettings,
}

REFERENCE = "^sha256:[0-9a-f]{64}$"  # of a capture


class JobOptions(kissgs.Settings):
    """Compression options: a preset, and settings that replace single values of it."""

    model_config = ConfigDict(
        title="JobOptions",
        json_schema_extra={
            "examples": [
                {"preset": "balanced"},
                {"preset": "fast", "encode": {"seed": 7}},
                {"compact": {"ratio": 0.2}},
                {"finetune": {"enabled": True}},
                {"encode": {"target_size": 3_000_000}, "time_limit": 120},
                {"format": "sog"},
                {"format": "spz"},
                {"encode": {"max_psnr_drop": 0.1}, "capture": f"sha256:{'0' * 64}"},
            ]
        },
    )

    format: Format = Field(
        DEFAULT,
        description="Format of the result: the container sogxt (.zip) or sog (SOG version 2); or spz or "
        "compressed.ply, which hold the scene as it is: they go with no goal, time limit or training.",
    )
    evaluate: bool = Field(
        False, description="Also render both scenes and compare the images (PSNR, SSIM, MS-SSIM), which takes longer."
    )

    origin: Literal["auto"] | None = Field(
        None,
        description="auto: make positions relative to the middle of the scene, where containers have the finest steps, "
        "and record it; by default as in the file. For scenes far from the origin.",
    )

    capture: str | None = Field(
        None,
        pattern=REFERENCE,
        description="Capture of the scene, its cameras and photographs: the SHA-256 of the archive that the field "
        "`capture` of a form has, or had for an earlier job whose upload is still kept.",
    )
    force_views: bool = Field(False, description="Accept a capture whose photographs do not show the scene.")

    @classmethod
    def stored(cls, options: dict[str, Any]) -> Self:
        """Return the options of a job in the database. Older versions took values that belong to the preset now, had
        others in presets and some that are gone, and a preset "small", a coarser "balanced"."""
        if options.get("preset") == "small":
            options = {**options, "preset": kissgs.Preset.BALANCED}
        try:
            return cls.model_validate({"for_research": True, **options})
        except ValidationError:
            known = {
                group: {name: value for name, value in options.get(group, {}).items() if name in model.model_fields}
                for group, model in _GROUPS.items()
            }
            return cls.model_validate({**options, **known, "for_research": True})

    @property
    def kind(self) -> str:
        """Preset, further stages and whether time is limited: with the scene, they determine the duration. A conversion
        takes about as long as the preset fast."""
        preset = self.preset if self.format in CONTAINERS else kissgs.Preset.FAST
        stages = {
            COMPACTED: self.compact.enabled,
            FINETUNED: bool(self.finetune.enabled),
            SEARCHED: self.searches,
            CAPTURED: self.capture is not None,
            TIMED: self.time_limit is not None,
        }
        return "".join([preset, *(suffix for suffix, wanted in stages.items() if wanted)])

    @property
    def retrains(self) -> bool:
        """Whether compaction trains the remaining Gaussians on renderings of the scene."""
        return self.compact.enabled and self.compact.trains

    @property
    def trains(self) -> bool:
        """Whether compaction or fine-tuning trains, which needs torch."""
        return self.retrains or bool(self.finetune.enabled)

    @property
    def resumable(self) -> bool:
        """Whether training can resume from a checkpoint. Searches, which train several times, cannot resume."""
        tunes_once = bool(self.finetune.enabled) and not self.encode.has_goal
        compacts_once = self.compact.max_psnr_drop is None and not self.compact.auto_count and self.time_limit is None
        return compacts_once and (self.retrains or tunes_once)


class ApiModel(BaseModel):
    """Base class of all response models."""

    model_config = ConfigDict(frozen=True)


class Progress(ApiModel):
    """Progress of a running job, as the library reports it."""

    stage: str = Field(description="Name of the current stage.", examples=["codebook"])
    fraction: float = Field(
        ge=0, le=1, description="Completed fraction of the job, from 0 to 1; starts again when the job does."
    )
    note: str | None = Field(
        None,
        max_length=NOTE_CHARS,
        description="State of the training as text; absent in stages that do not train.",
        examples=["15,890 Gaussians, loss 0.0123, PSNR 31.20"],
    )


class Estimate(ApiModel):
    """Estimated time of completion, from the progress of the job, and before from those with the same preset."""

    seconds_left: float = Field(
        ge=0,
        description="Estimated seconds until the result is available, including the time in the queue; 0 where it "
        "takes longer than estimated.",
    )
    ready_at: datetime = Field(description="Estimated time at which the result is available.")


class Timings(ApiModel):
    """Times and durations of a job."""

    created_at: datetime
    started_at: datetime | None = Field(None, description="Time of the latest start.")
    finished_at: datetime | None = None
    queue_seconds: float | None = Field(None, description="Seconds from upload to start.")
    run_seconds: float | None = Field(None, description="Seconds from start to end, or until now.")
    stages: dict[str, float] | None = Field(None, description="Wall-clock seconds of each stage.")
    cpu_seconds: float | None = Field(None, description="CPU seconds of all threads.")


class Sizes(ApiModel):
    """Sizes of the result in bytes."""

    container: int
    files: dict[str, int] = Field(description="Bytes of each file inside the container, where text files are deflated.")
    ratio: float = Field(description="Upload bytes divided by container bytes.")
    bytes_per_gaussian: float = Field(description="Container bytes per Gaussian of the upload.")


class Links(ApiModel):
    """Paths of related resources on this server; only those that are available now."""

    self: str
    events: str
    cancel: str | None = None
    result: str | None = None
    files: str | None = Field(None, description="Template: replace {name} by a name from sizes.files.")
    thumbnail: str | None = None
    decoded: str | None = None
    source: str | None = None
    report: str | None = None
    preview: str | None = Field(None, description="Page that shows the container in the browser.")


class JobStatus(ApiModel):
    """Complete status of a job."""

    id: str
    name: str = Field(description="Name of the uploaded scene.")
    state: State
    position: int | None = Field(None, ge=1, description="Position in the queue; 1 is next.")
    progress: Progress | None = None
    estimate: Estimate | None = None
    options: JobOptions
    upload_bytes: int = Field(description="Size of the upload in bytes.")
    source_format: str | None = Field(None, description="Format of the upload, once the job has succeeded.")
    gaussians: int = Field(description="Number of Gaussians in the upload.")
    sh_degree: int = Field(ge=0, le=3)
    kept: int | None = Field(None, description="Number of Gaussians in the container.")
    compacted: int | None = Field(None, description="Number of Gaussians removed by compaction.")
    invisible: int | None = Field(None, description="Number of Gaussians removed because no renderer would draw them.")
    cleaned: dict[str, int] | None = Field(
        None, description="Number of invalid values repaired in the upload, by kind."
    )
    evaluation: dict[str, Any] | None = Field(
        None,
        description="PSNR, SSIM and MS-SSIM against renderings of the upload, from cameras sampled over the whole "
        "scene: means, the worst view and its camera position, the fifth percentile of PSNR, changes of SSIM in "
        "patches (detail), and the share of the scene that the views show. A PSNR of null is infinite. With a capture "
        "whose photographs are held out, from their cameras, and also the metrics of the upload's (reference) and of "
        "the container's renderings (candidate) to these photographs.",
    )
    finetuning: dict[str, Any] | None = Field(
        None, description="PSNR and bytes before and after fine-tuning, and whether its result was kept."
    )
    note: str | None = Field(
        None, description="What may surprise about the result, such as another preset because time was limited."
    )
    sizes: Sizes | None = None
    timings: Timings
    starts: int = Field(description="Number of starts; more than one after a crash or a restart of the service.")
    problem: Problem | None = None
    links: Links
    expires_at: datetime | None = Field(None, description="Time at which the result is removed.")


class JobPage(ApiModel):
    """One page of jobs, newest first."""

    jobs: list[JobStatus]
    next: str | None = Field(None, description="Cursor of the next page; null on the last.")


class Limits(ApiModel):
    """Limits of the service; null means no limit."""

    formats: list[str] = Field(description="Supported formats of uploads.")
    containers: list[Format] = Field(description="Formats of results, for the option `format`.")
    max_upload_bytes: int
    max_capture_bytes: int
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
        description="Whether the server has torch. Without it, it cannot fine-tune, and compacts only with the method "
        "merge, that of the preset fast."
    )


class PresetFacts(ApiModel):
    """A preset, its settings, and its size, quality and time measured on a captured scene."""

    name: kissgs.Preset
    title: str
    description: str
    settings: dict[str, Any] = Field(description="All values of the preset; options change what JobOptions lists.")
    bytes_per_gaussian: float = Field(
        description="Container bytes per Gaussian, measured on the scene that `measured_on` names."
    )
    psnr_change: float = Field(
        description="Change of PSNR against held-out photographs, relative to the upload, in dB."
    )
    cpu_seconds_per_million: float = Field(
        description="CPU seconds to encode a million Gaussians, summed over both cores of a small server."
    )


class Presets(ApiModel):
    """All presets, and the scene and command behind their figures."""

    default: kissgs.Preset
    measured_on: str = Field(description="Scene on which the figures were measured.")
    measured_by: str = Field(description="Commands that measured the figures.")
    presets: list[PresetFacts]


class ProblemKind(ApiModel):
    """Problem code with its status, title and retryability."""

    code: str
    status: int
    title: str
    retryable: bool


class Version(ApiModel):
    """Versions of the library and of the interface, and the default container format."""

    kissgs: str
    api: str
    container: str


class Health(ApiModel):
    """Readiness of the service and of each part."""

    ready: bool
    checks: dict[str, str] = Field(description='State of each part: "ok", or the error.')
