"""Oracle: folders made by hand, and the expected file of each name."""

import os
import unicodedata

import pytest
from helpers.examples import examples
from hypothesis import given
from hypothesis import strategies as st

from kissgs.cameras.captures.photos import FoundPhoto, find_photos, searched_folders
from kissgs.core.errors import InvalidViewsError


def touch(root, *names):
    for name in names:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).touch()


def found(root, *names, **options):
    photos = find_photos(names, root, **options)
    return None if photos is None else [str(photo.path.relative_to(root)) for photo in photos]


@pytest.mark.parametrize(
    ("folders", "scale", "expected"),
    [
        (["images", "images_2", "images_4"], None, ("images", 1)),
        (["images_4", "images_2", "images_16"], None, ("images_4", 4)),
        (["images_8", "images_2", "images_16"], None, ("images_2", 2)),
        (["images", "images_2", "images_4"], 4, ("images_4", 4)),
        (["images", "images_4"], 1, ("images", 1)),
        (["images_2024", "images_old", "images_8"], None, ("images_8", 8)),
        (["input", "images_8"], None, ("images_8", 8)),
        (["input", "images"], None, ("images", 1)),
        (["input", "images_old"], None, ("input", 1)),
        (["input", "input_4"], 1, ("input", 1)),
    ],
)
def test_folders_by_scale(tmp_path, folders, scale, expected):
    for folder in folders:
        touch(tmp_path, f"{folder}/a.jpg")
    folder, factor = expected
    photo = FoundPhoto(tmp_path / folder / "a.jpg", factor, tmp_path / folder)
    assert find_photos(["images/a.jpg"], tmp_path, scale=scale) == (photo,)


@pytest.mark.parametrize(
    ("existing", "name", "expected"),
    [
        (["a.jpg", "a.png", "A.jpg"], "a.jpg", "a.jpg"),
        (["a.png"], "a.jpg", "a.png"),
        (["a.JPG"], "a.jpg", "a.JPG"),
        (["A.JPEG", "a.txt"], "a.jpg", "A.JPEG"),
        (["a.jpg", "A.png"], "A", "A.png"),
        (["frame.01.png", "frame.02.png"], "frame.02", "frame.02.png"),
        (["frame.01.png", "frame.02.png"], "frame.02.jpg", "frame.02.png"),
        (["a.webp", "a.png"], "a.jpg", "a.png"),
        (["sub dir/a b.png"], "sub dir/a b.jpg", "sub dir/a b.png"),
        (["a.heic"], "a.heic", "a.heic"),
    ],
)
def test_names_by_stem(tmp_path, existing, name, expected):
    touch(tmp_path, *(f"images/{file}" for file in existing))
    assert found(tmp_path, f"images/{name}") == [f"images/{expected}"]


@pytest.mark.parametrize(("written", "stored"), [("NFC", "NFD"), ("NFD", "NFC")])
@pytest.mark.parametrize("name", ["images/über.jpg", "images/Küche/ß/é.JPEG", "fotós/á/ö.png", "é.jpg"])
def test_unicode_forms_of_names_and_folders(tmp_path, written, stored, name):
    """macOS decomposes names in archives; the camera file has them as they were."""
    root = tmp_path / unicodedata.normalize("NFD", "Möbel")
    there = unicodedata.normalize(stored, name)
    touch(root, there)
    assert found(root, unicodedata.normalize(written, name)) == [there]
    assert found(root, str(root / unicodedata.normalize(written, name))) == [there]
    folder = unicodedata.normalize(written, str(there).rpartition("/")[0] or ".")
    assert found(root, unicodedata.normalize(written, "elsewhere/" + name.rpartition("/")[2]), images=root / folder)


def test_the_exact_unicode_form_comes_first(tmp_path):
    forms = [unicodedata.normalize(form, "images/é.jpg") for form in ("NFC", "NFD")]
    touch(tmp_path, *forms)
    assert found(tmp_path, *forms) == forms


def test_spellings_of_a_path(tmp_path):
    touch(tmp_path, "here/images/a.jpg", "images_2/b.jpg", "c.jpg", "here/d.jpg")
    here = tmp_path / "here"
    assert found(here, "./images/a.jpg", "images\\a.jpg", "d.jpg") == ["images/a.jpg"] * 2 + ["d.jpg"]
    assert [p.path.name for p in find_photos(["../images/b.jpg", "../c.jpg"], here)] == ["b.jpg", "c.jpg"]
    assert [p.path for p in find_photos([str(here / "images" / "a.jpg")], tmp_path)] == [here / "images" / "a.jpg"]


@pytest.mark.parametrize("start", ["/home/elsewhere/", "C:\\captures\\", "\\\\server\\share\\"])
@pytest.mark.parametrize("photos", ["images_4", "input"])
def test_absolute_paths_are_matched_by_their_longest_suffix(tmp_path, start, photos):
    """Several cameras of a rig may have photographs with equal file names."""
    touch(tmp_path, f"{photos}/1.jpg", f"{photos}/left/1.jpg", f"{photos}/2.jpg", "elsewhere/2.jpg", "other_2/3.jpg")
    names = [f"{start}photos/{name}" for name in ("1.jpg", "left/1.jpg", "2.jpg")]
    assert found(tmp_path, *names) == [f"{photos}/1.jpg", f"{photos}/left/1.jpg", f"{photos}/2.jpg"]
    assert found(tmp_path, f"{start}other/3.jpg") == ["other_2/3.jpg"], "a folder of the same name comes first"
    assert found(tmp_path, *names, images=tmp_path / photos) == found(tmp_path, *names)


def test_absolute_paths_that_exist(tmp_path):
    touch(tmp_path, "elsewhere/a.jpg", "elsewhere/images/c.jpg", "here/images/a.jpg", "here/images/b.jpg")
    elsewhere = tmp_path / "elsewhere"
    photos = find_photos([str(elsewhere / name) for name in ("a.jpg", "b.jpg", "images/c.jpg")], tmp_path / "here")
    wanted = ["elsewhere/a.jpg", "here/images/b.jpg", "elsewhere/images/c.jpg"]
    assert [str(photo.path.relative_to(tmp_path)) for photo in photos] == wanted


def test_a_given_folder(tmp_path, monkeypatch):
    touch(tmp_path, "images/a.jpg", "other_4/a.jpg", "other_4/train/r_0.png", "other_4/test/r_0.png")
    assert find_photos(["images/a.jpg"], tmp_path, images=tmp_path / "other_4")[0].factor == 4
    names = ["images/a.jpg", "train/r_0", "./test/r_0", "elsewhere/deep/a.png", "/x/a.jpg", "../a.jpg"]
    expected = ["a.jpg", "train/r_0.png", "test/r_0.png", "a.jpg", "a.jpg", "a.jpg"]
    relative = type(tmp_path)("other_4")
    assert found(tmp_path, *names, images=relative) == [f"other_4/{name}" for name in expected]
    monkeypatch.chdir(tmp_path)
    assert find_photos(["images/a.jpg"], tmp_path / "images", images=relative)[0].path == relative / "a.jpg"


def test_captures_without_photographs(tmp_path):
    (tmp_path / "images_old").mkdir()
    assert found(tmp_path, "images/a.jpg", "images/b.jpg") is None
    assert found(tmp_path, "a.jpg", "../b.jpg", scale=4) is None
    touch(tmp_path, "input/film.mp4")
    assert found(tmp_path, "images/a.jpg", "images/b.jpg") is None


@pytest.mark.parametrize(
    ("names", "folders"),
    [
        (["images/a.jpg", "images/left/b.jpg"], " for 'images', 'input'"),
        (["train/a", "test/a"], " for 'train', 'test'"),
        (["a.jpg"], ""),
        (["a.jpg", "rgb/a.jpg", "../b.jpg"], " for 'rgb', '..'"),
        (["C:\\x\\rgb\\a.jpg"], " for 'C:/x/rgb', 'rgb', 'images', 'input'"),
        ([f"{letter}/a.jpg" for letter in "abcdefg"], " for 'a', 'b', 'c', 'd', …"),
        (["new\nline/a.jpg"], " for 'new\\nline'"),
    ],
)
def test_searched_folders(tmp_path, names, folders):
    assert searched_folders(names, tmp_path) == f"{tmp_path}{folders}"


def message(root, *names, **options):
    with pytest.raises(InvalidViewsError) as caught:
        find_photos(names, root, **options)
    return str(caught.value)


def test_missing_photographs(tmp_path):
    touch(tmp_path, "images_2/a.jpg", "images_2/c.png")
    remedy = "; add what is missing, or name the folder that has all of them (--images of kissgs evaluate and render)"
    assert message(tmp_path, *(f"images/{x}.jpg" for x in "abcd")) == (
        f"2 of 4 photographs are missing; the first is 'images/b.jpg', searched in {tmp_path}/images_2{remedy}"
    )
    assert message(tmp_path, "images/b.jpg") == (
        f"1 of 1 photographs is missing; the first is 'images/b.jpg', searched in {tmp_path}/images_2{remedy}"
    )
    assert message(tmp_path, "/else/images/b.jpg", "C:\\else\\rgb\\b.jpg").startswith(
        f"2 of 2 photographs are missing; the first is '/else/images/b.jpg', searched in {tmp_path}/images_2; "
    )
    assert message(tmp_path, "images/a.jpg", "test/b.jpg") == (
        f"1 of 2 photographs is missing; the first is 'test/b.jpg', searched in {tmp_path}/test{remedy}"
    )


def test_missing_folders(tmp_path):
    touch(tmp_path, "images/a.jpg", "images_4/a.jpg")
    where = f"in {tmp_path}, only images, images_4; choose another --scale"
    assert message(tmp_path, "images/a.jpg", scale=2) == f"there is no folder images_2 {where}"
    touch(tmp_path, "raw/input/a.jpg")
    assert message(tmp_path / "raw", "images/a.jpg", scale=4) == (
        f"there is no folder images_4 in {tmp_path}/raw, only input; choose another --scale"
    )
    (tmp_path / "images").rename(tmp_path / "images_8")
    assert message(tmp_path, "images/a.jpg", scale=1) == (
        f"there is no folder images in {tmp_path}, only images_4, images_8; choose another --scale"
    )
    other = type(tmp_path)("nowhere")
    assert message(tmp_path, "images/a.jpg", images=other) == (
        f"there is neither a folder nowhere nor {tmp_path}/nowhere; check --images"
    )
    assert message(tmp_path, "images/a.jpg", images=other, scale=2) == (
        "--images and --scale exclude each other; give only one of them"
    )


@pytest.mark.skipif(os.geteuid() == 0, reason="root can read every folder")
def test_folders_without_permission(tmp_path):
    touch(tmp_path, "images/a.jpg")
    (tmp_path / "images").chmod(0)
    assert message(tmp_path, "images/a.jpg") == f"cannot read {tmp_path}/images: permission denied"
    (tmp_path / "images").chmod(0o700)


def test_names_that_are_too_long(tmp_path):
    touch(tmp_path, "images/a.jpg")
    assert message(tmp_path, f"images/{'a' * 500}/a.jpg").endswith(": file name too long")


@examples(200)
@given(st.lists(st.text(st.sampled_from("ab./\\: \0é\ud800"), max_size=8), min_size=1, max_size=3), st.booleans())
def test_any_names(tmp_path, names, named):
    touch(tmp_path, "a/b.png")
    try:
        photos = find_photos(names, tmp_path, images=tmp_path / "a" if named else None)
    except InvalidViewsError:
        return
    assert photos is None or all(photo.path.is_file() for photo in photos)
