"""Every stage at every extreme. Oracle: reference implementations in float64 (tests/helpers/reference_*.py)."""

import re
import runpy
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import extreme_stages, reference_float64, reference_rasterizer
from helpers.extreme_containers import BACKGROUND, BY_NAME, given, scene
from helpers.extreme_stages import STAGES, measured
from helpers.extremes import BOUNDS, EXTREMES
from helpers.reference_training import adam
from helpers.render_scenes import in_float64

from kissgs.compaction import regularizers
from kissgs.core.splats import ATTRIBUTES

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "reference" / "numerics.md"
NAMES = list(BY_NAME)
HERE = [stage for stage in STAGES if stage != "browser"]


@pytest.mark.parametrize("stage", HERE)
@pytest.mark.parametrize("name", NAMES)
def test_a_stage_keeps_its_promise(name, stage):
    assert measured(name, stage) <= BY_NAME[name].bound(stage)


def test_the_javascript_decoder_keeps_its_promise():
    """One process of Node decodes all rows."""
    assert {name: measured(name, "browser") for name in NAMES if measured(name, "browser") > BOUNDS["browser"]} == {}


def test_names_are_unique_and_rows_have_bounds_of_stages():
    assert len(BY_NAME) == len(EXTREMES)
    assert set(BOUNDS) == set(STAGES)
    assert all(set(extreme.bounds) <= set(STAGES) for extreme in EXTREMES)


UNSEEN = {"transparent", "count-0", "beside"}


@pytest.mark.parametrize("name", NAMES)
def test_the_oracles_agree_and_there_is_something_to_see(name):
    """The image that torch differentiates is that of the naive rasteriser, and shows the row's Gaussians."""
    splats, view = scene(name)[0], BY_NAME[name].camera()
    found = reference_float64.draw(reference_float64.tensors(splats), view, BACKGROUND)
    naive = reference_rasterizer.draw(in_float64(splats), view, np.array(BACKGROUND))
    bright = max([1.0, *(layer[3].max() for layer in naive.layers)])
    sure = found.sure & ~naive.doubtful
    np.testing.assert_allclose(found.image.numpy()[sure] / bright, naive.image[sure] / bright, atol=1e-9)
    assert (naive.alpha.max() > 0.1) == (name not in UNSEEN)
    assert found.ended.any() == (name in ("opaque", "layers"))


def test_the_oracles_gradient_is_that_of_differences():
    splats, view = scene("degree-2")[0], BY_NAME["degree-2"].camera()
    leaves, rng = reference_float64.tensors(splats, leaf=True), np.random.default_rng(0)
    v_image, v_alpha = rng.normal(size=(32, 48, 3)), rng.normal(size=(32, 48))
    found = reference_float64.draw(leaves, view, BACKGROUND)
    ((found.image * torch.from_numpy(v_image)).sum() + (found.alpha * torch.from_numpy(v_alpha)).sum()).backward()
    wanted = reference_rasterizer.gradient_by_differences(
        in_float64(splats), view, np.array(BACKGROUND), v_image, v_alpha
    )
    for name in ATTRIBUTES:
        np.testing.assert_allclose(
            leaves[name].grad.numpy(), wanted[name], rtol=1e-5, atol=1e-6 * np.abs(wanted[name]).max()
        )


def test_the_oracles_removal_is_an_image_without():
    splats, view, background = scene("ordinary")[0], BY_NAME["ordinary"].camera(), np.array(BACKGROUND)
    params = in_float64(splats)
    whole = reference_rasterizer.draw(params, view, background).image
    others = [reference_rasterizer.draw(params, view, background, removed=n).image for n in range(len(splats))]
    wanted = [np.square(image - whole).sum() for image in others]
    found = reference_float64.removed(
        reference_float64.draw(reference_float64.tensors(splats), view, background), len(splats), background
    )
    np.testing.assert_allclose(found, wanted, rtol=1e-9)


def test_the_oracles_adam_is_that_of_torch():
    rng = np.random.default_rng(0)
    leaf = torch.from_numpy(rng.normal(size=9)).requires_grad_()
    mine, moments = leaf.detach().clone(), (torch.zeros(9).double(), torch.zeros(9).double())
    theirs = torch.optim.Adam([leaf], lr=0.1, eps=1e-15)
    for step in range(1, 6):
        leaf.grad = torch.from_numpy(rng.normal(size=9))
        mine = adam(mine, leaf.grad, moments, step, 0.1)
        theirs.step()
    torch.testing.assert_close(mine, leaf.detach(), rtol=1e-12, atol=0)


# The table can fail: what was once wrong, or could be, is noticed at the rows that are about it.


@pytest.fixture
def anew():
    """Clear the caches of scenes before and after the test."""
    for function in (given, scene):
        function.cache_clear()
    yield
    for function in (given, scene):
        function.cache_clear()


def broken(stage):
    """Rows whose promise a stage breaks."""
    return {name for name, extreme in BY_NAME.items() if not STAGES[stage](name) <= extreme.bound(stage)}


@pytest.mark.usefixtures("anew")
def test_a_lost_limit_of_positions_is_noticed(monkeypatch):
    monkeypatch.setattr("kissgs.core.splats.MEAN_LIMIT", 3e38)
    assert broken("clean") == {"beyond-1e15"}


@pytest.mark.usefixtures("anew")
def test_rotations_normalised_in_float32_are_noticed(monkeypatch):
    def hasty(quats):
        with np.errstate(over="ignore", under="ignore", invalid="ignore"):
            norm = np.sqrt((quats * quats).sum(axis=1))
            unit = np.where(norm[:, None] > 0, quats / np.where(norm > 0, norm, 1)[:, None], np.float32([1, 0, 0, 0]))
        return unit, int((norm == 0).sum()), int(((norm > 0) & (np.abs(norm - 1) > 1e-3)).sum())

    monkeypatch.setattr("kissgs.core.splats._unit_quats", hasty)
    assert broken("clean") == {"short-quaternions", "long-quaternions", "denormal"}


def test_effective_rank_by_the_book_is_noticed(monkeypatch):
    """The paper's formula uses squares of float32."""

    def by_the_book(scales):
        squares = (2 * scales).exp()
        share = squares / squares.sum(dim=1, keepdim=True)
        entropy = -(share * share.log()).sum(dim=1)
        return (-torch.log(entropy.exp() - 1 + regularizers.EPSILON)).clamp_min(0)

    monkeypatch.setattr(extreme_stages, "erank_loss", by_the_book)
    assert broken("rank") >= {"needles", "cauchy"}


# The page


def between_the_marks():
    """Return what ``python docs/numerics.py`` has written into the page."""
    return PAGE.read_text(encoding="utf-8").partition("<!-- measured -->\n")[2].partition("<!-- end -->")[0]


def test_the_page_has_every_stage_within_what_is_promised():
    found = re.findall(r"^\| `(\w+)` \| .+ \| ≤ (\S+) \| (\S+) \| `(.+)` \|$", between_the_marks(), re.MULTILINE)
    own = [(stage, bound) for extreme in EXTREMES for stage, bound in extreme.bounds.items()]
    assert sorted((stage, float(bound)) for stage, bound, _, _ in found) == sorted([*BOUNDS.items(), *own])
    for stage, _, largest, name in found:
        assert float(largest) <= BY_NAME[name].bound(stage), f"{name}, {stage}"


def test_the_page_has_every_row():
    rows = runpy.run_path(str(ROOT / "docs" / "numerics.py"))["rows"]()
    assert between_the_marks().endswith(rows), "run: python docs/numerics.py"


def test_every_promise_of_the_page_names_a_test_that_exists():
    """The last cell of each row of the other tables: `file::test`, several with commas."""
    text = PAGE.read_text(encoding="utf-8")
    rows = [line for line in text.partition("<!-- end -->")[2].splitlines() if line.startswith("|")]
    rows = [row for row in rows if not row.endswith("| test |") and not re.match(r"\|[-|]+\|$", row)]
    assert len(rows) > 20
    for row in rows:
        named = re.findall(r"`(\w+)::(\w+)`", row.rsplit(" | ", 1)[1])
        assert named, row
        for module, function in named:
            files = [file.read_text(encoding="utf-8") for file in (ROOT / "tests").glob(f"**/{module}.py")]
            assert sum(f"def {function}(" in text for text in files) == 1, f"{module}::{function}"
