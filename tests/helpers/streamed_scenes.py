"""Streamed scenes of both kinds of containers, made by hand around containers, and the leaves of a manifest."""

from collections.abc import Callable
from dataclasses import dataclass

import pytest

import kissgs
from helpers.reference_sog import sog_files, sog_folder, streamed_files
from kissgs import Settings
from kissgs.sog.decode import STREAMED as SOG_FORMAT
from kissgs.sog.decode import decode as decode_sog
from kissgs.sogxt.decode import STREAMED as SOGXT_FORMAT
from kissgs.sogxt.decode import decode as decode_sogxt
from kissgs.streaming import build

ALL = Settings.research("fast", prune_invisible=False)
FAST = Settings.from_preset("fast")


def sogxt_zip(scene, name):
    """Return a zip with every Gaussian of a scene, and its file in a manifest."""
    return {f"{name}.zip": kissgs.compress(scene, settings=ALL).to_zip()}, f"{name}.zip"


@dataclass(frozen=True)
class Kind:
    """A kind of streamed scenes: its format, manifest, reader, containers, and the reader of a single container."""

    format: str
    manifest: str
    decode: Callable
    container: Callable
    decode_one: Callable

    def files(self, levels, *, environment=None):
        return streamed_files(levels, environment=environment, container=self.container, manifest=self.manifest)


SOG = Kind("streamed-sog", "lod-meta.json", SOG_FORMAT.decode, sog_folder, lambda scene: decode_sog(sog_files(scene)))
SOGXT = Kind(
    "streamed-sogxt",
    "levels.json",
    SOGXT_FORMAT.decode,
    sogxt_zip,
    lambda scene: decode_sogxt(sogxt_zip(scene, "")[0][".zip"]),
)
KINDS = {kind.format: kind for kind in (SOG, SOGXT)}

TARGETS = ("city/lod-meta.json", "city.sogxt/levels.json")
"""Manifests to write, one of each kind."""


class Stop(Exception):
    """Raised by a test's progress callback to interrupt the work."""


def tree_leaves(node):
    """Return the leaves of a manifest's tree."""
    return [node] if "lods" in node else [leaf for child in node["children"] for leaf in tree_leaves(child)]


def small_sizes(patch, *, chunk, leaf, coarsest):
    """Make chunks, leaves and coarsest levels of so few Gaussians that small scenes have several of each."""
    for name, value in {"CHUNK": chunk, "LEAF": leaf, "COARSEST": coarsest}.items():
        patch.setattr(build, name, value)


def write_small(splats, target, *, chunk, leaf, coarsest):
    """Write a streamed scene of several small chunks and leaves by way of a ``scene.ply`` beside its folder."""
    kissgs.save(splats, target.parents[1] / "scene.ply")
    with pytest.MonkeyPatch.context() as patch:
        small_sizes(patch, chunk=chunk, leaf=leaf, coarsest=coarsest)
        kissgs.compress_streamed(target.parents[1] / "scene.ply", target, settings=FAST)


def saved_sample(tmp_path_factory, count, sh_degree):
    """Return the path of a sample scene in a new folder."""
    path = tmp_path_factory.mktemp("streamed") / "scene.ply"
    kissgs.save(kissgs.sample_scene(count, sh_degree=sh_degree, seed=3), path)
    return path


def files_of(folder):
    """Return the bytes of all files below a folder, by their paths within it."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}
