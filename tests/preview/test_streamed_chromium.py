"""``kissgs view`` of a streamed scene in Chromium: what is loaded when, and what the page says about it."""

import json
import re
import threading
import urllib.parse
from dataclasses import replace

import numpy as np
import pytest
from helpers.page_server import serving
from helpers.preview_browser import colours, preview, psnr, software_browser  # noqa: F401  fixtures
from helpers.streamed_scenes import write_small
from helpers.viewers import scattered

import kissgs
from kissgs import preview as server_module
from kissgs.core.splats import concatenate
from kissgs.preview import streamed_folder
from kissgs.streaming import levels as environment

NAME = "city 100%41 \N{SNOWMAN}"


@pytest.fixture(scope="module")
def city(tmp_path_factory):
    """A folder with levels of 1,200, 600, 300 and 150 Gaussians in 16 leaves."""
    folder = tmp_path_factory.mktemp("streamed")
    write_small(scattered(1200, 1), folder / NAME / "lod-meta.json", chunk=400, leaf=80, coarsest=200)
    return folder / NAME


@pytest.fixture
def server(city, monkeypatch):
    """A server whose files of other levels than the coarsest wait for ``server.gate``."""
    answer = server_module._Handler.do_GET

    def held(handler):
        if re.search(r"/[0-2]_\d/", handler.path) and not handler.server.gate.wait(100):
            raise TimeoutError(handler.path)
        answer(handler)

    monkeypatch.setattr(server_module._Handler, "do_GET", held)
    with serving(streamed_folder(city)) as server:
        server.gate = threading.Event()
        yield server
        server.gate.set()


@pytest.fixture
def opened(server, preview):  # noqa: F811
    """``opened()`` opens the scene in a tab."""

    return lambda **options: preview(**options).visit(server)


def facts(tab):
    """Return what the statistics say, by name, each with its remark."""
    rows = tab.page.locator("#statistics .facts > div")
    for _ in range(100):  # texts have lines only once the page has laid them out
        found = {name: tuple(rest) for name, *rest in (text.split("\n") for text in rows.all_inner_texts())}
        if all(found.values()):
            break
        tab.page.wait_for_timeout(100)
    return found


def asked(tab):
    """Return the files of the scene that the page has asked for."""
    paths = (urllib.parse.unquote(urllib.parse.urlsplit(url).path) for _, url in tab.requests)
    return [path.removeprefix(f"/scene/{NAME}/") for path in paths if path.startswith("/scene/")]


def settle(tab):
    tab.page.locator("#statistics .facts > div").filter(has_text=re.compile("^This viewcomplete$")).wait_for()


def test_coarse_first_then_what_the_camera_sees(server, city, opened):
    tab = opened()
    tab.page.locator("#loading").wait_for(state="hidden")
    coarse = tab.still_image()
    assert colours(coarse) > 500
    assert tab.page.locator("#title").inner_text() == NAME
    first = facts(tab)
    counts = json.loads((city / "lod-meta.json").read_bytes())["counts"]
    assert first["Gaussians drawn"] == (f"{counts[3]:,}", f"of {counts[0]:,}")
    assert first["At most"] == ("1,500,000", "on this device")
    assert first["This view"] == ("loading",)
    files = {path.relative_to(city).as_posix(): path.stat().st_size for path in city.rglob("*.*")}
    needed = sum(size for name, size in files.items() if name.startswith("3_0/") or name == "lod-meta.json")
    assert first["First image"][1] == f"after {needed / 1000:.3g} kB"
    assert {name for name in asked(tab) if not name.startswith("3_0/")} - {"lod-meta.json"}  # they wait
    tab.choose(("other.ply", b"ply\nno scene"))
    tab.error_message("other.ply", "damaged")
    tab.page.get_by_role("button", name="Dismiss").click()

    server.gate.set()  # the streaming has gone on behind the message
    settle(tab)
    last = facts(tab)
    assert last["Gaussians drawn"] == (f"{counts[0]:,}", f"of {counts[0]:,}")
    received = sum(files[name] for name in asked(tab))
    assert last["Loaded"][0] == f"{received / 1000:.3g} kB"
    assert psnr(tab.still_image()[:-80], coarse[:-80]) < 32
    assert len(asked(tab)) == len(set(asked(tab)))
    assert not tab.page.locator("#compare").is_visible()
    assert not tab.page.locator("#planes .thumb").count()
    rows = tab.page.locator("#statistics tbody tr")
    assert rows.first.inner_text().split()[-2:] == ["16", f"{counts[0]:,}"]


def test_a_phone_and_another_scene_afterwards(server, opened):
    """Phones draw fewer; a file that is opened later ends the streaming."""
    server.gate.set()
    tab = opened(has_touch=True, is_mobile=True)
    settle(tab)
    assert facts(tab)["At most"] == ("500,000", "on this device")
    tab.choose(("other.zip", kissgs.compress(scattered(100, 0), settings=kissgs.Settings(preset="fast")).to_zip()))
    tab.shown(100)
    before = len(asked(tab))
    tab.page.keyboard.press("w")
    tab.still_image()
    assert len(asked(tab)) == before
    tab.fact("Gaussians", "100")


def test_a_missing_file_and_a_damaged_list(server, opened):
    server.gate.set()
    (lost,) = [path for path in server.contents if path.endswith("0_1/scales.webp")]
    content = server.contents.pop(lost)
    tab = opened()
    tab.error_message("0_1/meta.json", "scales.webp cannot be fetched", "stays coarse")
    settle(tab)
    assert asked(tab).count("0_1/scales.webp") == 2
    tab.expect_errors("404 .*0_1/scales.webp", "Failed to load resource.*404")
    server.contents[lost] = content

    lost = [path for path in server.contents if path.endswith("3_0/sh0.webp")]
    content = server.contents.pop(*lost)
    server.gate.clear()
    tab = opened()
    tab.error_message("3_0/meta.json", "sh0.webp cannot be fetched", "part of the scene is missing")
    server.gate.set()
    settle(tab)
    tab.page.locator("#problem").wait_for(state="hidden")  # all parts are drawn by now
    tab.expect_errors("404 .*3_0/sh0.webp", "Failed to load resource.*404")
    server.contents[lost[0]] = content

    (manifest,) = [path for path in server.contents if path.endswith("lod-meta.json")]
    server.contents[manifest] = b'{"lodLevels": 4}'
    tab = opened()
    tab.error_message("list of this scene's files is damaged")
    tab.choose(("lod-meta.json", b"{}"))
    tab.error_message("does not open the list of a scene's files alone", "kissgs view lod-meta.json")


@pytest.mark.parametrize("apart", [False, True])
@pytest.mark.quick(1)
def test_the_first_camera_is_within_the_sky(preview, tmp_path, monkeypatch, apart):  # noqa: F811
    """A sky that is much of the coarsest level does not decide where the camera stands; nor does an environment."""
    near = scattered(1000, 0)
    sky = scattered(140, 1)
    far = 12 * sky.means / np.linalg.norm(sky.means, axis=1, keepdims=True)
    sky = replace(sky, means=far, scales=sky.scales + 3.5, opacities=sky.opacities + 8, shN=near.shN[:140])
    monkeypatch.setattr(environment, "FEWEST", 100 if apart else 1000)
    target = tmp_path / "city" / "lod-meta.json"
    write_small(concatenate([near, sky]), target, chunk=2000, leaf=600, coarsest=200)
    coarsest = kissgs.load(tmp_path / "city", level=3)
    assert np.mean(np.linalg.norm(coarsest.means, axis=1) > 8) > 0.3
    assert (tmp_path / "city" / "environment").exists() == apart
    with serving(streamed_folder(tmp_path / "city")) as server:
        tab = preview().visit(server)
        settle(tab)
        image = tab.still_image()
    background = (image[:8] == (11, 10, 16)).all(axis=-1)
    assert background.mean() < 0.2
    total = f"{len(kissgs.load(tmp_path / 'city')):,}"
    assert facts(tab)["Gaussians drawn"] == (total, f"of {total}")
    assert tab.page.locator("#statistics tbody tr").filter(has_text="Environment").count() == apart
