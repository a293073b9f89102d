"""Oracle: the parts of the pipeline called one by one, and the file system before and after."""

import dataclasses
import gc
import io
import json
import os
import subprocess
import sys
import time
import zipfile
from pathlib import Path

import numpy as np
import pytest
from helpers.captured_scene import SCENE as CAPTURED
from helpers.captured_scene import write_capture
from helpers.fewer_cameras import try_fewer

import kissgs
from kissgs import Cancelled, InvalidContainerError, InvalidSceneError, InvalidViewsError, OutputError, Settings
from kissgs.core.splats import ATTRIBUTES, Splats, clean
from kissgs.io.ply import write_ply

FAST = Settings.from_preset("fast")
SCENE = kissgs.sample_scene(120, sh_degree=1, seed=3)
GLANCE = {"sensitivity_views": 4, "sensitivity_view_size": 48}


def dirty(splats):
    """Return a copy with one invalid Gaussian and one quaternion that is not normalised."""
    arrays = {name: getattr(splats, name).copy() for name in ATTRIBUTES}
    arrays["means"][3] = np.nan
    arrays["quats"][5] *= 4
    return Splats(**arrays)


def compress(source, destination=None, **options):
    return kissgs.compress(source, destination, settings=FAST, **options)


def assert_same(found, wanted):
    assert all(np.array_equal(getattr(found, name), getattr(wanted, name)) for name in ATTRIBUTES)


def names(folder):
    """Return the names of all entries of a folder, including hidden ones."""
    return sorted(entry.name for entry in folder.iterdir())


@pytest.fixture
def ply(tmp_path):
    path = tmp_path / "scene.ply"
    kissgs.save(dirty(SCENE), path)
    return path


class Recorder:
    """Record all events; raise Cancelled at event number ``stop_at``."""

    def __init__(self, stop_at=None):
        self.events, self.stop_at = [], stop_at

    def __call__(self, stage, fraction):
        self.events.append((stage, fraction))
        if len(self.events) == self.stop_at:
            raise Cancelled("enough")


def test_round_trip_through_files(tmp_path, ply):
    result = compress(ply, tmp_path / "scene.zip")
    assert (tmp_path / "scene.zip").read_bytes() == result.to_zip()
    found = kissgs.decompress(tmp_path / "scene.zip", tmp_path / "back.ply")
    assert_same(found, kissgs.decompress(result.files))
    stream = io.BytesIO()
    write_ply(stream, found)
    assert (tmp_path / "back.ply").read_bytes() == stream.getvalue()
    assert_same(kissgs.load(tmp_path / "back.ply"), clean(found)[0])
    assert_same(kissgs.load(tmp_path / "scene.zip"), clean(found)[0])


def test_every_kind_of_source_gives_the_same_container(tmp_path, ply):
    wanted = compress(dirty(SCENE)).to_zip()
    for source in (ply, str(ply), ply.read_bytes(), clean(dirty(SCENE))[0]):
        result = compress(source)
        files = {name: data for name, data in result.files.items() if name.endswith(".webp")}
        with zipfile.ZipFile(io.BytesIO(wanted)) as archive:
            assert files == {name: archive.read(name) for name in files}


def test_containers_are_encoded_again(tmp_path):
    first = compress(SCENE, tmp_path / "scene.zip")
    compress(SCENE, tmp_path / "folder")
    again = [compress(source) for source in (tmp_path / "scene.zip", tmp_path / "folder", first.to_zip())]
    assert all(result.report.source_count == first.report.count for result in again)
    assert len({result.files["f_dc.webp"] for result in again}) == 1
    scene = kissgs.decompress(again[0].files)
    before = kissgs.decompress(first.files).select(again[0].order)
    np.testing.assert_allclose(scene.sh0, before.sh0, atol=1e-5)


def test_the_report_adds_up(tmp_path, ply):
    start, events = time.perf_counter(), Recorder()
    result = compress(ply, tmp_path / "scene.zip", progress=events)
    elapsed, report = time.perf_counter() - start, result.report
    faint = int((clean(dirty(SCENE))[0].opacities <= -5.5373).sum())
    assert (report.source_count, report.cleaned.removed, report.invisible) == (120, 1, faint)
    assert report.count == len(result.order) == 119 - faint == len(kissgs.decompress(result.files))
    assert report.cleaned.unnormalised_quats == 1
    assert report.source_bytes == ply.stat().st_size
    assert report.container_bytes == (tmp_path / "scene.zip").stat().st_size == len(result.to_zip())
    with zipfile.ZipFile(io.BytesIO(result.to_zip())) as archive:
        assert report.file_bytes == {entry.filename: entry.compress_size for entry in archive.infolist()}
    assert report.container_bytes > sum(report.file_bytes.values())
    assert report.ratio == report.source_bytes / report.container_bytes
    assert report.bytes_per_gaussian == report.container_bytes / 120
    assert list(report.seconds) == list(dict.fromkeys(stage for stage, _ in events.events))
    assert {"read", "images", "write"} <= report.seconds.keys()
    assert 0 < sum(report.seconds.values()) <= elapsed
    assert report.cpu_seconds > 0
    assert report.peak_memory > report.source_bytes
    assert Settings.model_validate(report.settings) == FAST.resolved(photographs=None, torch=True)
    decoded = json.loads(json.dumps(report.as_dict()))
    assert decoded["cleaned"]["non_finite"] == 1
    assert decoded["ratio"] == report.ratio


def test_the_report_of_arrays_counts_their_bytes():
    report = compress(SCENE).report
    assert report.source_bytes == SCENE.nbytes
    assert "write" not in report.seconds
    empty = compress(SCENE.select(slice(0, 0))).report
    assert (empty.source_count, empty.count, empty.source_bytes) == (0, 0, 0)
    assert empty.bytes_per_gaussian == empty.container_bytes


@pytest.mark.parametrize("name", ["scene.zip", "folder", "back.ply"])
def test_existing_outputs_are_refused_before_the_work(tmp_path, name):
    path = tmp_path / name
    source = compress(SCENE).to_zip()
    act = kissgs.decompress if name.endswith(".ply") else compress
    if name == "folder":
        path.mkdir()
    else:
        path.write_text("precious")
    events = Recorder()
    with pytest.raises(OutputError, match="exists already; choose another name or allow overwriting"):
        act(source, path, progress=events)
    assert events.events == []
    if path.is_file():
        assert path.read_text() == "precious"
    act(source, path, overwrite=True)
    assert path.is_dir() or path.stat().st_size > 1000
    assert names(tmp_path) == [name]


@pytest.mark.parametrize("name", ["none/scene.zip", "none/folder", "none/back.ply", "back.txt"])
def test_impossible_destinations_are_refused_before_the_work(tmp_path, name):
    act = kissgs.decompress if Path(name).suffix in (".ply", ".txt") else compress
    source, events = compress(SCENE).to_zip(), Recorder()
    with pytest.raises(OutputError):
        act(source, tmp_path / name, progress=events)
    assert events.events == []
    assert names(tmp_path) == []


def test_decompressed_numbers_are_exact_whatever_the_name(tmp_path):
    """A container of a.compressed.ply has the name a.compressed.zip, and gives a.compressed.ply back."""
    packed = compress(SCENE).to_zip()
    path = tmp_path / "a.compressed.ply"
    wanted = kissgs.decompress(packed, path)
    assert not kissgs.read_ply_info(path).compressed
    np.testing.assert_array_equal(kissgs.load(path).means, wanted.means)


def count_of_events():
    events = Recorder()
    compress(SCENE, progress=events)
    return len(events.events)


@pytest.mark.parametrize(
    ("name", "kind"),
    [("none.ply", InvalidSceneError), ("none.zip", InvalidContainerError), ("none", InvalidSceneError)],
)
def test_missing_files(tmp_path, name, kind):
    with pytest.raises(kind, match=f"cannot read {tmp_path / name}: "):
        kissgs.load(tmp_path / name)


@pytest.mark.parametrize("part", [0, 0.5, 1])
@pytest.mark.parametrize("name", ["scene.zip", "folder"])
def test_cancelling_leaves_no_file(tmp_path, name, part):
    at = max(1, round(part * count_of_events()))  # the last event is that of writing, without that of the end
    events = Recorder(stop_at=at)
    with pytest.raises(Cancelled, match="enough"):
        compress(SCENE, tmp_path / name, progress=events)
    assert len(events.events) == at
    assert names(tmp_path) == []


@pytest.mark.parametrize("at", [1, 4])
def test_cancelling_decompression_leaves_no_file(tmp_path, at):
    """While it decodes and while it writes."""
    with pytest.raises(Cancelled):
        kissgs.decompress(compress(SCENE).to_zip(), tmp_path / "back.ply", progress=Recorder(stop_at=at))
    assert names(tmp_path) == []


def test_cancelling_keeps_the_existing_file(tmp_path):
    compress(SCENE, tmp_path / "scene.zip")
    before = (tmp_path / "scene.zip").read_bytes()
    with pytest.raises(Cancelled):
        compress(SCENE, tmp_path / "scene.zip", overwrite=True, progress=Recorder(stop_at=count_of_events()))
    assert (tmp_path / "scene.zip").read_bytes() == before


@pytest.mark.parametrize("name", ["scene.zip", "folder", "back.ply"])
@pytest.mark.quick(1)
def test_a_full_disk_is_an_output_error_and_leaves_nothing(tmp_path, name):
    """A limit of 3 kB per file simulates a full disk; the error contains the message of the system."""
    program = """
import pathlib, resource, sys, kissgs
scene, settings = kissgs.sample_scene(1500, sh_degree=1), kissgs.Settings(preset="fast")
files = kissgs.compress(scene, settings=settings).files
resource.setrlimit(resource.RLIMIT_FSIZE, (3000, 3000))
try:
    if sys.argv[1].endswith(".ply"):
        kissgs.decompress(files, sys.argv[1])
    else:
        kissgs.Compressed(files, None, None).save(pathlib.Path(sys.argv[1]))
except kissgs.OutputError as error:
    print(error)
"""
    environment = os.environ | {"PYTHONPATH": str(Path(kissgs.__file__).parents[1])}
    command = [sys.executable, "-P", "-c", program, str(tmp_path / name)]
    run = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert run.stdout == f"cannot write {tmp_path / name}: file too large\n"
    assert names(tmp_path) == []


def test_files_have_the_permissions_that_new_files_have(tmp_path):
    old = os.umask(0o027)
    try:
        compress(SCENE, tmp_path / "scene.zip")
        compress(SCENE, tmp_path / "folder")
    finally:
        os.umask(old)
    assert (tmp_path / "scene.zip").stat().st_mode & 0o777 == 0o640
    assert (tmp_path / "folder").stat().st_mode & 0o777 == 0o750
    assert (tmp_path / "folder" / "meta.json").stat().st_mode & 0o777 == 0o640


def test_given_sensitivity_is_used(monkeypatch):
    """Gaussians with a thousandth of the sensitivity are quantised more coarsely."""
    try_fewer(monkeypatch)  # but not as few as in other tests here
    cameras = [view.camera for view in kissgs.virtual_views(SCENE, width=64, height=64, count=4).all]
    measured = kissgs.measure_sensitivity(
        SCENE, kissgs.WeightedCameras(cameras, [1.0] * 4, np.zeros(3, np.float32)), view_uncertainty=1
    )
    everywhere = np.ones(120, np.float32)  # as if seen by a capture: only lambda limits errors
    measured = dataclasses.replace(measured, coverage=everywhere, captured=everywhere)
    halves = np.arange(120) < 60
    errors = []
    for half in (halves, ~halves):
        less = np.where(half, 1, 1e-3).astype(np.float32)[:, None]
        one = dataclasses.replace(
            measured,
            shape_hessian=measured.shape_hessian * less,
            position_hessian=measured.position_hessian * less,
            color_weight=measured.color_weight * less[:, 0],
        )
        result = kissgs.compress(
            SCENE, sensitivity=one, settings=Settings.research("balanced", prune_threshold_bits=0, rd_lambda=1e-8)
        )
        found = kissgs.decompress(result.files)
        errors.append(np.abs(found.opacities - SCENE.opacities[result.order])[halves[result.order]].mean())
    assert errors[0] < 0.7 * errors[1]
    with pytest.raises(InvalidSceneError, match="the sensitivity does not fit the scene: position_hessian must be"):
        kissgs.compress(SCENE, sensitivity=kissgs.Sensitivity.none(119, SCENE.sh_degree))
    with pytest.raises(InvalidSceneError, match="color_weight has a negative or non-finite value"):
        kissgs.compress(
            SCENE, sensitivity=dataclasses.replace(measured, color_weight=measured.color_weight * np.float32(np.nan))
        )


@pytest.mark.parametrize("changes", [{"preset": "fast"}, {"preset": "balanced", "sensitivity_views": 2}])
@pytest.mark.parametrize("needed", [False, True])
@pytest.mark.quick(2)
def test_a_scene_from_a_file_is_dropped_before_its_images_are_compressed(tmp_path, changes, needed):
    count = 1234
    kissgs.save(kissgs.sample_scene(count, sh_degree=1), tmp_path / "scene.ply")
    alive = []

    def progress(stage, fraction, note=""):
        if stage == "images" and len(alive) < 3:  # looking at all objects takes long
            scenes = [thing for thing in gc.get_objects() if type(thing) is Splats]
            alive.append(sum(len(scene) == count for scene in scenes))

    settings = kissgs.Settings.research(**changes)
    kissgs.compress(tmp_path / "scene.ply", settings=settings, evaluate=needed, progress=progress)
    assert alive
    assert (min(alive) > 0) if needed else (max(alive) == 0)


def test_a_capture_may_be_given_by_its_path(tmp_path):
    folder = write_capture(tmp_path / "capture", size=(64, 48))
    views = kissgs.load_views(folder)
    scene, settings = CAPTURED.select(slice(0, 60)), Settings.research("balanced", **GLANCE)
    by_views = kissgs.compress(scene, settings=settings, views=views, force_views=True).to_zip()
    assert by_views != kissgs.compress(scene, settings=settings).to_zip()
    for kind in (str, Path):
        by_path = kissgs.compress(scene, settings=settings, views=kind(folder), force_views=True)
        assert by_path.to_zip() == by_views
        with pytest.raises(InvalidViewsError, match="nowhere"):
            kissgs.compress(scene, views=kind(tmp_path / "nowhere"))
    found = kissgs.evaluate(scene, scene.select(slice(0, 30)), str(folder))
    assert found.source == views.source


@pytest.mark.parametrize("preset", ["fast", "balanced"])
def test_the_order_leads_back_to_the_input_of_a_compaction(preset):
    pruned = {"ratio": 0.5, "method": "prune", "sparsify_steps": 0, "refine_steps": 0, "views": 24, "view_size": 48}
    result = kissgs.compress(SCENE, settings=Settings.research(preset, compact=pruned, **GLANCE))
    found = kissgs.decompress(result.files)
    assert len(found) == len(result.order) <= 60
    distances = np.linalg.norm(found.means[:, None] - SCENE.means[None], axis=2)
    assert (distances.argmin(axis=1) == result.order).all()
