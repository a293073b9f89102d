/** The preview page: opening, showing and comparing scenes, with its keys and buttons. */

import { decode } from "./preview/decode.js";
import { announce, byId, dropAnywhere, el } from "./preview/dom.js";
import { FILE_ENDINGS, fileTypeOf } from "./preview/file_types.js";
import { count } from "./preview/format.js";
import { loader } from "./preview/loading.js";
import { help, listen, switchFullScreen, switchPanels } from "./preview/keys.js";
import { planesView } from "./preview/planes.js";
import { refiner } from "./preview/refine.js";
import { STAGES, gaussianAt, lastStageOf, partsOf, stageOf } from "./preview/scene.js";
import { addressed, download, jobIn, namesSource, refuse, standsAlone } from "./preview/sources.js";
import { stage } from "./preview/stage.js";
import { isManifest } from "./preview/lod_tree.js";
import { openStreamed } from "./preview/streamed_page.js";
import { fileStatisticsView, statisticsView } from "./preview/statistics.js";
import { UserError, aborted, showProblem } from "./preview/problem.js";

/**
 * @typedef {import("./preview/scene.js").Scene} Scene
 * @typedef {import("./preview/sources.js").Source} Source
 * @typedef {import("./preview/loading.js").Load} Load
 * @typedef {import("./preview/file_types.js").FileType} FileType
 */

/** Larger scenes are refused: few browsers have the memory, and a small file may declare any size. */
const MAX_GAUSSIANS = 10_000_000;

const loads = loader();
const view = stage(showProblem);
/** The container on display. @type {{scene: Scene, source: Source, seconds: number | null} | null} */
let shown = null;

/**
 * Do a long operation, and show its progress.
 * @param {string} what
 * @param {(load: Load) => Promise<void>} work
 */
async function during(what, work) {
  const load = loads.begin(what);
  showProblem(view.failure); // remains valid, whatever is opened
  try {
    await work(load);
  } catch (error) {
    if (!aborted(error)) showProblem(error);
  }
  load.done();
  byId("empty").hidden = !byId("viewport").hidden || !byId("loading").hidden;
}

/**
 * @param {Source} source
 * @param {Load} load
 */
async function openContainer(source, load) {
  /** @type {Set<import("./types.js").Attribute>} */
  const arrived = new Set();
  const { ready } = view;
  /** @type {Parameters<typeof refiner>[0]["show"]} */
  const show = (scene, stage, fresh) => view.show(scene, partsOf(arrived, stage), fresh);
  const refine = refiner({ ready, show }, (scene) => shown?.scene === scene);
  const begun = performance.now();
  /** @param {string} file @param {Scene} scene */
  function onPlane(file, scene) {
    if (load.signal.aborted) return;
    for (const attribute of scene.contents[file]) arrived.add(attribute);
    if (shown?.scene !== scene) {
      setTitle(source.name);
      showPanel(); // before the first image, whose size it changes
      shown = { scene, source, seconds: null };
      view.conceal(); // else the former scene would stay under this name if the positions never arrive
    }
    refine(scene, stageOf(arrived, scene.degree));
  }
  /** @param {import("./types.js").Progress} progress */
  function onProgress({ received, total, decoded, planes }) {
    // The sizes of a folder's files become known one by one, so that the total is known only if the service says it.
    const known = source.zipped ? total : (source.bytes ?? 0);
    load.progress({ received, total: total && known, decoded, planes });
    if (source.zipped) source.bytes = received;
  }
  try {
    const { container, request } = source;
    const scene = await decode(container, {
      signal: load.signal,
      request,
      keepPlanes: true,
      maxGaussians: MAX_GAUSSIANS,
      onProgress,
      onPlane,
    });
    shown = { scene, source, seconds: (performance.now() - begun) / 1000 };
    refine(scene, STAGES.whole);
    await view.settled;
    if (scene.count) await view.drawn(); // statistics and planes take seconds, in which nothing is drawn
    if (load.signal.aborted) return;
    announce(`${source.name}: ${count(scene.count)} Gaussians.`);
  } catch (error) {
    if (shown?.source === source && !load.signal.aborted) refine(shown.scene, lastStageOf(arrived));
    throw error;
  } finally {
    if (shown?.source === source) showFacts(); // after an error, those of the images that arrived
  }
}

function showFacts() {
  if (!shown) return;
  const { scene, source } = shown;
  byId("statistics").replaceChildren(...statisticsView({ ...source, ...shown }));
  byId("planes").replaceChildren(
    ...planesView(scene, (index) => view.mark(index === null ? null : gaussianAt(scene, index))),
  );
  byId("panel").hidden = false;
  byId("compare").hidden = false;
  labelCompare();
}

/** @param {Load} load */
async function openAddressed(load) {
  const source = await addressed(location, load.signal);
  const { name, container } = source;
  const type = fileTypeOf(name);
  if (typeof container === "string" && isManifest(container)) return openStreamedScene(name, container, load);
  if (!type) return openContainer(source, load);
  const bytes =
    typeof container === "string"
      ? await download({ url: container, bytes: 0 }, load)
      : new Uint8Array(await container.arrayBuffer());
  await openFile(name, type, bytes, load);
}

/** @param {string} name @param {string} address @param {Load} load */
async function openStreamedScene(name, address, load) {
  setTitle(name);
  showPanel();
  announce(`${name}: ${count(await openStreamed(address, load, view))} Gaussians.`);
}

/** Show the panel of a scene that has no planes and cannot be compared, with its statistics. @param {...Node} statistics */
function showPanel(...statistics) {
  shown = null;
  byId("statistics").replaceChildren(...statistics);
  byId("planes").replaceChildren();
  byId("panel").hidden = false;
  byId("compare").hidden = true;
}

/** @param {string} name @param {FileType} type @param {Uint8Array} bytes @param {Load} load */
async function openFile(name, type, bytes, load) {
  const size = bytes.length; // reading it may take the bytes away
  load.signal.throwIfAborted();
  const gaussians = await readable(name, view.showFile(type, bytes));
  setTitle(name);
  showPanel(...fileStatisticsView(gaussians, size));
  announce(`${name}: ${count(gaussians)} Gaussians.`);
}

/** @param {string} name @param {FileType} type @param {Uint8Array} bytes */
async function compareWith(name, type, bytes) {
  if (!shown) return;
  await readable(name, view.compare(type, bytes));
  shown.source.originalBytes ??= bytes.length;
  byId("statistics").replaceChildren(...statisticsView({ ...shown.source, ...shown }));
  labelCompare();
  announce("Original to the left, compressed to the right of the handle.");
}

/**
 * Replace errors of Spark by a message.
 * @template T @param {string} name @param {Promise<T>} reading
 */
const readable = (name, reading) =>
  reading.catch((error) => {
    throw error instanceof UserError
      ? error
      : new UserError(`${name} cannot be read: it holds no Gaussians, or is damaged.`);
  });

function labelCompare() {
  const [verb, what] = view.comparing ? ["End", "\u00a0comparison"] : ["Compare", "\u00a0with original"];
  byId("compare").replaceChildren(verb, el("span", { class: view.comparing ? null : "roomy" }, what));
}

async function pressCompare() {
  const original = shown?.source.original;
  if (view.comparing) view.endComparison();
  else if (original)
    await during("Loading the original", async (load) =>
      compareWith("The original", original.type, await download(original, load)),
    );
  else pick(FILE_ENDINGS);
  labelCompare();
}

/** @param {File[]} files */
async function take(files) {
  const container = files.find(({ name }) => !fileTypeOf(name));
  const file = files.find(({ name }) => fileTypeOf(name));
  if (container) {
    const source = { name: container.name.replace(/\.(zip|sog)$/i, ""), container, bytes: container.size };
    await during(`Opening ${container.name}`, async (load) => {
      refuse(container.name);
      await openContainer(source, load);
    });
  }
  const type = file && fileTypeOf(file.name);
  if (!type) return;
  await during(`Reading ${file.name}`, async (load) => {
    const bytes = new Uint8Array(await file.arrayBuffer());
    await (shown ? compareWith(file.name, type, bytes) : openFile(file.name, type, bytes, load));
  });
}

/** @param {string} accept */
function pick(accept) {
  byId("file").accept = accept;
  byId("file").click();
}

/** @param {string} name */
function setTitle(name) {
  byId("title").textContent = name;
  document.title = `${name} · kissgs`;
}

/** @param {string} id @param {(button: any) => void} action */
const onPress = (id, action) => byId(id).addEventListener("click", () => action(byId(id)));

onPress("open", () => pick(`.zip,.sog,${FILE_ENDINGS}`));
onPress("choose", () => pick(`.zip,.sog,${FILE_ENDINGS}`));
onPress("reset", view.home);
onPress("compare", pressCompare);
onPress("fullscreen", switchFullScreen);
onPress("panels", switchPanels);
onPress("help", help);
onPress("background", (button) => button.setAttribute("aria-pressed", view.switchBackground()));
byId("file").addEventListener("change", () => {
  take([...byId("file").files]);
  byId("file").value = ""; // so that the same file can be chosen again
});
dropAnywhere(take);
listen({ viewport: byId("viewport"), home: view.home, move: view.press });

const job = jobIn(location);
if (job) byId("home").href = `../#${job}`;
if (standsAlone) byId("home").removeAttribute("href");
if (namesSource(location)) during("Opening the scene", openAddressed);
else byId("empty").hidden = false;
