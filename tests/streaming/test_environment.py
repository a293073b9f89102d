"""Environments. Oracle: scenes that are made with surroundings, and the reader."""

import itertools
import json
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.splat_transform import convert, needs_splat_transform
from helpers.streamed_scenes import FAST, TARGETS, Stop, small_sizes

import kissgs
from kissgs import Settings
from kissgs.core import context
from kissgs.streaming import levels
from kissgs.streaming.compress import compress_streamed
from kissgs.streaming.levels import FEWEST, MOST, Environment


@pytest.fixture(autouse=True)
def small(monkeypatch):
    small_sizes(monkeypatch, chunk=400, leaf=120, coarsest=250)
    monkeypatch.setattr(levels, "FEWEST", 50)


def directions(count, seed=0):
    found = np.random.default_rng(seed).normal(size=(count, 3))
    return found / np.linalg.norm(found, axis=1, keepdims=True)


def town(count=20_000):
    return (np.array([7.0, -3.0, 11.0]) + np.random.default_rng(1).uniform(-5, 5, (count, 3))).astype(np.float32)


def around(count, distance=300.0):
    return (np.array([7.0, -3.0, 11.0]) + distance * directions(count)).astype(np.float32)


def found(near, far, share=1.0):
    return Environment.of(np.concatenate([near, far]), round((len(near) + len(far)) / share))


def test_a_sky_is_apart_from_the_town():
    near, sky = town(), around(2000)
    apart = found(near, sky)
    assert not apart.contains(near).any()
    assert apart.contains(sky).all()


def test_half_a_sky_surrounds_and_a_second_town_does_not():
    half = around(4000)
    half = half[half[:, 1] < -3.0]
    assert found(town(), half).contains(half).all()
    other = (town(2000) + np.float32([300, 0, 0])).astype(np.float32)
    assert not found(town(), other).contains(other).any()


@pytest.mark.parametrize(
    ("near", "far", "share"),
    [
        (20_000, 20, 1.0),  # a few stray Gaussians
        (20_000, 2000, 2000 / (1.1 * MOST)),  # sampled from too many
        (1000, 600, 1.0),  # too large a part of the scene
    ],
)
def test_what_is_too_small_or_too_large_belongs_to_the_tree(near, far, share):
    sky = around(far)
    assert not found(town(near), sky, share).contains(sky).any()


def test_degenerate_scenes_have_no_environment():
    for positions in (np.zeros((0, 3), np.float32), np.zeros((5000, 3), np.float32), np.ones((1, 3), np.float32)):
        assert not Environment.of(positions, len(positions)).contains(positions).any()
    scattered = np.concatenate([np.zeros((5000, 3), np.float32), around(500)])  # more than half at one point
    assert not Environment.of(scattered, 5500).contains(scattered).any()
    assert FEWEST < MOST


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A sample scene, whose sky is 12 % of it."""
    path = tmp_path_factory.mktemp("sky") / "scene.ply"
    kissgs.save(kissgs.sample_scene(1500, sh_degree=1, seed=3), path)
    return path


def sky_of(splats):
    away = np.linalg.norm(splats.means - np.median(splats.means, axis=0), axis=1)
    return splats.select(away > 8 * np.median(away))


@pytest.mark.parametrize("preset", ["fast", "balanced"])
@pytest.mark.parametrize("name", TARGETS)
@pytest.mark.quick(1)
def test_every_level_has_the_whole_sky(scene, tmp_path, name, preset):
    settings = Settings.from_preset(preset)
    report = compress_streamed(scene, tmp_path / name, settings=settings)
    document, expected = json.loads((tmp_path / name).read_bytes()), sky_of(kissgs.load(scene))
    assert document["environment"] == ("environment/meta.json" if name.endswith("lod-meta.json") else "environment.zip")
    alone = kissgs.load((tmp_path / name).parent / document["environment"])
    assert len(alone) == report.environment_count > 0.95 * len(expected)
    assert report.environment_bytes > 0
    bound = document["tree"]["bound"]
    assert np.ptp([bound["min"], bound["max"]], axis=0).max() < 0.3 * np.ptp(expected.means, axis=0).max()
    for level, count in enumerate(report.counts):
        decoded = kissgs.load(tmp_path / name, level=level)
        assert len(decoded) == count + report.environment_count
        np.testing.assert_array_equal(decoded.means[count:], alone.means)
    total = sum(path.stat().st_size for path in (tmp_path / name).parent.rglob("*") if path.is_file())
    assert report.total_bytes == total
    lost = report.source_count - report.counts[0] - report.environment_count
    assert lost == report.changed["invisible"] + report.changed["pruned_by_rd"]


@pytest.mark.quick(1)
@pytest.mark.parametrize("resumed", [True, False])
def test_images_never_go_back_and_have_the_time_left(scene, tmp_path, monkeypatch, resumed):
    """The clock goes on by a second at every event."""
    ticks, events = itertools.count(), []
    clock = SimpleNamespace(perf_counter=lambda: float(next(ticks)), process_time=lambda: 0.0)
    monkeypatch.setattr(context, "time", clock)

    def stop(stage, fraction, note=""):
        if stage == "images" and fraction > 0.5:
            raise Stop

    def keep(stage, fraction, note="", seconds_left=None):
        events.append((stage, fraction, seconds_left))

    target = tmp_path / "city" / "lod-meta.json"
    if resumed:
        with pytest.raises(Stop):
            compress_streamed(scene, target, settings=FAST, progress=stop)
    assert compress_streamed(scene, target, settings=FAST, progress=keep).environment_count > 0
    fractions = [fraction for _, fraction, _ in events]
    assert fractions == sorted(fractions)
    assert events[-1] == ("images", 1.0, 0.0)
    assert any(stage == "merge" for stage, _, _ in events) != resumed
    assert all(left >= 0 for _, _, left in events)


def test_an_environment_that_nobody_sees_is_left_out(tmp_path):
    """Nothing of a sky reaches the output if every renderer skips its opacity."""
    original = kissgs.sample_scene(1500, sh_degree=0, seed=3)
    away = np.linalg.norm(original.means - np.median(original.means, axis=0), axis=1)
    original.opacities[away > 8 * np.median(away)] = -9.0
    kissgs.save(original, tmp_path / "scene.ply")
    report = compress_streamed(tmp_path / "scene.ply", tmp_path / "city" / "lod-meta.json", settings=FAST)
    assert report.environment_count == report.environment_bytes == 0
    assert "environment" not in json.loads((tmp_path / "city" / "lod-meta.json").read_bytes())


@needs_splat_transform
@pytest.mark.quick(0)
def test_splat_transform_reads_the_environment(scene, tmp_path):
    """It writes the coarsest level and the environment as another streamed scene, with other steps of positions."""
    target = tmp_path / "city" / "lod-meta.json"
    report = compress_streamed(scene, target, settings=FAST)
    coarsest = str(len(report.counts) - 1)
    written = convert(target, tmp_path / "theirs" / "lod-meta.json", "-L", coarsest, "-i", "1", "--webp-effort", "0")
    theirs = kissgs.load(written.parent / json.loads(written.read_bytes())["environment"])
    ours = kissgs.load(target.parent / "environment" / "meta.json")
    apart = np.linalg.norm(ours.means[:, None] - theirs.means, axis=2)
    same = apart.argmin(axis=1)
    assert sorted(same) == list(range(len(ours))) == list(range(len(theirs)))
    assert (apart.min(axis=1) < 3e-4 * np.linalg.norm(ours.means, axis=1)).all()
    np.testing.assert_array_equal(ours.scales, theirs.scales[same])
    np.testing.assert_array_equal(ours.sh0, theirs.sh0[same])
    shown = [1 / (1 + np.exp(-each)) for each in (ours.opacities, theirs.opacities[same])]
    np.testing.assert_allclose(*shown, rtol=0, atol=1 / 255 + 1e-6)
