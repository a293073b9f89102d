"""Checkpoint of a compaction: the key that identifies the work, and the status beside the state of the training."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

import numpy as np

from kissgs._version import __version__
from kissgs.cameras.captures.files import open_file
from kissgs.compaction.result import CompactionStep
from kissgs.core.splats import ATTRIBUTES, Splats
from kissgs.rendering.rasterizer import Device
from kissgs.settings import CompactSettings
from kissgs.training.supervision import SupervisionViews

State = Mapping[str, np.ndarray]
"""Arrays of a checkpoint by name."""

STATUS_ENTRY = "status"
"""Name of the array that holds the status as JSON; part of the file format."""


@dataclass(frozen=True, slots=True)
class Status:
    """Progress of a compaction.

    Attributes:
        phase: number of the current phase of training; the number of phases once all are done.
        done: number of steps done in this phase.
        seconds: wall time since the last recorded step, seconds.
        steps: recorded steps.
    """

    phase: int
    done: int
    seconds: float
    steps: Sequence[CompactionStep]

    def as_state(self) -> State:
        """Return the status as an array for the checkpoint, see :meth:`from_state`."""
        return {STATUS_ENTRY: np.frombuffer(json.dumps(asdict(self)).encode(), np.uint8)}

    @classmethod
    def from_state(cls, state: State) -> Status:
        """Return the status in a checkpoint."""
        values = json.loads(state[STATUS_ENTRY].tobytes())
        return cls(**{**values, "steps": [CompactionStep(**step) for step in values["steps"]]})


def work_key(
    scenes: Sequence[Splats],
    count: int,
    settings: CompactSettings,
    supervision: SupervisionViews,
    evaluate: bool,
    device: Device,
) -> str:
    """Return the key of the work's checkpoint: equal only for equal results.

    Args:
        scenes: the scene and the original scene.
        count: number of Gaussians to keep.
        settings: settings of compaction.
        supervision: all views; their photographs are read.
        evaluate: whether steps are evaluated; a report without evaluations cannot be completed later.
        device: device of the training.

    Raises:
        InvalidViewsError: a photograph cannot be read.
    """
    text = f"{__version__} {count} {evaluate} {device} {settings.model_dump_json()} {supervision.background} "
    key = hashlib.sha256(f"{text}{supervision.synthetic} {supervision.synthetic_per_epoch}".encode())
    for view in (*supervision.train, *supervision.score, *supervision.test):
        camera = view.camera
        key.update(camera.viewmat.tobytes() + camera.K.tobytes() + f"{camera.width} {camera.height}".encode())
        key.update(f"{camera.dilation} {view.background} {view.undistortion} {view.sampling}".encode())
        if view.photo is not None:
            with open_file(view.photo) as (file, _):
                key.update(file.read())
    for scene in scenes:
        for name in ATTRIBUTES:
            key.update(getattr(scene, name).tobytes())
        key.update(b"antialiased" * scene.antialiased)
    return key.hexdigest()
