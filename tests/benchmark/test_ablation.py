"""Reference: settings compared one by one, and containers that ``kissgs.compress`` makes."""

import json

import pytest
from helpers.captured_scene import SCENE, write_capture

import kissgs
from kissgs import InvalidSceneError, Settings, UnsupportedError
from kissgs.benchmark import ablation
from kissgs.benchmark.ablation import PAPER_VARIANTS, PARTS, PUBLISHED_BYTES, RATE_DISTORTION_VARIANTS, ablate
from kissgs.benchmark.roundtrip import roundtrip
from kissgs.cameras.captures.load import load_views
from kissgs.cli import bench_ablation
from kissgs.cli.bench_scenes import BenchInputs
from kissgs.cli.console import output

QUICK = {"sensitivity_views": 4, "sensitivity_view_size": 60}


@pytest.mark.parametrize(
    ("preset", "variant"),
    [("paper", variant) for variant in PAPER_VARIANTS]
    + [("balanced", variant) for variant in RATE_DISTORTION_VARIANTS],
    ids=lambda value: getattr(value, "name", value),
)
def test_a_variant_changes_the_settings_it_names_and_no_others(preset, variant):
    settings = Settings.from_preset(preset)
    before, after = settings.encode.model_dump(), variant.apply(settings).encode.model_dump()
    assert {name: value for name, value in after.items() if value != before[name]} == dict(variant.changes)
    parts = [part for change in variant.name.split(", ") for part in change.split("=")]
    assert parts[::2] == list(variant.changes)
    assert Settings.from_preset(preset, **dict(zip(parts[::2], parts[1::2], strict=True))) == variant.apply(settings)


def test_published_bytes_are_relative_to_the_whole():
    assert {part.name: round(100 * part.bytes / PUBLISHED_BYTES, 1) for part in PARTS}["order (PLAS)"] == 15.9
    assert len({part.name for part in PARTS}) == len(PARTS) == 15


@pytest.fixture
def in_this_process(monkeypatch):
    """Measure in this process, which only makes times and memory wrong."""
    monkeypatch.setattr(ablation, "isolated_roundtrip", roundtrip)


@pytest.mark.usefixtures("in_this_process")
@pytest.mark.quick(0)
def test_rows_agree_with_compress_and_evaluate(tmp_path, monkeypatch):
    path = tmp_path / "scene.ply"
    kissgs.save(SCENE.select(slice(0, 400)), path)
    write_capture(tmp_path / "capture")
    views = load_views(tmp_path / "capture")
    settings = Settings.from_preset("balanced", **QUICK)
    chosen = [
        variant
        for variant in RATE_DISTORTION_VARIANTS
        if variant.name in ("prune_threshold_bits=0", "rotation_form=pras", "color_refit_iterations=0")
    ]
    monkeypatch.setattr(ablation, "RATE_DISTORTION_VARIANTS", chosen)
    notes = []
    rows = ablate(path, [settings], views, progress=lambda stage, fraction, note="": notes.append(note))
    assert [row.name for row in rows] == [
        "nothing",
        "prune_threshold_bits=0",
        "color_refit_iterations=0",
        "rotation_form=pras",
    ]
    assert notes[:3] == ["balanced at -2.5", "balanced at 2.5", "balanced: nothing"]
    base = rows[0]
    assert (base.bytes_change, base.equal_psnr_change, base.photo_psnr_change) == (0.0, pytest.approx(0, abs=1e-9), 0.0)
    for row, variant in zip(rows[1:], chosen, strict=True):
        result = kissgs.compress(path, settings=variant.apply(settings), views=views)
        assert row.bytes == len(result.to_zip())
        assert row.bytes_change == pytest.approx(row.bytes / base.bytes - 1)
        assert row.psnr_change == pytest.approx(row.psnr - base.psnr)
        found = kissgs.evaluate(kissgs.load(path), kissgs.decompress(result.to_zip()), views).mean
        assert (row.psnr, row.photo_psnr) == (found.candidate_vs_reference.psnr, found.candidate.psnr)
    without = ablate(path, [settings])
    assert [row.name for row in without] == ["nothing", "prune_threshold_bits=0", "rotation_form=pras"], (
        "there is no colour refit without a capture"
    )
    assert without[0].photo_psnr is None


@pytest.mark.usefixtures("in_this_process")
@pytest.mark.quick(0)
def test_the_command_lists_parts_and_changed_settings(tmp_path, monkeypatch):
    monkeypatch.setattr(ablation, "PAPER_VARIANTS", PAPER_VARIANTS[:2])
    scene = tmp_path / "scene.ply"
    kissgs.save(kissgs.sample_scene(200, sh_degree=0), scene)
    result = bench_ablation.ablation(BenchInputs(scenes=[scene]), presets=["paper"])
    rows = json.loads(json.dumps(result.rows))
    assert {row["scene"] for row in rows} == {"scene.ply"}
    assert list(dict.fromkeys(row["table"] for row in rows)) == ["KISS-GS", "paper"]
    names = [row["name"] for row in rows if row["table"] == "KISS-GS"]
    expected = [part.name for part in PARTS if "codebook" not in part.name and "labels" not in part.name]
    assert names == ["nothing", *expected], "the scene has no SH, so rows of SH are left out"
    assert all(row["cpu_seconds"] is None for row in rows if row["table"] == "KISS-GS")
    assert [row["name"] for row in rows if row["table"] == "paper"] == [
        "nothing",
        "order=hilbert",
        "rotation_form=canonical",
    ]
    console = output()
    with console.capture() as captured:
        console.print(result.table)
    assert "order (PLAS)" in captured.get()
    assert "+15.9 %" in captured.get()


def test_other_presets_and_empty_scenes_are_refused(tmp_path):
    scene = tmp_path / "scene.ply"
    kissgs.save(SCENE, scene)
    with pytest.raises(UnsupportedError, match="needs the preset paper, balanced or small, not fast"):
        ablate(scene, [Settings.from_preset("fast")])
    kissgs.save(SCENE.select(slice(0)), scene, overwrite=True)
    with pytest.raises(InvalidSceneError, match="no usable Gaussian"):
        ablate(scene, [Settings.from_preset("paper")])
