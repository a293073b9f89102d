"""The table of formats; oracle: the codecs of its modules, and the pages that list formats for people."""

from pathlib import Path

import pytest

from kissgs.formats import ENDINGS, FORMATS, MANIFESTS, SCENE_ENDINGS, WRITTEN, named_container

PAGES = [Path(__file__).parents[2] / page for page in ("docs/reference/formats.md", "web_decoder/preview.html")]


@pytest.mark.parametrize("name", FORMATS)
def test_a_line_says_what_its_module_can_do(name):
    line = FORMATS[name]
    assert [*line.codec.write] == ([] if line.is_container else [*line.written])
    assert line.manifest is None or MANIFESTS[line.manifest] == name.removeprefix("streamed-")


def test_pages_name_the_endings():
    reference, preview = (page.read_text() for page in PAGES)
    assert all(f"`{ending}`" in reference for ending in (*SCENE_ENDINGS, *WRITTEN, *ENDINGS))
    (offered,) = (line for line in preview.splitlines() if "accept=" in line)
    assert {*offered.split('"')[1].split(",")} <= {*SCENE_ENDINGS, *ENDINGS}


def test_the_refusal_of_an_unknown_ending_names_all_that_are_written():
    with pytest.raises(Exception, match="is not the name of a container") as caught:
        named_container(None, "out.xyz")
    assert all(ending in str(caught.value) for ending in (*ENDINGS, *MANIFESTS, ".sogxt"))
