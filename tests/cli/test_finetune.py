"""``kissgs compress --finetune`` as a user runs it. Oracle: the library's own functions."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from helpers.captured_scene import SCENE, write_capture
from helpers.command_line import failure, run

import kissgs
from kissgs.cli.options import with_default_values

SHORT = {"views": 24, "view_size": 48}
OPTIONS = [word for name, value in SHORT.items() for word in ("--set", f"finetune.{name}={value}")]
LOOK = {"sensitivity_views": 8, "sensitivity_view_size": 48}
OPTIONS += [word for name, value in LOOK.items() for word in ("--set", f"{name}={value}")]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("finetune")
    kissgs.save(SCENE, folder / "a.ply")
    write_capture(folder / "capture")
    return folder


def settings(**changes: object) -> kissgs.Settings:
    return kissgs.Settings.research("balanced", finetune={"enabled": True, **SHORT, **changes}, **LOOK)


def test_output_and_report_are_those_of_the_library(folder: Path, tmp_path: Path) -> None:
    done = run("compress", "--finetune", "6", folder / "a.ply", "-o", tmp_path / "b.zip", *OPTIONS)
    assert done.returncode == 0, done.stderr
    found = kissgs.compress(SCENE, settings=settings(steps=6))
    assert (tmp_path / "b.zip").read_bytes() == found.to_zip()
    assert found.report.finetuning is not None
    assert (
        f"{found.report.finetuning.psnr_before:.2f} -> {found.report.finetuning.psnr_after:.2f} dB"
        in done.stdout.decode()
    )
    assert "fine-tuned on renderings of the scene" in done.stdout.decode()


def test_sog_is_fine_tuned_too(folder: Path, tmp_path: Path) -> None:
    done = run("compress", "--finetune", "6", folder / "a.ply", "-o", tmp_path / "b.sog", *OPTIONS, "--json")
    assert done.returncode == 0, done.stderr
    found = kissgs.compress(SCENE, settings=settings(steps=6), container="sog")
    assert (tmp_path / "b.sog").read_bytes() == found.to_zip()
    assert json.loads(done.stdout)["finetuning"]["steps"] == 6
    assert len(kissgs.load(tmp_path / "b.sog")) == len(found.order)


def test_the_default_number_of_steps_is_that_of_the_preset() -> None:
    assert with_default_values(["compress", "a.ply", "--finetune"]) == ["compress", "a.ply", "--finetune", "auto"]
    assert with_default_values(["--finetune", "a.ply", "-q"]) == ["--finetune", "auto", "a.ply", "-q"]
    assert with_default_values(["--finetune", "70", "a.ply"]) == ["--finetune", "70", "a.ply"]
    assert with_default_values(["--finetune", "auto"]) == ["--finetune", "auto"]
    for preset, steps in (("fast", 200), ("balanced", 1000), ("small", 2000), ("paper", 4000)):
        assert kissgs.Settings.from_preset(preset, finetune={"enabled": True}).finetune.steps == steps


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (
            ["--set", "finetune.steps=0"],
            "setting steps: input should be greater than or equal to 1, not '0'",
        ),
        (["--finetune=many"], "--finetune many: give a number of steps, or none for that of the preset"),
        (["--finetune", "--set", "finetune.speed=9"], "there is no setting 'speed' of finetune; there are "),
        (["--device", "cuda"], "add --compact or --finetune"),
        (["--checkpoint"], "add --compact or --finetune"),
    ],
)
def test_invalid_options(folder: Path, tmp_path: Path, words: list[str], sentence: str) -> None:
    assert sentence in failure("compress", folder / "a.ply", "-o", tmp_path / "b.zip", *words)
    assert not (tmp_path / "b.zip").exists()
