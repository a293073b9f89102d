"""Names of files: of uploads, of checkpoints, and of the containers that jobs make."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

Format = Literal["sogxt", "sog"]
"""Names of the library's containers."""

DEFAULT: Format = "sogxt"


@dataclass(frozen=True, slots=True)
class ContainerFile:
    """Ending, media type and content of a container.

    Attributes:
        ending: ending of the file's name.
        contents: names of all files that it may have.
        media_type: type of the response. A ``.sog`` is a zip as well, but some browsers unpack what is called a zip, or
            change the ending of its name; SOG has no registered type of its own.
    """

    ending: str
    media_type: str
    contents: tuple[str, ...]

    @property
    def name(self) -> str:
        """Name of the file in the folder of a result."""
        return f"scene{self.ending}"


CONTAINER_FILES: dict[Format, ContainerFile] = {
    "sogxt": ContainerFile(
        ".zip",
        "application/zip",
        (
            *("container_meta.yaml", "meta.json", "scene.json", "active_mask.webp"),
            *("means_bytes_0.webp", "means_bytes_1.webp", "opacities.webp", "scales.webp", "quaternions.webp"),
            *("f_dc.webp", "f_rest_labels.webp", "f_rest_centroids.webp"),
        ),
    ),
    "sog": ContainerFile(
        ".sog",
        "application/octet-stream",
        (
            *("meta.json", "means_l.webp", "means_u.webp", "quats.webp", "scales.webp", "sh0.webp"),
            *("shN_centroids.webp", "shN_labels.webp"),
        ),
    ),
}

UPLOAD_FILES = ("scene.ply", "scene.sog", "scene.spz", "scene.splat", "scene.ksplat", "scene.glb")
"""Names of a job's upload, of which it has one: the ending tells formats that are not recognised by their content."""

CHECKPOINT_FILES = ("checkpoint.npz", "checkpoint-finetune.npz")
"""Names of checkpoints: of compaction, or of fine-tuning alone, and of fine-tuning after compaction."""


def container_file(options: dict[str, Any]) -> ContainerFile:
    """Return the container's file for the stored options of a job; jobs without a format made SOG-XT."""
    return CONTAINER_FILES[options.get("format", DEFAULT)]
