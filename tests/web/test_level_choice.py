"""The preview's choice of levels of detail. Oracles: all combinations of levels; points projected one by one."""

import itertools
import json

import numpy as np
from helpers.viewers import page_camera
from helpers.web_tools import run_node

MANY = 10**6
"""Pixels that make no level superfluous."""


def leaf_of(counts, errors):
    """Return the levels of a leaf, the coarsest first, with the file number as its level."""
    levels = range(len(counts) - 1, -1, -1)
    return [
        {"level": level, "file": level, "offset": 0, "count": int(count), "error": float(error)}
        for level, count, error in zip(levels, counts, errors, strict=True)
    ]


def random_leaves(rng, leaves, levels, step=None):
    """Return leaves whose errors fall with diminishing returns; with ``step``, each level costs that much more."""
    made = []
    for _ in range(leaves):
        gains = np.sort(rng.exponential(1, levels - 1))[::-1]
        costs = np.full(levels - 1, step) if step else rng.integers(1, 6, levels - 1)
        squares = np.append(np.cumsum(gains[::-1])[::-1], 0)
        made.append(leaf_of(np.cumsum([1, *costs]), np.sqrt(squares)))
    return made


def choose(*jobs):
    return json.loads(run_node("choose_levels.mjs", json.dumps({"choices": jobs})))["chosen"]


def totals(job, chosen):
    """Return the Gaussians of a choice, and its squared error over all pixels."""
    levels = [leaf[at] for leaf, at in zip(job["leaves"], chosen, strict=True)]
    error = sum(area * level["error"] ** 2 for area, level in zip(job["areas"], levels, strict=True))
    return sum(level["count"] for level in levels), error


def least_error(job):
    """Return the least squared error within the budget, by trying all combinations."""
    options = itertools.product(*(range(len(leaf)) for leaf in job["leaves"]))
    found = (totals(job, chosen) for chosen in options)
    return min(error for count, error in found if count <= job["budget"])


def test_equal_steps_are_chosen_as_well_as_possible():
    rng = np.random.default_rng(0)
    jobs = [
        {"leaves": random_leaves(rng, 5, 4, step=3), "areas": rng.uniform(MANY, 9 * MANY, 5).tolist(), "budget": budget}
        for budget in range(5, 55, 4)
    ]
    for job, chosen in zip(jobs, choose(*jobs), strict=True):
        count, error = totals(job, chosen)
        assert count <= job["budget"]
        assert np.isclose(error, least_error(job), rtol=1e-9)


def test_other_steps_lose_less_than_one_step():
    """The known bound of the greedy solution: what the largest step would have gained."""
    rng = np.random.default_rng(1)
    jobs = [
        {
            "leaves": random_leaves(rng, 4, 4),
            "areas": rng.uniform(MANY, 9 * MANY, 4).tolist(),
            "budget": int(rng.integers(4, 50)),
        }
        for _ in range(60)
    ]
    exact = 0
    for job, chosen in zip(jobs, choose(*jobs), strict=True):
        count, error = totals(job, chosen)
        largest = max(
            area * (coarse["error"] ** 2 - fine["error"] ** 2)
            for leaf, area in zip(job["leaves"], job["areas"], strict=True)
            for coarse, fine in itertools.pairwise(leaf)
        )
        best = least_error(job)
        assert count <= job["budget"]
        assert best - 1e-9 <= error <= best + largest
        exact += bool(np.isclose(error, best))
    assert exact > 30


def test_a_useful_level_behind_a_useless_one_is_found():
    leaf = leaf_of([1, 2, 3], [0.5, 0.5, 0])
    assert choose({"leaves": [leaf], "areas": [MANY], "budget": 3}) == [[2]]
    assert choose({"leaves": [leaf], "areas": [MANY], "budget": 2}) == [[0]]


def test_what_limits_a_leaf():
    leaf = leaf_of([10, 20, 40], [0.2, 0.1, 0])
    jobs = [
        {"leaves": [leaf], "areas": [0], "budget": 99},  # not visible
        {"leaves": [leaf], "areas": [15], "budget": 99},  # the second level has a Gaussian per pixel
        {"leaves": [leaf], "areas": [21], "budget": 99},
        {"leaves": [leaf], "areas": [MANY], "budget": 5},  # the coarsest level is drawn in any case
        {"leaves": [leaf], "areas": [MANY], "budget": 99, "files": [2, 0]},
        {"leaves": [leaf], "areas": [MANY], "budget": 99, "files": [1]},
        {"leaves": [leaf], "areas": [MANY], "budget": 99, "files": []},
    ]
    assert choose(*jobs) == [[0], [1], [2], [0], [2], [1], [-1]]


def test_a_level_in_use_is_kept_until_another_is_clearly_better():
    leaf = leaf_of([10, 20], [0.1, 0])
    two = {"leaves": [leaf, leaf], "budget": 30}
    jobs = [
        {**two, "areas": [MANY, 1.1 * MANY]},
        {**two, "areas": [MANY, 1.1 * MANY], "current": [1, 0]},
        {**two, "areas": [MANY, 1.4 * MANY], "current": [1, 0]},
        {**two, "areas": [9, 9], "current": [1, 0]},
        {**two, "areas": [7, 9], "current": [1, 0]},
    ]
    assert choose(*jobs) == [[0, 1], [1, 0], [0, 1], [1, 0], [0, 0]]


def test_areas_and_the_frustum():
    """Boxes are filled with points; of visible boxes, some are in the image. Areas are those of turned cubes."""
    rng = np.random.default_rng(2)
    size, focal = (300, 200), 250.0
    views = []
    for _ in range(6):
        view = np.eye(4)
        view[:3, :3] = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        view[:3, 3] = rng.normal(0, 2, 3)
        lows = rng.uniform(-6, 6, (60, 3))
        boxes = [{"low": low.tolist(), "high": (low + rng.uniform(0.05, 2, 3)).tolist()} for low in lows]
        views.append({**page_camera(view, size, focal), "boxes": boxes})
    cube = {"low": [-0.5, -0.5, 9.5], "high": [0.5, 0.5, 10.5]}
    straight = {**page_camera(np.eye(4), size, focal), "matrix": np.eye(4).ravel().tolist(), "boxes": [cube]}
    *seen, (found,) = json.loads(run_node("choose_levels.mjs", json.dumps({"views": [*views, straight]})))["seen"]
    hidden = 0
    for view, answers in zip(views, seen, strict=True):
        for each, box in zip(view["boxes"], answers, strict=True):
            sides = np.linspace(each["low"], each["high"], 9).T
            grid = np.stack(np.meshgrid(*sides, [1]), axis=-1).reshape(-1, 4)
            clip = grid @ np.reshape(view["matrix"], (4, 4))
            inside = (clip[:, 3] > 0) & (np.abs(clip[:, :2]) <= clip[:, 3:]).all(axis=1)
            assert not (box["outside"] and inside.any())
            hidden += box["outside"]
            assert 0 < box["area"] <= size[0] * size[1]
    assert 180 < hidden < 350  # of 360 boxes: cameras see less than a half of the space

    turns = [np.linalg.qr(rng.normal(size=(3, 3)))[0] for _ in range(2000)]
    shadows = [np.abs(turn).sum(axis=1)[2] for turn in turns]  # of a unit cube: sum of |normal components|
    assert abs(found["area"] / (focal / 10) ** 2 - np.mean(shadows)) < 0.02
