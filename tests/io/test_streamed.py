"""Streamed scenes. Oracle: the containers decoded one by one."""

import json
import shutil

import numpy as np
import pytest
from helpers.format_scenes import made_scene
from helpers.reference_sog import write_folder, zip_of
from helpers.streamed_scenes import KINDS, SOGXT

from kissgs.core.errors import InvalidContainerError, KissgsError, UnsupportedError
from kissgs.core.splats import ATTRIBUTES
from kissgs.io.scene_format import ReadOptions
from kissgs.pipeline.scene_files import describe

LEVELS = [[made_scene(65, 2), made_scene(40, 1)], [made_scene(20, 1)], [made_scene(3, 0)]]
ENVIRONMENT = made_scene(7, 1)


@pytest.fixture(scope="module", params=KINDS)
def kind(request):
    return KINDS[request.param]


@pytest.fixture(scope="module")
def files(kind):
    return kind.files(LEVELS, environment=ENVIRONMENT)


def joined(kind, scenes):
    """Return the decoded containers one after another, lower degrees filled with zeros."""
    found = [kind.decode_one(scene) for scene in scenes]
    most = max(s.shN.shape[1] for s in found)
    arrays = {name: np.concatenate([getattr(s, name) for s in found]) for name in ATTRIBUTES if name != "shN"}
    arrays["shN"] = np.concatenate([np.pad(s.shN, ((0, 0), (0, most - s.shN.shape[1]), (0, 0))) for s in found])
    return arrays


@pytest.mark.parametrize("level", [0, 1, 2])
def test_every_level_with_the_environment(kind, files, level):
    found = kind.decode(files, level=level)
    for name, wanted in joined(kind, [*LEVELS[level], ENVIRONMENT]).items():
        np.testing.assert_array_equal(getattr(found, name), wanted)


def test_folders_and_zips(kind, files, tmp_path):
    wanted = kind.decode(files)
    packed = tmp_path / "a.zip"
    packed.write_bytes(zip_of(files))
    for source in (write_folder(files, tmp_path / "folder"), packed, zip_of(files, folder="a/b/")):
        np.testing.assert_array_equal(kind.decode(source).means, wanted.means)


def edited(kind, files, change):
    meta = json.loads(files[kind.manifest])
    change(meta)
    return {**files, kind.manifest: json.dumps(meta).encode()}


def leaf(meta, number=0, level="0"):
    return meta["tree"]["children"][number]["lods"][level]


def test_rows_that_no_leaf_names_are_left_out(kind, files):
    whole = kind.decode(files)
    found = kind.decode(edited(kind, files, lambda meta: leaf(meta, 1).update(offset=5, count=10)))
    kept = np.r_[5:15, 32:112]
    np.testing.assert_array_equal(found.means, whole.means[kept])
    np.testing.assert_array_equal(found.shN, whole.shN[kept])


def test_old_files_without_a_version(kind, files):
    found = kind.decode(edited(kind, files, lambda meta: (meta.pop("version"), meta.update(environment=None))))
    assert len(found) == 105


CHANGES = {
    "there is no level 3; this scene has levels 0 (the finest) to 2": None,
    "MANIFEST is of version '2'; version 1 is read": lambda m: m.update(version=2),
    "MANIFEST: it is no JSON object": 7,
    "lodLevels is not a whole number from 1 to 64": lambda m: m.update(lodLevels=0),
    "it lacks the list 'filenames'": lambda m: m.pop("filenames"),
    "it names a file that is not below its folder": lambda m: m["filenames"].append("../x/a"),
    "names files on the web": lambda m: m.update(environment="https://example.org/a"),
    "it names the file FIRST twice": lambda m: m["filenames"].append(m["filenames"][0]),
    "it names the file ././FIRST twice": lambda m: m["filenames"].append("././" + m["filenames"][0]),
    "it names the file x\\a twice": lambda m: m["filenames"].extend(["x//a", "x\\a"]),
    "it names the file env": lambda m: m["filenames"].append(m["environment"]),
    "two leaves share rows of FIRST": lambda m: leaf(m).update(offset=10),
    "a leaf names rows up to 1,000 of FIRST, which has 65": lambda m: leaf(m).update(count=968),
    "a leaf has a level that is not 0 to 2": lambda m: m["tree"]["children"][0]["lods"].update({"3": {}}),
    "a leaf does not name a file, an offset and a count": lambda m: leaf(m).update(file=99),
    "its tree has a node that is no JSON object": lambda m: m["tree"]["children"].append(1),
    "levels or children are of the wrong kind": lambda m: m["tree"]["children"].append({"lods": []}),
    "the container has no file 'x/a'": lambda m: m["filenames"].__setitem__(0, "x/a"),
}


@pytest.mark.parametrize(("message", "change"), list(CHANGES.items()), ids=list(CHANGES))
def test_damaged_trees(kind, files, message, change):
    first = json.loads(files[kind.manifest])["filenames"][0]
    damaged = edited(kind, files, change) if callable(change) else files
    damaged = {**files, kind.manifest: b"7"} if change == 7 else damaged
    with pytest.raises(KissgsError) as error:
        kind.decode(damaged, level=3 if change is None else 0)
    assert message.replace("MANIFEST", kind.manifest).replace("FIRST", first) in str(error.value)
    assert "\n" not in str(error.value)


def test_limits_and_depth(kind, files):
    with pytest.raises(UnsupportedError, match=r"level 0 has 112 Gaussians; the limit is 111"):
        kind.decode(files, max_gaussians=111)
    deep = b'{"lodLevels": 1, "filenames": [], "tree": ' + b'{"children": [' * 100_000
    with pytest.raises(InvalidContainerError, match=rf"{kind.manifest} is not readable JSON"):
        kind.decode({kind.manifest: deep})


def test_zips_that_are_no_sogxt_containers_are_named():
    files = SOGXT.files([[made_scene(9, 1)]])
    without_count = zip_of({"meta.json": b"{}"})
    for data, message in {
        b"no zip": "0_0.zip is not a readable zip file",
        files["0_0.zip"][:-30]: "0_0.zip is not a readable zip file",
        zip_of({}): "it has neither container_meta.yaml nor meta.json",
        without_count: "meta.json lacks something",
    }.items():
        with pytest.raises(InvalidContainerError) as error:
            SOGXT.decode({**files, "0_0.zip": data})
        assert message in str(error.value)
    with pytest.raises(UnsupportedError, match=r"levels\.json is of format 'sog'; format sog-xt is read"):
        SOGXT.decode(edited(SOGXT, files, lambda meta: meta.update(format="sog")))
    assert len(SOGXT.decode(edited(SOGXT, files, lambda meta: meta.update(format="sog-xt")))) == 9


@pytest.mark.parametrize("packed", [False, True])
def test_messages_about_files_name_the_scene(kind, files, tmp_path, packed):
    """The path is the one that was given, and stands there once."""
    first = json.loads(files[kind.manifest])["filenames"][0]
    scene = tmp_path / "city"
    whole = f"{scene}.zip" if packed else f"{scene}/{kind.manifest}"
    begins = f"{whole}: {kind.manifest}" if packed else whole

    def refusal(damaged, level=0):
        scene.with_suffix(".zip").write_bytes(zip_of(damaged))
        source = scene.with_suffix(".zip") if packed else write_folder(damaged, scene)
        with pytest.raises(KissgsError) as error:
            kind.decode(source, level=level)
        with pytest.raises(type(error.value)) as described:
            describe(source, ReadOptions(level=level))
        shutil.rmtree(scene, ignore_errors=True)
        assert str(described.value) == str(error.value)
        return str(error.value)

    lost = {name: data for name, data in files.items() if name != first}
    assert refusal(lost) == f"{whole}: the container has no file {first!r}; export or download it again"
    cut = {**files, kind.manifest: files[kind.manifest][:-9]}
    assert refusal(cut) == f"{begins} is not readable JSON; export the scene again"
    assert refusal(files, 3).startswith(f"{whole}: there is no level 3")
