"""``kissgs compact``, ``compress --compact`` and ``--finetune`` as a user runs them. Oracle: the library's
functions."""

import json
import signal
import subprocess

import pytest
from helpers.captured_scene import SCENE
from helpers.command_line import KISSGS, failure, run
from helpers.held_training import HeldTraining
from helpers.training_scenes import same

import kissgs
from kissgs.cli.options import budget_of, chosen, share_of, steps_of

SHORT = {"method": "prune", "sparsify_steps": 4, "refine_steps": 2, "prune_rounds": 2, "views": 16, "view_size": 48}
OPTIONS = [word for name, value in SHORT.items() for word in ("--set", f"{name}={value}")]


def test_the_output_is_that_of_the_library(folder, tmp_path):
    words = ["compact", folder / "a.ply", "--ratio", "0.2", "-p", "fast", *OPTIONS, "--evaluate"]
    done = run(*words, "-o", tmp_path / "b.ply")
    assert done.returncode == 0, done.stderr
    settings = kissgs.Settings.research("fast", compact={**SHORT, "ratio": 0.2})
    found = kissgs.compact(SCENE, settings=settings, evaluate=True)
    assert same(kissgs.load(tmp_path / "b.ply"), kissgs.clean(found.splats)[0])
    text = done.stdout.decode()
    assert "1,500 -> 300 Gaussians" in text
    assert "trained on renderings of the scene: " in text
    rows = [row.split() for row in text.splitlines() if row.startswith(("input", "prune", "sparsify", "refine"))]
    assert [row[1] for row in rows] == [f"{step.count:,}" for step in found.report.steps]
    assert [row[-1] for row in rows] == [f"{step.bytes:,}" for step in found.report.steps]


def test_photographs_are_training_targets(folder, tmp_path):
    words = ["compact", folder / "a.ply", "-n", "0.3k", "-o", tmp_path / "b.ply", "--views", folder / "capture"]
    report = json.loads(run(*words, *OPTIONS, "--json").stdout)
    assert (report["count"], report["target_source"]) == (300, "photos")
    assert len(kissgs.load(tmp_path / "b.ply")) == 300


def test_without_steps_the_scene_is_only_pruned(folder, tmp_path):
    words = ["compact", folder / "a.ply", "-n", "99", "-p", "fast", "--method", "prune", "-o", tmp_path / "b.ply"]
    run(*words, "--set", "views=24")
    found = kissgs.load(tmp_path / "b.ply")
    assert {row.tobytes() for row in found.means} < {row.tobytes() for row in SCENE.means}
    assert len(found) == 99


def test_the_preset_fast_merges_without_views_and_training(folder, tmp_path):
    words = ["compact", folder / "a.ply", "--ratio", "0.2", "-p", "fast"]
    done = run(*words, "-o", tmp_path / "b.ply")
    assert done.returncode == 0, done.stderr
    settings = kissgs.Settings.from_preset("balanced", compact={"ratio": 0.2, "method": "merge"})
    assert same(kissgs.load(tmp_path / "b.ply"), kissgs.compact(SCENE, settings=settings).splats)
    rows = [row.split()[:2] for row in done.stdout.decode().splitlines() if row.startswith(("input", "merge"))]
    assert rows == [["input", "1,500"], ["merge", "300"]]
    done = run(*words, "--method", "merge", "-o", tmp_path / "c.ply", "--evaluate", "--json")
    assert (tmp_path / "c.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()
    steps = json.loads(done.stdout)["steps"]
    assert [step["name"] for step in steps] == ["input", "merge"]
    assert 15 < steps[1]["psnr"] < 60


@pytest.mark.quick(0)
def test_a_search_may_merge(folder, tmp_path):
    words = ["--max-psnr-drop", "0.3", "--method", "merge", *OPTIONS, "--json", "-o", tmp_path / "d.ply"]
    searched = json.loads(run("compact", folder / "a.ply", *words).stdout)
    assert max(trial["drop"] for trial in searched["trials"] if trial["count"] == searched["count"]) <= 0.3


@pytest.mark.quick(0)
def test_a_search_prints_its_trials(folder, tmp_path):
    words = ["-p", "fast", "--set", "views=96", "--set", "view_size=48", "-o", tmp_path / "b.ply"]
    done = run("compact", folder / "a.ply", "--max-psnr-drop", "1", *words)
    assert "search: 375 Gaussians lose" in done.stdout.decode()
    assert 1 < len(kissgs.load(tmp_path / "b.ply")) < 1500


def test_compress_compacts_first(folder, tmp_path):
    changes = [word for name, value in SHORT.items() for word in ("--set", f"compact.{name}={value}")]
    words = ["-p", "fast", "--compact", "20%", *changes, "-o", tmp_path / "a.zip", "--json", "--evaluate"]
    report = json.loads(run("compress", folder / "a.ply", *words).stdout)
    settings = kissgs.Settings.research("fast", compact={**SHORT, "ratio": 0.2})
    small = kissgs.compact(SCENE, settings=settings).splats
    plain = kissgs.compress(small, settings=kissgs.Settings.from_preset("fast"))
    found, expected = (kissgs.decompress(source) for source in (tmp_path / "a.zip", plain.files))
    assert same(found, expected)
    assert report["source_count"] == 1500
    assert report["compaction"]["count"] == 300
    expected_evaluation = json.loads(json.dumps(kissgs.evaluate(SCENE, found).as_dict()))
    assert report["evaluation"]["mean"] == expected_evaluation["mean"], "compared with the original scene"
    info = json.loads(run("info", tmp_path / "a.zip", "--json").stdout)
    assert info["details"]["source_count"] == 1500
    assert info["changed"]["compacted"] == 1200


def test_ctrl_c_leaves_a_checkpoint_to_resume_from(tmp_path, tmp_path_factory):
    scene, target, kept = tmp_path / "a.ply", tmp_path / "b.ply", tmp_path / "a.checkpoint.npz"
    kissgs.save(SCENE, scene)
    words = ["compact", scene, "-n", "300", "-o", target, "--checkpoint", "--quiet", *OPTIONS]
    training = HeldTraining(tmp_path_factory.mktemp("hold"), saves=4)
    program = f"{training.program}\nfrom kissgs.cli.main import main; main()"
    process = subprocess.Popen([KISSGS.with_name("python"), "-c", program, *map(str, words)], stderr=subprocess.PIPE)
    training.wait()
    process.send_signal(signal.SIGINT)
    assert process.communicate()[1] == b"kissgs: interrupted; no partial file is left\n"
    assert process.returncode == 130
    assert sorted(path.name for path in tmp_path.iterdir()) == [kept.name, "a.ply"]
    assert "other work" in failure("compact", scene, "-n", "301", "-o", target, "--checkpoint", *OPTIONS)
    training.release()
    assert run(*words).returncode == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.ply", "b.ply"]
    whole = kissgs.compact(SCENE, settings=kissgs.Settings.research("balanced", compact={**SHORT, "count": 300}))
    assert same(kissgs.load(target), kissgs.clean(whole.splats)[0])


UNTRAINED = "-n 9 -o b.ply -p fast --method prune"
MERGING = "--compact 20% --set compact.method=merge"
REFUSED = {
    "compact a.ply -o b.ply": (
        "missing the number of Gaussians to keep: give -n 200k, --ratio 0.2 or --max-psnr-drop 0.2"
    ),
    "compact a.ply -n 9": "missing -o: by default the output would overwrite the input",
    "compact a.ply -n many -o b.ply": (
        "'many' is no number of Gaussians; give 200000, 200k or 1.5M, or a share with --ratio 0.2"
    ),
    "compact a.ply -n 0 -o b.ply": "setting count: input should be greater than or equal to 1, not 0",
    "compact a.ply --ratio 20 -o b.ply": "setting ratio: input should be less than or equal to 1, not 20.0",
    "compact a.ply -n 9 --ratio 0.2 -o b.ply": "count and ratio cannot both be met; give one",
    "compact a.ply -n 9 -o b.ply --set speed=9": "there is no setting 'speed' of compact; there are count, ",
    "compact a.ply -n 9 -o b.ply --set no.speed=9": "the groups are compact, encode and finetune",
    "compact a.ply -n 9 -o b.zip/": "b.zip",
    "compact a.ply --max-psnr-drop 1 -o b.ply --checkpoint": "keeps no checkpoint",
    "compact a.ply -n 9 -o b.ply --device tpu": "--device tpu: choose cpu or cuda",
    "compact a.ply -n 9 -o b.ply --method merge --checkpoint": (
        "only apply to training: leave them out, the method merge"
    ),
    f"compact a.ply {UNTRAINED} --device cuda": "leave them out, these settings take no training steps",
    f"compact a.ply {UNTRAINED} --checkpoint": "leave them out, these settings take no training steps",
    f"compact a.ply {UNTRAINED} --method cluster": "setting method: input should be 'prune' or 'merge', not 'cluster'",
    "compact a.ply -n 9 -o there.ply": "exists already",
    "compress a.ply -o n.zip --device cuda": "add --compact or --finetune",
    "compress a.ply -o n.zip --checkpoint": "add --compact or --finetune",
    f"compress a.ply -o n.zip {MERGING} --device cuda": "the method merge does not train",
    f"compress a.ply -o n.zip {MERGING} --checkpoint": "the method merge does not train",
    "compress a.ply -o n.zip --set finetune.steps=0": (
        "setting steps: input should be greater than or equal to 1, not '0'"
    ),
    "compress a.ply -o n.zip --finetune=many": (
        "--finetune many: give a number of steps, or none for that of the preset"
    ),
    "compress a.ply -o n.zip --finetune --set finetune.speed=9": "there is no setting 'speed' of finetune; there are ",
}


def test_impossible_requests_are_refused(folder, tmp_path):
    (tmp_path / "a.ply").write_bytes((folder / "a.ply").read_bytes())
    for name in ("b.zip", "there.ply"):
        (tmp_path / name).write_text("mine")
    for words, sentence in REFUSED.items():
        assert sentence in failure(*words.split(), cwd=tmp_path), words
    assert {path.name for path in tmp_path.iterdir()} == {"a.ply", "b.zip", "there.ply"}
    assert (tmp_path / "b.zip").read_text() == (tmp_path / "there.ply").read_text() == "mine"


def test_a_pipe_leaves_no_checkpoint(folder, tmp_path):
    kissgs.save(SCENE, tmp_path / "s.ply")
    words = ["-o", "-", "--checkpoint", *OPTIONS]
    assert run("compact", tmp_path / "s.ply", "-n", "300", *words).stdout.startswith(b"ply")
    short = [word for word in OPTIONS if word != "--set"]
    options = [word for name in short for word in ("--set", f"compact.{name}")]
    piped = run("compress", tmp_path / "s.ply", "--compact", "300", "-o", "-", "--checkpoint", "-p", "fast", *options)
    assert piped.stdout.startswith(b"PK")
    assert [path.name for path in tmp_path.iterdir()] == ["s.ply"]


WITHOUT_TORCH = """
import sys
sys.modules["torch"] = None
from kissgs.cli.main import main
try:
    main()
except SystemExit as end:
    assert end.code == 2
sys.argv += ["-p", "fast"]
main()
"""


def test_missing_torch_is_reported(folder, tmp_path):
    """First the preset balanced, which trains, and in the same process the preset fast, which does not."""
    words = ["compact", folder / "a.ply", "-n", "99", "-o", tmp_path / "b.ply", "--set", "views=24"]
    done = subprocess.run(
        [KISSGS.with_name("python"), "-c", WITHOUT_TORCH, *map(str, words)],
        capture_output=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr.startswith(b"kissgs: training needs torch, which is missing: pip install torch")
    assert len(kissgs.load(tmp_path / "b.ply")) == 99


BUDGETS = {
    "200k": {"count": 200_000},
    "1.5M": {"count": 1_500_000},
    "90,000": {"count": 90_000},
    "12.5 %": {"ratio": 0.125},
    ".5 db": {"max_psnr_drop": 0.5},
}
NO_BUDGETS = ("", "%", "-5", "20%%", "1e5", "k", "0.2 dBs", "nan", "1.2.3", "0.8", "0,2", "1,5M", "0x10", "½")


def test_budgets_and_shares():
    for text, budget in BUDGETS.items():
        assert budget_of(text) == pytest.approx(budget), text
    for text in NO_BUDGETS:
        with pytest.raises(kissgs.UnsupportedError, match=r"give a number of Gaussians \(200k\), a share"):
            budget_of(text)
    assert [share_of(text) for text in ("0.2", " 2.5 % ", "1e-3")] == pytest.approx([0.2, 0.025, 0.001])
    for text in ("a fifth", "%", "", "2%%"):
        with pytest.raises(kissgs.UnsupportedError, match=r"--ratio .*: give a share such as 0\.2 or 20%"):
            share_of(text)


SHORT_TUNING = {"views": 24, "view_size": 48}
LOOK = {"sensitivity_views": 8, "sensitivity_view_size": 48}
CHANGES = {**{f"finetune.{name}": value for name, value in SHORT_TUNING.items()}, **LOOK}
TUNING_OPTIONS = [word for name, value in CHANGES.items() for word in ("--set", f"{name}={value}")]


@pytest.mark.parametrize("container", ["sogxt", "sog"])
@pytest.mark.quick(1)
def test_output_and_report_are_those_of_the_library(folder, tmp_path, container):
    target = tmp_path / ("b.zip" if container == "sogxt" else "b.sog")
    words = ["compress", "--finetune", "6", folder / "a.ply", "-o", target, *TUNING_OPTIONS]
    done = run(*words)
    assert done.returncode == 0, done.stderr
    settings = kissgs.Settings.research("balanced", finetune={"enabled": True, "steps": 6, **SHORT_TUNING}, **LOOK)
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
