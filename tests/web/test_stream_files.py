"""Files of streamed scenes in the preview: manifests, which files are held, what is drawn of them meanwhile."""

import copy
import itertools
import json

import numpy as np
from helpers.web_tools import run_node


def ask(**job):
    return json.loads(run_node("stream_files.mjs", json.dumps(job)))


def leaf(number, counts, errors=None):
    """Return a leaf of a row of unit cubes, whose level k is in file k, of leaves of equal counts."""
    lods = {str(k): {"file": k, "offset": number * count, "count": count} for k, count in enumerate(counts)}
    node = {"bound": {"min": [number, 0, 0], "max": [number + 1, 1, 1]}, "lods": lods}
    return node if errors is None else {**node, "errors": errors}


def manifest(leaves, levels, **others):
    names = [f"{level}_0/meta.json" for level in range(levels)]
    return {"version": 1, "lodLevels": levels, "filenames": names, "tree": {"children": leaves}, **others}


GOOD = manifest([leaf(0, [40, 20, 10], [0, 0.1, 0.2]), leaf(1, [40, 20, 10], [0, 0.2, 0.3])], 3)


def test_a_manifest():
    """One of ours; and an older one without errors and version, with an environment."""
    foreign = {**manifest([leaf(0, [40, 20, 10])], 3, environment="sky/meta.json"), "version": None}
    tree, other = ask(manifests=[json.dumps(GOOD), json.dumps(foreign)])["trees"]
    assert [tree[key] for key in ("levels", "count", "rows", "environment")] == [3, 80, [80, 40, 20], None]
    assert [level["level"] for level in tree["leaves"][1]["levels"]] == [2, 1, 0]
    assert tree["leaves"][1]["levels"][1] == {"level": 1, "file": 1, "offset": 20, "count": 20, "error": 0.2}
    assert (tree["leaves"][1]["low"], tree["leaves"][1]["high"]) == ([1, 0, 0], [2, 1, 1])
    assert other["files"][other["environment"]] == "sky/meta.json"
    errors = [level["error"] for level in other["leaves"][0]["levels"]]
    assert errors[2] == 0
    assert np.allclose(errors[:2], [np.sqrt(2), 1])


def test_addresses_of_manifests():
    names = ["https://x/city/lod-meta.json", "https://x/lod-meta.json?key=1", "https://x/a/levels.json"]
    others = ["https://x/city/meta.json", "https://x/lod-meta.json/", "https://x/?lod-meta.json", "https://x/a.zip"]
    assert ask(addresses=names + others)["streamed"] == [True] * 3 + [False] * 4


LEAF = ("tree", "children", 0)


DAMAGED = [
    (("version",), 2, "version 2"),
    (("lodLevels",), 0, "number of levels"),
    (("lodLevels",), 1e9, "number of levels"),
    (("filenames",), None, "names no files"),
    *(
        (("filenames", 0), name, "not below its folder")
        for name in ("../a", "/a", "https://x/a", "a/../b", 5, "a\\b", " ../a", "a/.. ", "a/.\t./.\n./b")
    ),
    (("environment",), "../sky", "not below its folder"),
    (("filenames", 0), "1_0/meta.json", "names a file twice"),
    (("filenames",), ["a", "\ud800", "\ud801"], "names a file twice"),
    (("environment",), "0_0/meta.json", "names a file twice"),
    (("tree",), None, "none"),
    (("tree", "children"), [], "no leaves"),
    (LEAF, 5, "none"),
    ((*LEAF, "bound"), None, "no bounds"),
    ((*LEAF, "bound", "min"), [0, 0], "no bounds"),
    ((*LEAF, "lods", "7"), {"file": 0, "offset": 0, "count": 1}, "levels are unclear"),
    ((*LEAF, "lods", "0", "file"), 3, "levels are unclear"),
    ((*LEAF, "lods", "0", "count"), -1, "levels are unclear"),
    ((*LEAF, "lods", "0"), None, "levels are unclear"),
    ((*LEAF, "lods", "0", "offset"), 2**50, "more rows than a file may have"),
]


def changed(path, value):
    document = place = copy.deepcopy(GOOD)
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = value
    return json.dumps(document)


def test_damaged_manifests():
    found = ask(manifests=[changed(path, value) for path, value, _ in DAMAGED])["trees"]
    for tree, (path, _, why) in zip(found, DAMAGED, strict=True):
        assert why in tree["error"], path
        assert tree["error"].startswith("The list of this scene's files is damaged: ")


def test_a_manifest_of_very_many_leaves_and_files():
    """The whole is one flat list of leaves, each with its own file."""
    count = 130_000
    leaves = [{"bound": GOOD["tree"]["children"][0]["bound"], "lods": {"0": {"file": n, "offset": 0, "count": 1}}}
              for n in range(count)]  # fmt: skip
    document = {"lodLevels": 1, "filenames": [f"{n}" for n in range(count)], "tree": {"children": leaves}}
    assert ask(rooms=[json.dumps(document)])["rooms"] == [count + 1]


def test_what_is_no_manifest():
    found = ask(manifests=["", "[]", "null", "{", '{"lodLevels":1,"filenames":["a"],"tree":' + '{"children":[' * 5000])
    assert all("is damaged" in tree["error"] for tree in found["trees"])


def plan_of(rng, leaves=6, levels=3):
    """Return a random plan: level k of 2^k neighbouring leaves shares a file, the coarsest is in a file of all."""
    made, names, sizes = [], {}, []
    for number in range(leaves):
        errors = np.sort(rng.uniform(0.01, 1, levels - 1))
        own = []
        for level in reversed(range(levels)):
            name = (level, 0 if level == levels - 1 else number >> level)
            file = names.setdefault(name, len(names))
            if file == len(sizes):
                sizes.append(0)
            count = 16 >> level
            own.append({"level": level, "file": file, "offset": sizes[file], "count": count})
            own[-1]["error"] = float(errors[level - 1]) if level else 0.0
            sizes[file] += count
        made.append(own)
    return {
        "leaves": made,
        "wanted": rng.integers(0, levels, leaves).tolist(),
        "areas": rng.uniform(0, 9, leaves).tolist(),
        "sizes": sizes,
    }


def gain_of(plan, files):
    """Return what files take from the squared errors."""
    total = 0.0
    for own, wanted, area in zip(plan["leaves"], plan["wanted"], plan["areas"], strict=True):
        best = max(at for at in range(wanted + 1) if at == 0 or own[at]["file"] in files)
        total += area * (own[0]["error"] ** 2 - own[best]["error"] ** 2)
    return total


def test_planned_files_are_nearly_the_best_that_fit():
    rng = np.random.default_rng(0)
    plans = [{**plan_of(rng), "room": int(rng.integers(0, 130))} for _ in range(40)]
    shares = []
    for plan, files in zip(plans, ask(plans=plans)["planned"], strict=True):
        sizes = plan["sizes"]
        assert sum(sizes[file] for file in files) <= plan["room"]
        subsets = itertools.chain.from_iterable(itertools.combinations(range(1, len(sizes)), n) for n in range(9))
        fitting = (some for some in subsets if sum(sizes[file] for file in some) <= plan["room"])
        best = max(gain_of(plan, some) for some in fitting)
        own = gain_of(plan, files)
        assert own >= 0.5 * best
        shares.append(own / best if best else 1)
        assert all(gain_of(plan, [one for one in files if one != file]) < own for file in files)
    assert np.mean(shares) > 0.97


def test_with_room_all_wanted_levels_are_planned_and_no_others():
    plan = {**plan_of(np.random.default_rng(3)), "room": 10**6}
    ((files),) = ask(plans=[plan])["planned"]
    wanted = {own[at]["file"] for own, at in zip(plan["leaves"], plan["wanted"], strict=True) if at}
    assert set(files) == wanted


def test_files_that_are_held_are_preferred_and_lost_ones_avoided():
    level = {"level": 0, "offset": 0, "count": 10, "error": 0.0}
    leaves = [[{**level, "file": 0, "error": 1.0}, {**level, "file": file}] for file in (1, 2)]
    plan = {"leaves": leaves, "wanted": [1, 1], "areas": [1, 1.1], "sizes": [20, 10, 10], "room": 10}
    assert ask(plans=[plan, {**plan, "held": [1]}, {**plan, "lost": [2]}])["planned"] == [[2], [1], [1]]


def test_the_store_of_files():
    job = {
        "sizes": [5, 10, 10, 10, 10],
        "room": 25,
        "most": 2,
        "steps": [
            {"want": [0, 1, 2]},
            {"arrive": 0},
            {"want": [0, 1, 2]},  # what loads goes on
            {"arrive": 1},
            {"want": [0, 3]},  # 2 is cancelled
            {"arrive": 3},
            {"want": [0, 3, 4]},  # 1 makes room, which was wanted longest ago
            {"fail": 4},
            {"want": [0, 3, 4]},
            {"fail": 4},
            {"want": [0, 3, 4]},
        ],
    }
    states = ask(store=job)["states"]
    logs = [state["log"] for state in states]
    assert logs[:6] == [["load 0", "load 1"], ["changed"], ["load 2"], ["changed"], ["cancel 2", "load 3"], ["changed"]]
    assert logs[6:] == [["load 4"], ["changed"], ["load 4"], ["lost 4: broken", "changed"], []]
    assert [state["held"] for state in states][5:7] == [[0, 1, 3], [0, 3]]
    assert states[-1]["idle"]
    assert states[-1]["held"] == [0, 3]


def test_a_failure_before_a_success_is_forgotten():
    """A file fails, arrives, makes room for another one, and fails again: it is asked for once more."""
    steps = [{"want": [0]}, {"fail": 0}, {"want": [0]}, {"arrive": 0}, {"want": [1]}, {"arrive": 1}]
    steps += [{"want": [0]}, {"fail": 0}, {"want": [0]}, {"arrive": 0}]
    states = ask(store={"sizes": [5, 5], "room": 5, "most": 1, "steps": steps})["states"]
    assert [state["log"] for state in states[6:]] == [["load 0"], ["changed"], ["load 0"], ["changed"]]
    assert states[-1]["held"] == [0]


def test_workers_keep_nothing_of_their_tasks():
    """Each task has a listener while it runs; afterwards there is none, whether the worker answers or fails."""
    good, broken = ask(pooled=[True, False])["pools"]
    assert good == {"ends": ["a", "b", "c"], "most": 3, "now": 0}
    assert broken == {"ends": ["a:", "b:", "c:"], "most": 3, "now": 0}


def camera(eye, width=200, height=100, focal=100.0):
    """Return a camera that looks along z, with y up, in the form of the page."""
    projection = np.array(
        [[2 * focal / width, 0, 0, 0], [0, 2 * focal / height, 0, 0], [0, 0, -1, -0.02], [0, 0, -1, 0]]
    )
    view = np.diag([1.0, 1, -1, 1])
    view[:3, 3] = -view[:3, :3] @ eye
    return {
        "matrix": (projection @ view).T.ravel().tolist(),
        "eye": list(eye),
        "focal": focal,
        "pixels": width * height,
    }


def test_every_leaf_is_drawn_once_in_every_state():
    """Eight cubes in a row; the camera passes by them, so that some are outside the image."""
    leaves = [leaf(number, [64, 16, 4], [0, 0.1, 0.2]) for number in range(8)]
    document = manifest(leaves, 3)
    cameras = [camera((x, 0.5, -1.2)) for x in (0.5, 1.5, 4.5, 7.5, 4.5)]
    states = ask(flight={"manifest": json.dumps(document), "budget": 200, "cameras": cameras})["flown"]
    for number in range(len(cameras)):
        assert [state for state in states if state["camera"] == number][-1]["complete"]
    assert not states[0]["begun"]
    assert states[0]["drawn"] == []
    for state in states[1:]:
        assert state["begun"]
        counts = {0: 64, 1: 16, 2: 4}
        places = [(file, at // counts[file]) for file, own in state["drawn"] for at, _ in own]
        assert sorted(number for _, number in places) == list(range(8))
        assert all(n == counts[file] for file, own in state["drawn"] for _, n in own)
        assert sum(counts[file] for file, _ in places) <= 200
    last = {
        number: file
        for file, own in states[-1]["drawn"]
        for at, _ in own
        for number in [at // {0: 64, 1: 16, 2: 4}[file]]
    }
    assert last[4] == 0  # in the middle of the image
    finest = [{at // 64 for file, own in state["drawn"] if file == 0 for at, _ in own} for state in states]
    assert 4 in finest[-1]  # in the middle of the image
    assert any(7 in some for some in finest)
    assert 0 not in finest[-1]


def test_an_environment_is_drawn_always_and_counts():
    leaves = [leaf(number, [64, 16, 4], [0, 0.1, 0.2]) for number in range(2)]
    document = manifest(leaves, 3, environment="sky/meta.json")
    job = {"manifest": json.dumps(document), "cameras": [camera((1, 0.5, -1.2))], "environmentRows": 100}
    poor = ask(flight={**job, "budget": 140})["flown"]
    rich = ask(flight={**job, "budget": 230})["flown"]
    assert not poor[1]["begun"]  # the leaves have arrived, the environment has not
    for states, files in ((poor, {1, 3}), (rich, {0, 3})):
        last = dict(states[-1]["drawn"])
        assert set(last) == files
        assert last[3][0][0] == 0
        assert [state["surrounding"] for state in states[:2] + states[-1:]] == [0, 0, 100]


def test_a_file_with_too_few_rows():
    document = manifest([leaf(0, [64, 16, 4]), leaf(1, [64, 16, 4])], 3)
    job = {"manifest": json.dumps(document), "budget": 999, "cameras": [camera((1, 0.5, -1.2))], "short": [0]}
    states = ask(flight=job)["flown"]
    (problem,) = [state["problem"] for state in states if "problem" in state]
    assert problem[0] == 0
    assert "0_0/meta.json has 127 Gaussians, fewer than" in problem[1]
    assert dict(states[-1]["drawn"]).keys() == {1}
    assert states[-1]["prepared"] == [2, 1]  # the page keeps only these for its first camera


def test_a_lost_file_is_lacking_only_while_a_view_needs_it():
    """The camera sees two leaves, then two others."""
    leaves = [leaf(number, [64, 16, 4]) for number in (0, 1, 50, 51)]
    for number, each in enumerate(leaves):
        for level in each["lods"].values():
            level.update(offset=number % 2 * level["count"], file=level["file"] + number // 2 * 3)
    document = {**manifest(leaves, 3), "filenames": [f"{file}.sog" for file in range(6)]}
    cameras = [camera((x, 0.5, -1.2)) for x in (1, 51, 1)]

    def flown(short):
        job = {"manifest": json.dumps(document), "budget": 999, "cameras": cameras, "short": [short]}
        return [state for state in ask(flight=job)["flown"] if "camera" in state]

    states = flown(2)  # the coarsest of the first two leaves
    assert [] in [state["lacking"] for state in states]
    assert [2] in [state["lacking"] for state in states]
    assert states[-1]["lacking"] == []
    assert 0 in dict(states[-1]["drawn"])

    states = flown(0)  # the finest of them
    last = [[state for state in states if state["camera"] == number][-1]["lacking"] for number in range(3)]
    assert last == [[0], [], [0]]
