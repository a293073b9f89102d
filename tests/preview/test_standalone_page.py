"""The page with everything inside, as a file; oracle: an HTML parser, and the modules' own texts."""

import base64
import gzip
import json
import re
from html.parser import HTMLParser

import pytest
from helpers.small_page import FILES

from kissgs.preview import PageScene, hash_source, standalone_page

NAME = 'a "b" <i>&</i> \' \N{SNOWMAN}.zip'
DATA = bytes(range(256)) * 3


class Elements(HTMLParser):
    """All elements of a page: name, attributes, text until the next tag."""

    def __init__(self, page):
        super().__init__()
        self.found, self.inside = [], False
        self.feed(page)

    def handle_starttag(self, tag, attributes):
        self.found.append([tag, dict(attributes), ""])
        self.inside = True

    def handle_data(self, text):
        if self.inside:
            self.found[-1][2] += text

    def handle_endtag(self, tag):
        self.inside = False

    def one(self, tag, **attributes):
        (found,) = [e for e in self.found if e[0] == tag and attributes.items() <= e[1].items()]
        return found


@pytest.fixture
def page(page_folder):
    return standalone_page(PageScene(NAME, DATA, converted=False)).decode()


def test_the_scene_and_its_name(page):
    _, attributes, text = Elements(page).one("script", id="embedded-scene")
    assert attributes == {"type": "text/plain", "id": "embedded-scene", "data-name": NAME}
    assert base64.b64decode(text, validate=True) == DATA
    assert Elements(page).one("title")[2] == f"{NAME} · kissgs"
    assert "<i>" not in page


def test_nothing_is_loaded(page):
    elements = Elements(page)
    assert not [e for e in elements.found if e[1].keys() & {"src", "srcset"} or e[0] in ("link", "base", "iframe")]
    meta = elements.one("meta", **{"http-equiv": "Content-Security-Policy"})[1]
    policy = dict(part.split(" ", 1) for part in meta["content"].split("; "))
    assert policy["script-src"] == f"{hash_source(FILES['standalone.js'])} blob: 'wasm-unsafe-eval'"
    assert policy["style-src"] == hash_source(FILES["preview.css"])
    assert {policy[name] for name in ("default-src", "connect-src", "form-action", "base-uri")} == {"'none'"}
    assert (policy["img-src"], policy["worker-src"]) == ("data:", "blob:")
    assert elements.one("script", type="module")[2] == FILES["standalone.js"]
    assert elements.one("style")[2] == FILES["preview.css"]
    assert page.index("Content-Security-Policy") < page.index("<title>") < page.index("<style>")


def test_licences_of_what_is_inside(page):
    assert "three: MIT - - by all" in re.search("<!--(.*?)-->", page, re.DOTALL)[1]


def test_modules_come_after_those_that_they_import(page):
    text = Elements(page).one("script", id="modules")[2]
    modules = json.loads(gzip.decompress(base64.b64decode(text, validate=True)))
    for at, (_, text) in enumerate(modules):
        assert set(re.findall('"module:(.*?)"', text)) <= {name for name, _ in modules[:at]}
    assert modules[-1][0] == "preview.js"
    assert dict(modules) == {
        "vendor/three/core.min.js": FILES["vendor/three/core.min.js"],
        "vendor/three/three.min.js": 'import{a}from"module:vendor/three/core.min.js";export const Pass=1;',
        "worker.js": FILES["worker.js"],
        "plane.js": 'import * as three from "module:vendor/three/three.min.js";\n'
        'export const add = () => "module:worker.js";\n',
        "preview/sum.js": '\nexport { add } from "module:plane.js";\n',
        "vendor/three/addons/Pass.js": '\nexport { Pass } from "module:vendor/three/three.min.js";\n',
        "late.js": "import {Pass} from \"module:vendor/three/addons/Pass.js\";\nexport const none = 'import none';\n",
        "preview.js": 'import { add } from "module:preview/sum.js";\nimport "module:plane.js";\n'
        'await import("module:late.js");\nadd();\n',
    }


def test_equal_input_gives_equal_bytes(page):
    assert standalone_page(PageScene(NAME, DATA, converted=True)).decode() == page
