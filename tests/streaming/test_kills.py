"""kill -9 of the process that compresses a streamed scene. Oracle: the files of uninterrupted work."""

import random
import signal
import subprocess
import sys

import pytest
from helpers.streamed_scenes import FAST, files_of, saved_sample, small_sizes

from kissgs.streaming.compress import compress_streamed

SIZES = {"chunk": 1600, "leaf": 300, "coarsest": 1000}

SCRIPT = """
import os, signal, sys
from kissgs import Settings
from kissgs.streaming import build
from kissgs.streaming.compress import compress_streamed

build.CHUNK, build.LEAF, build.COARSEST = {chunk}, {leaf}, {coarsest}
events, last = 0, int(sys.argv[3])


def progress(stage, fraction, note=""):
    global events
    events += 1
    if events == last:
        os.kill(os.getpid(), signal.SIGKILL)


compress_streamed(sys.argv[1], sys.argv[2], settings=Settings.from_preset("fast"), threads=1, progress=progress)
""".format(**SIZES)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return saved_sample(tmp_path_factory, 5000, 1)


@pytest.fixture(scope="module")
def whole(tmp_path_factory, scene):
    """Return the folder of uninterrupted work, and the number of its events."""
    folder, events = tmp_path_factory.mktemp("whole") / "city", []
    with pytest.MonkeyPatch.context() as patch:
        small_sizes(patch, **SIZES)
        target = folder / "lod-meta.json"
        compress_streamed(scene, target, settings=FAST, threads=1, progress=lambda *event: events.append(event))
    return folder, len(events)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.quick(0)
def test_killed_work_ends_with_the_same_files(scene, whole, tmp_path, monkeypatch, seed):
    """It is killed twice, at two of its events, and the same call then ends the work."""
    folder, events = whole
    rng = random.Random(seed)
    target = tmp_path / "city" / "lod-meta.json"
    small_sizes(monkeypatch, **SIZES)
    for _ in range(2):
        command = [sys.executable, "-c", SCRIPT, str(scene), str(target), str(rng.randint(1, events // 2))]
        assert subprocess.run(command, check=False).returncode == -signal.SIGKILL
        assert not target.exists()
    compress_streamed(scene, target, settings=FAST, threads=1)
    assert files_of(tmp_path / "city") == files_of(folder)
    assert [path.name for path in tmp_path.iterdir()] == ["city"]
