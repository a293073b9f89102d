"""The page's words about a job in advance, in Node. Oracles: stages that the library reports; words for options."""

import json

import pytest
from helpers.service import SMALL
from helpers.web_tools import run_node

import kissgs
from service.http.submission import parse_options

LONG = 1e5
FEW = {"sensitivity_views": 4, "sensitivity_view_size": 48}
VIEWS = {"views": 24, "view_size": 48}
TRAINED = {"sparsify_steps": 4, "refine_steps": 4, "prune_rounds": 2, **VIEWS}
TUNED = {"enabled": True, "steps": 4, **VIEWS}
EITHER = {**TUNED, "enabled": None}
UNTUNED = {"enabled": False}
LOSS = {"max_psnr_drop": 3, **FEW}

JOBS = {
    "fast": {"preset": "fast"},
    "evaluated": {"preset": "fast", "evaluate": True},
    "pruned": {"preset": "fast", "compact": {"ratio": 0.5, "method": "prune", **VIEWS}},
    "balanced": {"encode": FEW},
    "a share": {"encode": FEW, "compact": {"ratio": 0.5, **TRAINED}},
    "a loss by pruning": {"encode": FEW, "compact": {"max_psnr_drop": 3, **TRAINED}},
    "a size, tuned": {"encode": {"target_size": 6000, **FEW}, "finetune": TUNED},
    "merged": {"encode": FEW, "compact": {"ratio": 0.5, "method": "merge"}},
    "a size": {"encode": {"target_size": 6000, **FEW}, "finetune": UNTUNED},
    "a size by training": {"encode": {"target_size": 6000, **FEW}, "compact": VIEWS, "finetune": EITHER},
    "time alone": {"time_limit": LONG, "encode": FEW, "finetune": EITHER},
    "a loss by training": {"encode": LOSS, "compact": VIEWS, "finetune": EITHER},
    "as many as a loss needs": {"encode": LOSS, "compact": {"auto_count": True, **TRAINED}, "finetune": UNTUNED},
    "time and tuning": {"time_limit": LONG, "encode": FEW, "finetune": TUNED},
    "tuned": {"encode": FEW, "finetune": TUNED},
}


def in_node(*jobs, sh_degree=1, training=True):
    """Return what the page says of jobs with options as the service stores them."""
    stored = [{"options": each.model_dump(mode="json"), "gaussians": 300, "sh_degree": sh_degree} for each in jobs]
    return json.loads(run_node("plan_stages.mjs", json.dumps([{"job": job, "training": training} for job in stored])))


@pytest.mark.parametrize("name", JOBS)
@pytest.mark.quick(2)
def test_expected_stages(name, tmp_path):
    options = parse_options(json.dumps({**JOBS[name], "for_research": True}))
    scene, reported = tmp_path / "scene.ply", []
    scene.write_bytes(SMALL)
    settings = kissgs.Settings.model_validate(options.model_dump(include=set(kissgs.Settings.model_fields)))
    kissgs.compress(
        scene,
        settings=settings,
        evaluate=options.evaluate,
        progress=lambda stage, fraction, note="": reported.append(stage),
    )
    assert in_node(options)[0]["stages"] == list(dict.fromkeys(reported))


def test_time_alone_trains_only_where_the_server_can():
    options = parse_options('{"time_limit": "2min"}')
    assert "finetune" in in_node(options)[0]["stages"]
    assert "finetune" not in in_node(options, training=False)[0]["stages"]
    assert "codebook" not in in_node(options, sh_degree=0)[0]["stages"]


LABELS = [
    ({"preset": "fast"}, ""),
    (
        {"encode": {"target_size": "3MB", "max_psnr_drop": 0.1, "max_ssim_drop": 0.003}, "time_limit": "2min"},
        " · at most 3.00 MB · at most 0.1 dB PSNR loss · at most 0.003 SSIM loss"
        " · keep as many as the goal needs · fine-tuning · at most 2 min",
    ),
    ({"encode": {"psnr": 42}, "time_limit": 90}, " · at least 42 dB PSNR · at most 1 min 30 s"),
    ({"compact": {"ratio": 0.125}, "finetune": {"enabled": True}}, " · keep 12.5 % · fine-tuning"),
    ({"compact": {"ratio": 1}}, ""),
    ({"compact": {"count": 5000}}, " · keep 5,000"),
    ({"compact": {"max_psnr_drop": 0.2}}, " · keep as few as lose at most 0.2 dB PSNR"),
    (
        {"encode": {"psnr": 42}, "compact": {"auto_count": True}},
        " · at least 42 dB PSNR · keep as many as the goal needs",
    ),
]


def test_jobs_are_described_completely():
    chosen = [parse_options(json.dumps(options)) for options, _ in LABELS]
    for said, options, (_, label) in zip(in_node(*chosen), chosen, LABELS, strict=True):
        assert said["label"] == f"300 Gaussians · {options.preset} preset · SOG-XT{label}"
