"""A small page in place of the real one."""

import pytest
from helpers.small_page import FILES, UNSERVED

from kissgs import preview as page_files


@pytest.fixture
def page_folder(tmp_path, monkeypatch):
    """Folder of a page of few files, beside others that do not belong to it."""
    folder = tmp_path / "installed" / "web_decoder"
    for name in (*FILES, *UNSERVED, "../secret.js"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(FILES.get(name, "secret"), encoding="utf-8")
    monkeypatch.setattr(page_files, "ROOT", folder.parent)
    return folder
