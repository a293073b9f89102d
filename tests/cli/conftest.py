"""Scenes, a container and a capture for the commands, which no test changes."""

import pytest
from helpers.captured_scene import SCENE, damaged, write_capture

import kissgs

FAST = kissgs.Settings.from_preset("fast")


@pytest.fixture(scope="session")
def scene(tmp_path_factory):
    path = tmp_path_factory.mktemp("scene") / "scene.ply"
    kissgs.save(kissgs.sample_scene(600, sh_degree=1), path)
    return path


@pytest.fixture(scope="session")
def folder(tmp_path_factory):
    """Folder with a.ply, its container b.zip, a damaged c.ply, and a capture."""
    folder = tmp_path_factory.mktemp("captured")
    kissgs.save(SCENE, folder / "a.ply")
    kissgs.compress(SCENE, folder / "b.zip", settings=FAST)
    kissgs.save(damaged(), folder / "c.ply")
    write_capture(folder / "capture")
    return folder
