"""Folders of streamed scenes behind the server of ``kissgs view``; oracle: the files of the folder."""

import json
import shutil
from pathlib import Path

import pytest
from helpers.page_server import ask, serving
from helpers.reference_sog import write_folder
from helpers.small_page import FILES
from helpers.streamed_scenes import SOG, write_small
from helpers.viewers import scattered

import kissgs
from kissgs import preview as module
from kissgs.core.errors import InvalidContainerError
from kissgs.preview import fitting_level, streamed_folder

NAME = "two words % & ü"


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("made")
    write_small(scattered(300, 1), folder / NAME / "lod-meta.json", chunk=200, leaf=50, coarsest=100)
    return folder / NAME


@pytest.fixture
def city(made, tmp_path):
    """A streamed scene with files that do not belong to it, one of them outside its folder."""
    shutil.copytree(made, tmp_path / NAME)
    (tmp_path / "secret.webp").write_bytes(b"secret")
    for name in ("notes.txt", "0_0/notes.txt", "0_0/other.webp", "lod-meta.json.bak"):
        (tmp_path / NAME / name).write_bytes(b"secret")
    return tmp_path / NAME


def served(folder):
    return {name: path.read_bytes() for name, path in streamed_folder(folder).files.items()}


def test_the_files_of_the_manifest_and_no_others(made, city):
    expected = {path.relative_to(made).as_posix(): path.read_bytes() for path in made.rglob("*") if path.is_file()}
    assert served(city) == served(city / "lod-meta.json") == expected
    assert len(expected) > 15
    assert streamed_folder(city).name == NAME
    assert streamed_folder(city).missing == ()


def test_files_out_of_reach_are_left_out(city, monkeypatch):
    """A link out of the folder, one to itself, and one in a closed folder, which root could read."""
    for name, target in (("0_0/quats.webp", city.parent / "secret.webp"), ("0_0/scales.webp", "scales.webp")):
        (city / name).unlink()
        (city / name).symlink_to(target)
    (city / "0_1" / "quats.webp").unlink()
    is_file = Path.is_file

    def closed(path):
        if path.name == "sh0.webp" and path.parent.name == "0_1":
            raise PermissionError(13, "Permission denied", str(path))
        return is_file(path)

    monkeypatch.setattr(Path, "is_file", closed)
    found = streamed_folder(city)
    assert found.missing == ("0_1/quats.webp",)
    assert set(found.unusable) == {"0_0/quats.webp", "0_0/scales.webp", "0_1/sh0.webp"}
    assert not {*found.missing, *found.unusable} & found.files.keys()
    assert {"0_0/sh0.webp", "0_1/scales.webp"} <= found.files.keys()


def test_damaged_metadata(city):
    """A container keeps the one file that is known of it; without a manifest there is nothing to show."""
    (city / "0_0" / "meta.json").write_text("{")
    assert [name for name in served(city) if name.startswith("0_0/")] == ["0_0/meta.json"]
    (city / "lod-meta.json").write_text("{")
    with pytest.raises(InvalidContainerError, match="not readable JSON"):
        streamed_folder(city)


def test_manifests_that_name_other_files(city):
    for name in ("../secret.webp", "/etc/passwd", "https://other/meta.json", "a/../../secret.webp"):
        document = json.loads((city / "lod-meta.json").read_bytes())
        document["filenames"][0] = name
        (city / "lod-meta.json").write_text(json.dumps(document))
        with pytest.raises(kissgs.KissgsError):
            streamed_folder(city)


def test_containers_that_are_one_file(city):
    document = json.loads((city / "lod-meta.json").read_bytes())
    document["filenames"][0] = "LEVEL_0.zip"
    document["environment"] = "sky.sog"
    (city / "lod-meta.json").write_text(json.dumps(document))
    (city / "LEVEL_0.zip").write_bytes(b"zip")
    (city / "sky.sog").write_bytes(b"sog")
    found = served(city)
    assert (found["LEVEL_0.zip"], found["sky.sog"]) == (b"zip", b"sog")


@pytest.fixture
def server(page_folder, city):
    with serving(streamed_folder(city)) as server:
        yield server


def test_the_server(server, city):
    source = server.url.partition("?src=")[2].replace("%25", "%")
    base = source.removesuffix("lod-meta.json")
    answer, body = ask(server, f"/{source}")
    assert (answer.status, body) == (200, (city / "lod-meta.json").read_bytes())
    answer, body = ask(server, f"/{base}0_0/means_l.webp")
    assert (answer.status, body) == (200, (city / "0_0" / "means_l.webp").read_bytes())
    assert ask(server, "/")[1].decode() == FILES["preview.html"]
    in_memory = {path for path, content in server.contents.items() if isinstance(content, bytes)}
    assert in_memory == {"/", "/preview.html"}
    others = ("notes.txt", "0_0/notes.txt", "0_0/other.webp", "0_0/", "", "../secret.webp", "0_0/%2e%2e/notes.txt")
    for path in others:
        assert ask(server, f"/{base}{path}")[0].status == 404
    assert ask(server, f"/{base}0_0/meta.json", Host="evil.example")[0].status == 403
    (city / "0_0" / "sh0.webp").unlink()
    assert ask(server, f"/{base}0_0/sh0.webp")[0].status == 404


def test_the_level_for_a_page_of_one_file(made, city, monkeypatch):
    counts = json.loads((made / "lod-meta.json").read_bytes())["counts"]
    assert fitting_level(made) == (0, len(counts))
    for most, level in ((counts[0], 0), (counts[0] - 1, 1), (counts[2], 2), (1, len(counts) - 1)):
        monkeypatch.setattr(module, "PAGE_GAUSSIANS", most)
        assert fitting_level(made)[0] == level
    shutil.make_archive(str(city.parent / "zipped"), "zip", city)
    assert fitting_level(city.parent / "zipped.zip") == fitting_level(made)
    assert streamed_folder(made) == streamed_folder(made / "lod-meta.json")
    for other in (city.parent / "zipped.zip", made / "0_0", Path("none")):
        assert streamed_folder(other) is None


def test_the_level_for_a_page_counts_the_environment(tmp_path):
    """Levels of 60 and 30 Gaussians, and an environment of 9."""
    sky = scattered(9, 0)
    folder = write_folder(SOG.files([[scattered(60, 0)], [scattered(30, 0)]], environment=sky), tmp_path / "city")
    assert [fitting_level(folder, most)[0] for most in (None, 69, 68, 39, 0)] == [0, 0, 1, 1, 1]
