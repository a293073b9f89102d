"""kissgs: 3D Gaussian Splatting scenes as SOG-XT containers of a few megabytes that any browser can open.

>>> import kissgs
>>> result = kissgs.compress("scene.ply", "scene.zip")
>>> splats = kissgs.decompress("scene.zip")
"""

from __future__ import annotations

from kissgs._version import __version__

TYPE_CHECKING = False  # without typing, which takes longer to import than all of this
if TYPE_CHECKING:
    from kissgs.cameras.captures.load import load_views
    from kissgs.cameras.views import View, Views
    from kissgs.cameras.virtual.select import virtual_views
    from kissgs.client import Remote
    from kissgs.compaction.result import Compacted, CompactionReport
    from kissgs.core.context import Progress
    from kissgs.core.errors import (
        Cancelled,
        InvalidContainerError,
        InvalidSceneError,
        InvalidViewsError,
        KissgsError,
        OutputError,
        RemoteError,
        RunnerError,
        StopSearch,
        UnsupportedError,
    )
    from kissgs.core.sensitivity import Sensitivity
    from kissgs.core.splats import Splats, clean
    from kissgs.evaluation.evaluate import evaluate
    from kissgs.evaluation.results import Evaluation
    from kissgs.finetuning.result import FinetuneReport
    from kissgs.io.ply import PlyInfo, read_ply_info
    from kissgs.io.scene_format import ReadOptions
    from kissgs.pipeline.pipeline import Compressed, Report, compact, compress
    from kissgs.pipeline.scene_files import SceneInfo, decompress, load, read_scene_info, recognise, save
    from kissgs.rendering.camera import Camera
    from kissgs.rendering.rasterizer import render
    from kissgs.rendering.sensitivity import WeightedCameras, measure_sensitivity
    from kissgs.settings import CompactSettings, EncodeSettings, FinetuneSettings, Preset, Settings
    from kissgs.streaming.compress import StreamedReport, compress_streamed
    from kissgs.synthetic import sample_scene

_NAMES = {
    "cameras.captures.load": "load_views",
    "cameras.views": "View Views",
    "cameras.virtual.select": "virtual_views",
    "client": "Remote",
    "compaction.result": "Compacted CompactionReport",
    "core.context": "Progress",
    "core.errors": "Cancelled InvalidContainerError InvalidSceneError InvalidViewsError KissgsError OutputError "
    "RemoteError RunnerError StopSearch UnsupportedError",
    "core.sensitivity": "Sensitivity",
    "core.splats": "Splats clean",
    "evaluation.evaluate": "evaluate",
    "evaluation.results": "Evaluation",
    "finetuning.result": "FinetuneReport",
    "io.ply": "PlyInfo read_ply_info",
    "io.scene_format": "ReadOptions",
    "pipeline.pipeline": "Compressed Report compact compress",
    "pipeline.scene_files": "SceneInfo decompress load read_scene_info recognise save",
    "rendering.camera": "Camera",
    "rendering.rasterizer": "render",
    "rendering.sensitivity": "WeightedCameras measure_sensitivity",
    "settings": "CompactSettings EncodeSettings FinetuneSettings Preset Settings",
    "streaming.compress": "StreamedReport compress_streamed",
    "synthetic": "sample_scene",
}
_HOMES = {name: module for module, names in _NAMES.items() for name in names.split()}

__all__ = [
    "Camera",
    "Cancelled",
    "CompactSettings",
    "Compacted",
    "CompactionReport",
    "Compressed",
    "EncodeSettings",
    "Evaluation",
    "FinetuneReport",
    "FinetuneSettings",
    "InvalidContainerError",
    "InvalidSceneError",
    "InvalidViewsError",
    "KissgsError",
    "OutputError",
    "PlyInfo",
    "Preset",
    "Progress",
    "ReadOptions",
    "Remote",
    "RemoteError",
    "Report",
    "RunnerError",
    "SceneInfo",
    "Sensitivity",
    "Settings",
    "Splats",
    "StopSearch",
    "StreamedReport",
    "UnsupportedError",
    "View",
    "Views",
    "WeightedCameras",
    "__version__",
    "clean",
    "compact",
    "compress",
    "compress_streamed",
    "decompress",
    "evaluate",
    "load",
    "load_views",
    "measure_sensitivity",
    "read_ply_info",
    "read_scene_info",
    "recognise",
    "render",
    "sample_scene",
    "save",
    "virtual_views",
]


def __getattr__(name: str) -> object:
    """Import a public name when it is first used, so that ``import kissgs`` costs nothing."""
    if name not in _HOMES:
        raise AttributeError(f"module 'kissgs' has no attribute {name!r}")
    import importlib

    value = getattr(importlib.import_module(f"kissgs.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
