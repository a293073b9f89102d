"""The page's words about jobs and stages, in Node. Oracles: words for options; names in the terminal."""

import json

from helpers.web_tools import run_node

from kissgs.cli.files import STAGES
from service.http.submission import parse_options


def in_node(jobs=(), stages=()):
    """Return what the page says of jobs with options as the service stores them, and of stages."""
    stored = [{"options": each.model_dump(mode="json"), "gaussians": 300, "sh_degree": 1} for each in jobs]
    return json.loads(run_node("page_words.mjs", json.dumps({"jobs": stored, "stages": [*stages]})))


def test_stages_have_the_same_everyday_names_as_in_the_terminal():
    """A service makes no pages, images and streamed scenes, so that the page has no names for their stages."""
    names = {stage: name for name, stages in STAGES.items() for stage in stages}
    others = {"decode", "partition", "upload", "cluster", "scratch", "render", "html", "download"}
    jobs = [stage for stage in names if stage not in others]
    assert [name.lower() for name in in_node(stages=jobs)["stages"]] == [names[stage] for stage in jobs]
    assert in_node(stages=["a new stage"])["stages"] == ["a new stage"]


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
    for said, options, (_, label) in zip(in_node(chosen)["labels"], chosen, LABELS, strict=True):
        assert said == f"300 Gaussians · {options.preset} preset · SOG-XT{label}"
