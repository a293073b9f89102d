"""Containers in a real Chromium, pages and workers; oracles: Pillow for levels, kissgs' Python decoder for values."""

import json
import shutil

import pytest
from helpers.web_scenes import (
    IMAGES,
    assert_progress,
    assert_scene,
    container,
    job,
    with_meta,
    without_checksums,
    zipped,
)
from helpers.web_tools import Site

import kissgs

playwright = pytest.importorskip("playwright.sync_api")
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed")

QUIET = [
    *("--no-sandbox", "--disable-gpu", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync"),
]
WORST = 1
PAGE = b"<!doctype html><title>test</title>"
# Counts what the browser's own decoder does, lets it lie or fail, and counts workers.
SPY = """
globalThis.native = {made: 0, copied: 0, closed: 0};
globalThis.workers = {made: 0, ended: 0};
if ("ImageDecoder" in globalThis) {
  const Real = ImageDecoder;
  globalThis.ImageDecoder = class extends Real {
    constructor(init) { super(init); native.made++; }
    close() { native.closed++; return super.close(); }
    async decode(options) {
      if (globalThis.lie === "throw") throw new DOMException("out of order", "EncodingError");
      const result = await super.decode(options);
      const {image} = result;
      const copyTo = image.copyTo.bind(image);
      image.copyTo = async (target, ...rest) => {
        const layout = await copyTo(target, ...rest);
        native.copied++;
        if (globalThis.lie === "bit") target[5] ^= 1;
        return layout;
      };
      return result;
    }
  };
}
if ("Worker" in globalThis) {
  const Real = Worker;
  globalThis.Worker = class extends Real {
    constructor(...rest) { super(...rest); workers.made++; }
    terminate() { workers.ended++; return super.terminate(); }
  };
}
"""
LATE = "new Promise((_, reject) => setTimeout(() => reject(new Error('does not end')), 15000))"
IN_PAGE = """async (job) => {
  const {perform} = await import("/tests/web/scene_jobs.mjs");
  return JSON.stringify({...await perform(job), native, workers});
}"""
IN_WORKER = """(job) => new Promise((resolve, reject) => {
  const worker = new Worker("/tests/web/scene_worker.mjs", {type: "module"});
  worker.onerror = (event) => reject(new Error(event.message));
  worker.onmessage = ({data}) => {
    if (data === "ready") return worker.postMessage(job);
    worker.terminate();
    resolve(JSON.stringify(data));
  };
})"""


@pytest.fixture(scope="module")
def site():
    site = Site()
    site.files["/page.html"] = PAGE
    yield site
    site.close()


@pytest.fixture(scope="module")
def browser():
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=QUIET)
        yield browser
        browser.close()


@pytest.fixture
def do(browser, site):
    """``do(job)`` in a page, or in a worker of it."""
    context = browser.new_context()
    context.add_init_script(SPY)
    page = context.new_page()
    page.set_default_timeout(20_000)
    wrong = []
    page.on("pageerror", lambda error: wrong.append(str(error)))

    def run(job, within=IN_PAGE, at="/page.html", before=None):
        page.goto(site.url + at)
        if before:
            page.evaluate(before)
        return json.loads(page.evaluate(f"(job) => Promise.race([({within})(job), {LATE}])", job))

    yield run
    context.close()
    assert wrong == []


@pytest.fixture(scope="module")
def large():
    """Large enough that workers are asked: 144 x 144 pixels."""
    return container("fast", 2, 20_000)


MODES = [{}, {"native": True}, {"native": False}, {"workers": 0}, {"workers": 0, "native": False}, {"workers": 3}]


@pytest.mark.parametrize("within", [IN_PAGE, IN_WORKER], ids=["page", "worker"])
@pytest.mark.parametrize("options", MODES, ids=str)
def test_every_way_to_decode(do, site, options, within, large):
    small = container("paper", 3, 65)
    for files, source, keep in (
        (small, site.put("small", small), True),
        (large, site.put("large", large), False),
        (large, zipped(large), True),
    ):
        said = do(job(source, options={**options, "keepPlanes": keep}), within)
        assert assert_scene(said, files) <= WORST
        assert_progress(said)


@pytest.mark.parametrize("count", [0, 1, 7, 8, 9, 64, 65])
@pytest.mark.parametrize("preset", ["fast", "paper"])
def test_small_scenes(do, preset, count):
    for degree in (0, 1, 3):
        files = container(preset, degree, count)
        said = do(job(files, options={"keepPlanes": True}))
        assert assert_scene(said, files) <= WORST
        assert_progress(said)


def test_the_browser_decodes_all_but_rotations_exactly(do, large):
    """Eight images, all of which the checksums prove; without workers the page's own decoder can be counted."""
    said = do(job(large, options={"workers": 0}))
    assert assert_scene(said, large) <= WORST
    assert said["native"] == {"made": 8, "copied": 8, "closed": 8}
    assert said["workers"]["made"] == 0
    said = do(job(large, options={"workers": 0, "native": False}))
    assert said["native"]["made"] == 0


def test_without_checksums_the_browser_is_not_asked(do, large):
    files = without_checksums(large)
    said = do(job(files, options={"workers": 0, "native": True}))
    assert assert_scene(said, files) <= WORST
    assert said["native"]["made"] == 0


@pytest.mark.parametrize("lie", ["bit", "throw"])
def test_a_browser_that_decodes_wrongly_is_noticed(do, large, lie):
    """As some do on purpose, against fingerprinting."""
    said = do(job(large, options={"workers": 0, "keepPlanes": True}), before=f"globalThis.lie = '{lie}'")
    assert assert_scene(said, large) <= WORST
    assert said["native"]["made"] == said["native"]["closed"] == 8


def test_workers_end_with_the_work(do, large):
    said = do(job(large, options={"workers": 3, "native": False}))
    assert assert_scene(said, large) <= WORST
    assert said["workers"] == {"made": 3, "ended": 3}
    said = do(job(large))  # the browser does all but the rotations
    assert said["workers"] == {"made": 1, "ended": 1}
    damaged = {**large, "f_dc.webp": large["f_dc.webp"][:-50]}
    said = do(job(damaged, options={"workers": 2, "native": False}))
    assert said["error"]["message"].startswith("f_dc.webp: ")
    assert said["workers"] == {"made": 2, "ended": 2}
    said = do(job(large, options={"workers": 2, "native": False}, abort={"at": "active_mask.webp"}))
    assert said["error"]["name"] == "AbortError"
    assert said["workers"] == {"made": 2, "ended": 2}


def test_a_worker_that_never_comes_does_not_hold_up_an_end(do, site, large):
    site.late["/web_decoder/worker.js"] = 20
    try:
        said = do(job(large, options={"workers": 1, "native": False}, abort={"after": 300}))
    finally:
        del site.late["/web_decoder/worker.js"]
    assert said["error"]["name"] == "AbortError"
    assert said["ms"] < 5000


def test_what_makes_a_picture_is_asked_for_first(do, site, large):
    """All at once, they would share the line with the rest."""
    site.late["/first/f_dc.webp"] = 0.5
    site.asked.clear()
    said = do(job(site.put("first", large)))
    asked = [path.removeprefix("/first/") for path in site.asked if path.startswith("/first/")]
    assert assert_scene(said, large) <= WORST
    assert asked[0] == "meta.json"
    assert set(asked[1:4]) == {"active_mask.webp", "means_bytes_1.webp", "f_dc.webp"}
    assert set(said["order"][:3]) == set(asked[1:4])


@pytest.mark.parametrize("wait", [0, 0.5], ids=["at once", "later"])
def test_workers_that_cannot_be_loaded(do, site, large, wait):
    """A bundler left the file out, a policy forbids it: the page's own thread does the work, whenever that shows."""
    site.files["/web_decoder/worker.js"] = None
    address = site.put("slow", large)
    for name in IMAGES:
        site.late[f"/slow/{name}"] = wait
    try:
        said = do(job(address, options={"workers": 2}))
    finally:
        del site.files["/web_decoder/worker.js"]
    assert assert_scene(said, large) <= WORST


def test_a_policy_that_forbids_workers(do, site, large):
    site.files["/strict.html"] = PAGE
    site.headers["/strict.html"] = {"Content-Security-Policy": "worker-src 'none'; script-src 'self' 'unsafe-eval'"}
    said = do(job(site.put("forbidden", large), options={"workers": 2}), at="/strict.html")
    assert assert_scene(said, large) <= WORST


def test_from_another_origin(do, site, large):
    """Pages may import the decoder from elsewhere; workers they may not."""
    other = Site()
    try:
        said = do(
            job(other.put("scene", large)),
            IN_PAGE.replace('"/tests', f'"{other.url}/tests'),
        )
    finally:
        other.close()
    assert assert_scene(said, large) <= WORST


def test_errors_and_aborts_are_those_of_node(do, site, large):
    address = site.put("slow2", large)
    site.late["/slow2/f_dc.webp"] = 1.0
    said = do(job(address, abort={"after": 100}))
    assert said["error"]["name"] == "AbortError"
    assert said["later"] == 0
    assert do(job(address, abort="before"))["error"]["name"] == "AbortError"
    assert do(job(address, abort="reason"))["error"]["name"] == "RangeError"
    said = do(job(f"{site.url}/nothing/"))
    assert said["error"]["name"] == "SogxtError"
    assert said["error"]["message"] == "meta.json cannot be fetched: the server answers 404"
    cut = zipped(large)[:-30]
    assert do(job(cut))["error"]["message"] == "not a zip file, or one that is cut off"


def test_what_a_small_file_declares_is_not_decoded_by_the_browser(do, large):
    """A picture of other size is refused, whoever decodes."""
    files = {**large, "f_dc.webp": container("fast", 0, 1)["f_dc.webp"]}
    said = do(job(files, options={"workers": 0}))
    assert said["error"]["message"].startswith("f_dc.webp: 8 x 8 pixels, not ")


def test_relative_addresses(do, site, large):
    site.put("beside", large)
    site.files["/beside.zip"] = zipped(large)
    for address in ("beside/", "/beside/meta.json", "beside.zip"):
        said = do(job(address))
        assert assert_scene(said, large) <= WORST


def test_a_real_scene(do, site, shared_data):
    files = dict(kissgs.compress(shared_data / "guitar" / "guitar.ply", settings=kissgs.Settings(preset="fast")).files)
    said = do(job(site.put("guitar", files), options={"keepPlanes": True}))
    assert assert_scene(said, files) <= WORST
    assert_progress(said)


def test_a_scene_by_names_of_kind_alone(do):
    files = with_meta(without_checksums(container()), lambda meta: meta.pop("profile"))
    assert assert_scene(do(job(files)), files) <= WORST
