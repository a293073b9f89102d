"""Zips and paths that a reader of containers refuses; oracle: Python's zipfile, and names that leave their folder."""

import io
import zipfile

import pytest

from kissgs.core.errors import InvalidContainerError
from kissgs.io import containers as packed_files
from kissgs.io.containers import DirectorySource, is_below, open_source, zip_names


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


def packed(names):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name in names:
            archive.writestr(name, b"x")
    return buffer.getvalue()


def test_files_by_name_or_by_path():
    data = packed(["top/index", "top/a/one", "top/b/two", "elsewhere/three"])
    with open_source(data) as files:
        assert files.names() == {"index", "one", "two", "three"}
        assert files.read("any/one", 10) == b"x"
    with open_source(data, "index") as files:
        assert files.names() == {"index", "a/one", "b/two"}
        assert files.read("a/one", 10) == b"x"
        with pytest.raises(InvalidContainerError, match="has no file 'one'"):
            files.read("one", 10)
    for names in (["a/index", "b/index"], ["a"]):
        with pytest.raises(
            InvalidContainerError, match=rf"holds {len(names) // 2 * 2} files named 'index'; one is needed"
        ):
            open_source(packed(names), "index").__enter__()


def test_a_list_of_entries_that_is_too_large(monkeypatch):
    data = packed([f"{i:04}" for i in range(200)])
    assert len(zip_names(io.BytesIO(data))) == 200
    monkeypatch.setattr(packed_files, "MAX_DIRECTORY_BYTES", 5000)
    assert zip_names(io.BytesIO(data)) == []
    with pytest.raises(InvalidContainerError, match=r"has a list of entries above 5000 bytes; pack it again"):
        open_source(data).__enter__()


def test_zip64():
    data = packed(["a"])
    end = data.rindex(b"PK\5\6")
    with pytest.raises(InvalidContainerError, match=r"is a zip64 file; pack it as an ordinary zip"):
        open_source(data[:end] + b"PK\6\7".ljust(20, b"\0") + data[end:]).__enter__()
