"""Oracles: the zipfile module, which writes friendly and hostile archives, the file system, and memory."""

import dataclasses
import errno
import io
import os
import re
import tempfile
import zipfile
from pathlib import Path

import numpy as np
import pytest
from helpers.codec_scenes import random_scene
from helpers.memory import takes_less_than
from helpers.reference_sog import zip_of

import kissgs
from kissgs.core.errors import InvalidContainerError, OutputError, UnsupportedError
from kissgs.formats import ENDINGS
from kissgs.io import containers
from kissgs.io.containers import (
    MAX_ZIP_ENTRIES,
    DirectorySource,
    check_destination,
    is_below,
    open_source,
    write_container,
    zip_bytes,
    zip_names,
)
from kissgs.io.images import encode_plane
from kissgs.settings import EncodeSettings
from kissgs.sogxt import PLANES
from kissgs.sogxt.encode import encode

FILES = {"container_meta.yaml": b"meta", "meta.json": b"{}", "a.webp": bytes(range(256)) * 4, "empty.webp": b""}


def contents(source):
    """All files of a container, by way of the library."""
    with open_source(source) as files:
        return {name: files.read(name, 1 << 20) for name in files.names()}


def refusal(source, name="a.webp", limit=1 << 20):
    """The sentence with which reading is refused."""
    with pytest.raises(InvalidContainerError) as caught, open_source(source) as files:
        files.read(name, limit)
    return str(caught.value)


def test_zip_has_the_same_bytes_at_any_time_and_place(monkeypatch):
    first = zip_bytes(FILES)
    monkeypatch.setattr("time.time", lambda: 2e9)
    monkeypatch.setattr("sys.platform", "win32")
    assert zip_bytes(dict(FILES)) == first
    with zipfile.ZipFile(io.BytesIO(first)) as file:
        assert {entry.filename: file.read(entry) for entry in file.infolist()} == FILES
        assert file.testzip() is None
        for entry in file.infolist():
            stored = entry.filename.endswith(".webp")
            assert entry.compress_type == (zipfile.ZIP_STORED if stored else zipfile.ZIP_DEFLATED)
            assert entry.date_time == (1980, 1, 1, 0, 0, 0)
            assert entry.external_attr >> 16 == 0o644


@pytest.mark.parametrize("folder", ["", "scene/", "a/b/c/", "a\\b\\", "/abs/", "../../", "C:\\"])
def test_zips_of_other_tools_are_read(folder):
    """Deflated, or packed with their folder, its entry, and notes; a path is only ever a name, so it leads nowhere."""
    entries = [(f"{folder}{name}", content) for name, content in FILES.items()]
    assert contents(zip_of(entries, zipfile.ZIP_DEFLATED)) == FILES
    found = contents(zip_of([("scene/", b""), *entries, ("__MACOSX/._a.webp", b"x"), ("scene/README.txt", b"hello")]))
    assert found == {**FILES, "._a.webp": b"x", "README.txt": b"hello"}


def test_names_do_not_end_at_a_nul():
    """zipfile ends them there, so that it would read this as a second a.webp; browsers do not."""
    data = zip_of([*FILES.items(), ("a.webp:abc", b"who?")]).replace(b"a.webp:abc", b"a.webp\0abc")
    assert contents(data) == {**FILES, "a.webp\0abc": b"who?"}


def test_a_container_is_read_from_anything(tmp_path):
    """Sizes are those of the file system, or of zipfile; missing and oversized files are refused."""
    folder, packed = tmp_path / "folder", tmp_path / "file.zip"
    write_container(FILES, folder)
    write_container(FILES, packed)
    (folder / "subfolder").mkdir()
    sizes = {name: len(data) for name, data in FILES.items()}
    with zipfile.ZipFile(packed) as file:
        packed_sizes = {entry.filename: entry.compress_size for entry in file.infolist()}
    for source, wanted in (
        (FILES, sizes),
        (folder, sizes),
        (packed, packed_sizes),
        (packed.read_bytes(), packed_sizes),
    ):
        assert contents(source) == FILES
        with open_source(source) as files:
            assert {name: files.size(name) for name in files.names()} == wanted
            assert len(files.read("a.webp", 1024)) == 1024
        assert refusal(source, "b.webp") == "the container has no file 'b.webp'; export or download it again"
        assert refusal(source, "a.webp", 1023) == "a.webp has 1024 bytes; the limit for this file is 1023"


@pytest.mark.parametrize("data", [b"", b"PK\x05\x06", b"PK\x03\x04" + bytes(50), b"no zip", zip_bytes(FILES)[:-30]])
def test_what_is_no_zip_is_refused(data, tmp_path):
    assert refusal(data) == "the input is not a readable zip file; export or download it again"
    path = tmp_path / "file.zip"
    path.write_bytes(data)
    assert refusal(path) == f"{path} is not a readable zip file; export or download it again"


def test_missing_files_and_paths_that_no_file_system_has(tmp_path):
    """Asking whether such a path is a folder once raised a bare OSError or ValueError."""
    path = tmp_path / "none.zip"
    assert refusal(path) == f"cannot read {path}: no such file or directory"
    for name in ("x" * 300 + ".zip", "x" * 300, "nul\0.zip"):
        assert refusal(tmp_path / name).startswith("cannot read")


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_two_files_of_one_name_and_thousands_of_files_are_refused():
    """Readers differ in which of them they use, so a checked file could differ from the one that is used."""
    for second in ("a.webp", "other/a.webp"):
        data = zip_of([("a.webp", b"one"), (second, b"two")])
        assert refusal(data) == "the input holds two files named 'a.webp'"
    data = zip_of([(f"{i}.txt", b"") for i in range(MAX_ZIP_ENTRIES + 1)])
    assert refusal(data) == f"the input has {MAX_ZIP_ENTRIES + 1} entries; a container has 12 files"


@pytest.mark.parametrize("honest", [True, False])
def test_a_zip_bomb_takes_no_memory(honest):
    """64 MB of zeros in 64 kB; the declared size may be the true one, or a lie."""
    data = zip_of([("a.webp", bytes(64 << 20))], zipfile.ZIP_DEFLATED)
    if not honest:
        size = (64 << 20).to_bytes(4, "little")
        assert data.count(size) == 2
        data = data.replace(size, (1000).to_bytes(4, "little"))
    sentences = []
    assert takes_less_than(8 << 20, lambda: sentences.append(refusal(data)))
    assert re.search("the limit for this file is 1048576|it is damaged or encrypted", sentences[0])


def damaged(data, old, new, times):
    assert data.count(old) == times
    return data.replace(old, new)


def test_damaged_encrypted_and_exotic_entries_are_refused():
    sentence = "a.webp cannot be read from the zip: it is damaged or encrypted"
    good = zip_of([("a.webp", b"hello world")])
    assert refusal(damaged(good, b"hello world", b"hellO world", 1)) == sentence  # its CRC is wrong
    encrypted = bytearray(good)
    encrypted[6] |= 1  # the flags of the local header,
    encrypted[good.index(b"PK\x01\x02") + 8] |= 1  # and of the directory
    assert refusal(bytes(encrypted)) == sentence
    exotic = bytearray(good)
    exotic[8] = exotic[good.index(b"PK\x01\x02") + 10] = 99  # a compression that nobody has
    assert refusal(bytes(exotic)) == "a.webp has zip compression method 99; store or deflate it"
    astray = bytearray(good)
    offset = good.index(b"PK\x01\x02") + 42
    astray[offset : offset + 4] = (1 << 30).to_bytes(4, "little")  # far behind the end
    assert refusal(bytes(astray)) == sentence


def test_endings_of_files_are_those_of_the_formats():
    assert set(containers.PACKED) == set(ENDINGS)


@pytest.mark.parametrize("name", ["new", "new.zip", "NEW.ZIP"])
def test_nothing_is_overwritten_unless_asked_for(tmp_path, name):
    path = tmp_path / name
    assert write_container(FILES, path) == (path.stat().st_size if path.is_file() else 1030)
    with pytest.raises(OutputError, match="exists already; choose another name or allow overwriting"):
        write_container({"a.webp": b""}, path)
    assert contents(path) == FILES
    less = {name: data for name, data in FILES.items() if name != "empty.webp"}
    if path.is_file():
        write_container(less, path, overwrite=True)
        assert contents(path) == less
    else:
        write_container({**FILES, "a.webp": b"new"}, path, overwrite=True)
        assert contents(path)["a.webp"] == b"new"
    assert [entry.name for entry in tmp_path.iterdir()] == [name], "something was left over"


@pytest.mark.parametrize("stranger", ["thesis.txt", "b.webp", ".hidden", "subfolder"])
def test_a_folder_that_holds_more_than_a_container_is_never_replaced(tmp_path, stranger):
    folder = tmp_path / "home"
    write_container(FILES, folder)
    (folder / stranger).mkdir() if stranger == "subfolder" else (folder / stranger).write_text("years of work")
    before = sorted(folder.iterdir())
    with pytest.raises(
        OutputError, match=r"holds more than a container; name an empty or a new folder, or a \.zip file"
    ):
        write_container(FILES, folder, overwrite=True)
    assert sorted(folder.iterdir()) == before


def test_a_file_is_not_replaced_by_a_folder_nor_a_folder_by_a_zip(tmp_path):
    (tmp_path / "file").write_text("text")
    with pytest.raises(OutputError):
        write_container(FILES, tmp_path / "file", overwrite=True)
    assert (tmp_path / "file").read_text() == "text"
    (tmp_path / "x.zip").mkdir()
    with pytest.raises(OutputError, match="is a folder; name a file"):
        write_container(FILES, tmp_path / "x.zip", overwrite=True)
    for name in ("missing/new", "missing/new.zip"):
        with pytest.raises(OutputError, match=f"cannot write .*{name}: there is no folder"):
            write_container(FILES, tmp_path / name)


@pytest.mark.parametrize("name", ["a.zip", "folder"])
def test_a_full_disk_is_reported_before_the_work(tmp_path, monkeypatch, name):
    """It still takes names, but no bytes."""

    def full(**_):
        return Path("/dev/full").open("wb")

    monkeypatch.setattr(tempfile, "TemporaryFile", full)
    with pytest.raises(OutputError, match=r"cannot write .*: no space left on device"):
        check_destination(tmp_path / name, overwrite=False, names=FILES)


@pytest.mark.parametrize("existing", [False, True])
def test_a_disk_that_fills_up_leaves_what_was_there(tmp_path, monkeypatch, existing):
    """A folder is swapped in when all files are written, so a failure amid them changes nothing."""
    folder = tmp_path / "folder"
    if existing:
        write_container(FILES, folder)
    calls = []

    def fsync(descriptor):
        calls.append(descriptor)
        if len(calls) == 3:
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", fsync)
    with pytest.raises(OutputError, match=r"cannot write .*folder: no space left on device"):
        write_container(dict.fromkeys(FILES, b"new"), folder, overwrite=True)
    assert [entry.name for entry in tmp_path.iterdir()] == (["folder"] if existing else [])
    if existing:
        assert contents(folder) == FILES


@pytest.mark.parametrize("failure", [OSError(errno.EIO, "Input/output error"), KeyboardInterrupt()])
def test_a_swap_that_fails_puts_the_old_folder_back(tmp_path, monkeypatch, failure):
    """Between the two renames the old container has another name; a failure then must not leave it there."""
    folder, replace = tmp_path / "folder", Path.replace
    write_container(FILES, folder)

    def failing(self, target):
        if Path(target) == folder and ".part" in self.name:
            raise failure
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", failing)
    with pytest.raises((OutputError, KeyboardInterrupt), match=r"cannot write|^$"):
        write_container(dict.fromkeys(FILES, b"new"), folder, overwrite=True)
    assert contents(folder) == FILES
    assert [entry.name for entry in tmp_path.iterdir()] == ["folder"]


@pytest.fixture
def unreadable_folder():
    """A folder that this process may not list: as root, by being somebody else for a while."""
    with tempfile.TemporaryDirectory() as above:
        Path(above).chmod(0o755)
        folder = Path(above, "secret")
        write_container(FILES, folder)
        folder.chmod(0)
        user = os.geteuid()
        if user == 0:
            os.seteuid(65534)
        yield folder
        os.seteuid(user)
        folder.chmod(0o755)


def test_a_folder_that_may_not_be_listed_is_refused_in_a_sentence(unreadable_folder):
    """Listing it once raised a bare PermissionError."""
    assert refusal(unreadable_folder) == f"cannot read {unreadable_folder}: permission denied"


@pytest.mark.parametrize("name", ["a", "a/b.webp", "a b/c", "..a/b", "a/..b", "a\\b"])
def test_paths_below_a_folder(name):
    assert is_below(name)


@pytest.mark.parametrize(
    "name", ["", "/a", "..", "../a", "a/../b", "a\\..\\b", "\\a", "C:/a", "C:\\a", "https://a", "a\0"]
)
def test_paths_outside_a_folder(name, tmp_path):
    assert not is_below(name)
    with pytest.raises(InvalidContainerError, match="has no file"):
        DirectorySource(tmp_path).read(name, 1000)


def test_files_by_name_or_by_path_from_a_root():
    data = zip_of([(name, b"x") for name in ("top/index", "top/a/one", "top/b/two", "elsewhere/three")])
    with open_source(data) as files:
        assert files.names() == {"index", "one", "two", "three"}
        assert files.read("any/one", 10) == b"x"
    with open_source(data, "index") as files:
        assert files.names() == {"index", "a/one", "b/two"}
        assert files.read("a/one", 10) == b"x"
        with pytest.raises(InvalidContainerError, match="has no file 'one'"):
            files.read("one", 10)
    for names, count in ((["a/index", "b/index"], 2), (["a"], 0)):
        with pytest.raises(InvalidContainerError, match=f"holds {count} files named 'index'; one is needed"):
            open_source(zip_of([(name, b"x") for name in names]), "index").__enter__()


def test_lists_of_entries_that_are_too_large_or_of_zip64(monkeypatch):
    data = zip_of([(f"{i:04}", b"x") for i in range(200)])
    assert len(zip_names(io.BytesIO(data))) == 200
    monkeypatch.setattr(containers, "MAX_DIRECTORY_BYTES", 5000)
    assert zip_names(io.BytesIO(data)) == []
    assert refusal(data) == "the input has a list of entries above 5000 bytes; pack it again"
    data = zip_of([("a", b"x")])
    end = data.rindex(b"PK\5\6")
    zip64 = data[:end] + b"PK\6\7".ljust(20, b"\0") + data[end:]
    assert refusal(zip64) == "the input is a zip64 file; pack it as an ordinary zip"


def bomb(side):
    """A small container of a large scene: all planes constant."""
    scene = random_scene(1, 3)
    files = dict(encode(scene, EncodeSettings(prune_invisible=False)).files)
    for name in PLANES:
        if "centroids" not in name:
            channels = {"quaternions.webp": 4, "active_mask.webp": 1, "opacities.webp": 1}.get(name, 3)
            files[name] = encode_plane(np.ones((side, side, channels), np.uint8), quality=0, method=0)
    del files["meta.json"]
    text = files["container_meta.yaml"].decode().split("kissgs:")[0]
    files["container_meta.yaml"] = text.replace("grid_side: 8", f"grid_side: {side}").encode()
    return files


def test_more_gaussians_than_the_limit_are_refused_before_memory_is_taken():
    files = bomb(512)
    assert sum(map(len, files.values())) < 20_000

    def refused():
        with pytest.raises(UnsupportedError, match=r"262,144 Gaussians; the limit is 200,000: raise it"):
            kissgs.decompress(files, max_gaussians=200_000)

    assert takes_less_than(30e6, refused)
    assert len(kissgs.decompress(files, max_gaussians=262_144)) == 262_144


def test_a_grid_far_beyond_the_limit_is_refused_before_its_images_are_read():
    files = bomb(512)
    with pytest.raises(UnsupportedError, match="262,144 cells"):
        kissgs.decompress({**files, "active_mask.webp": b"not even an image"}, max_gaussians=1000)


def test_one_outlier_does_not_spoil_the_colours_of_all_others():
    """One colour of 1000 among thousands once made the step of all others a hundred times coarser."""
    scene, fast = kissgs.sample_scene(12_000), kissgs.Settings(preset="fast")

    def error(result, field):
        others = result.order != 7
        found = getattr(kissgs.decompress(result.files), field)[others]
        return np.sqrt(np.mean((found - getattr(scene, field)[result.order[others]]) ** 2))

    clean = kissgs.compress(scene, settings=fast)
    for field, value in (("sh0", 1000), ("shN", 1000), ("shN", 30)):
        spoilt = getattr(scene, field).copy()
        spoilt[7].flat[0] = value
        dirty = kissgs.compress(dataclasses.replace(scene, **{field: spoilt}), settings=fast)
        assert error(dirty, field) < 1.05 * error(clean, field)
        assert dirty.report.clipped_colors == (1 if field == "sh0" else 0)


@pytest.mark.parametrize("count", [1, 5, 64, 65, 100, 256, 257])
def test_a_limit_of_as_many_gaussians_as_there_are_is_enough(count):
    """The grids of few Gaussians have more padding than Gaussians."""
    files = encode(random_scene(count, 0), EncodeSettings(prune_invisible=False)).files
    assert len(kissgs.decompress(files, max_gaussians=count)) == count
