"""``kissgs compress --finetune`` as a user runs it. Oracle: the library's own functions."""

import pytest
from helpers.captured_scene import SCENE
from helpers.command_line import failure, run

import kissgs
from kissgs.cli.options import chosen, steps_of

SHORT = {"views": 24, "view_size": 48}
LOOK = {"sensitivity_views": 8, "sensitivity_view_size": 48}
CHANGES = {**{f"finetune.{name}": value for name, value in SHORT.items()}, **LOOK}
OPTIONS = [word for name, value in CHANGES.items() for word in ("--set", f"{name}={value}")]


@pytest.mark.parametrize("container", ["sogxt", "sog"])
@pytest.mark.quick(1)
def test_output_and_report_are_those_of_the_library(folder, tmp_path, container):
    target = tmp_path / ("b.zip" if container == "sogxt" else "b.sog")
    words = ["compress", "--finetune", "6", folder / "a.ply", "-o", target, *OPTIONS]
    done = run(*words)
    assert done.returncode == 0, done.stderr
    settings = kissgs.Settings.research("balanced", finetune={"enabled": True, "steps": 6, **SHORT}, **LOOK)
    found = kissgs.compress(SCENE, settings=settings, container=container)
    assert target.read_bytes() == found.to_zip()
    report = found.report.finetuning
    assert report is not None
    assert report.steps == 6
    text = done.stdout.decode()
    assert "fine-tuned on renderings of the scene" in text
    assert f"{report.psnr_before:.2f} -> {report.psnr_after:.2f} dB" in text


def test_the_default_number_of_steps_is_that_of_the_preset():
    for preset, steps in (("fast", 200), ("balanced", 1000), ("paper", 4000)):
        assert chosen(preset, None, finetune=steps_of("auto")).finetune.steps == steps
    assert chosen("fast", None, finetune=steps_of("0")).finetune.enabled is False


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--set", "finetune.steps=0"], "setting steps: input should be greater than or equal to 1, not '0'"),
        (["--finetune=many"], "--finetune many: give a number of steps, or none for that of the preset"),
        (["--finetune", "--set", "finetune.speed=9"], "there is no setting 'speed' of finetune; there are "),
        (["--device", "cuda"], "add --compact or --finetune"),
        (["--checkpoint"], "add --compact or --finetune"),
    ],
)
def test_invalid_options(folder, tmp_path, words, sentence):
    assert sentence in failure("compress", folder / "a.ply", "-o", tmp_path / "b.zip", *words)
    assert not (tmp_path / "b.zip").exists()
