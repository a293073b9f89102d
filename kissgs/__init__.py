"""kissgs: 3D Gaussian Splatting scenes as SOG-XT containers of a few megabytes that any browser can open.

>>> import kissgs
>>> result = kissgs.compress("scene.ply", "scene.zip")
>>> splats = kissgs.decompress("scene.zip")
"""

from __future__ import annotations

from kissgs._version import __version__

TYPE_CHECKING = False  # without typing, which takes longer to import than all of this
if TYPE_CHECKING:
    from kissgs.compaction.result import Compacted, CompactionReport
    from kissgs.errors import (
        Cancelled,
        Enough,
        InvalidContainerError,
        InvalidSceneError,
        InvalidViewsError,
        KissgsError,
        OutputError,
        RemoteError,
        UnsupportedError,
    )
    from kissgs.evaluation.likeness import Evaluation
    from kissgs.evaluation.pictures import evaluate
    from kissgs.finetuning.result import FinetuneReport
    from kissgs.importance import Importance
    from kissgs.io.ply import PlyInfo, read_ply_info
    from kissgs.pipeline import Compressed, compact, compress, decompress
    from kissgs.progress import Progress
    from kissgs.remote import Remote
    from kissgs.rendering.camera import Camera
    from kissgs.rendering.importance import Watch, measure_importance
    from kissgs.rendering.rasterizer import render
    from kissgs.report import Report
    from kissgs.sample import sample_scene
    from kissgs.scenes import load, save
    from kissgs.settings import CompactSettings, EncodeSettings, FinetuneSettings, Preset, Settings
    from kissgs.splats import Splats, clean
    from kissgs.views.load import load_views
    from kissgs.views.view import View, Views
    from kissgs.views.virtual import virtual_views

_HOMES = {
    "Camera": "rendering.camera",
    "Cancelled": "errors",
    "CompactSettings": "settings",
    "Compacted": "compaction.result",
    "CompactionReport": "compaction.result",
    "Compressed": "pipeline",
    "EncodeSettings": "settings",
    "Enough": "errors",
    "Evaluation": "evaluation.likeness",
    "FinetuneReport": "finetuning.result",
    "FinetuneSettings": "settings",
    "Importance": "importance",
    "InvalidContainerError": "errors",
    "InvalidSceneError": "errors",
    "InvalidViewsError": "errors",
    "KissgsError": "errors",
    "OutputError": "errors",
    "PlyInfo": "io.ply",
    "Preset": "settings",
    "Progress": "progress",
    "Remote": "remote",
    "RemoteError": "errors",
    "Report": "report",
    "Settings": "settings",
    "Splats": "splats",
    "UnsupportedError": "errors",
    "View": "views.view",
    "Views": "views.view",
    "Watch": "rendering.importance",
    "clean": "splats",
    "compact": "pipeline",
    "compress": "pipeline",
    "decompress": "pipeline",
    "evaluate": "evaluation.pictures",
    "load": "scenes",
    "load_views": "views.load",
    "measure_importance": "rendering.importance",
    "read_ply_info": "io.ply",
    "render": "rendering.rasterizer",
    "sample_scene": "sample",
    "save": "scenes",
    "virtual_views": "views.virtual",
}

__all__ = [
    "Camera",
    "Cancelled",
    "CompactSettings",
    "Compacted",
    "CompactionReport",
    "Compressed",
    "EncodeSettings",
    "Enough",
    "Evaluation",
    "FinetuneReport",
    "FinetuneSettings",
    "Importance",
    "InvalidContainerError",
    "InvalidSceneError",
    "InvalidViewsError",
    "KissgsError",
    "OutputError",
    "PlyInfo",
    "Preset",
    "Progress",
    "Remote",
    "RemoteError",
    "Report",
    "Settings",
    "Splats",
    "UnsupportedError",
    "View",
    "Views",
    "Watch",
    "__version__",
    "clean",
    "compact",
    "compress",
    "decompress",
    "evaluate",
    "load",
    "load_views",
    "measure_importance",
    "read_ply_info",
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
