/** The page: what is opened, shown and compared, and which keys and buttons do that. */

import { decode } from "./sogxt.js";
import { announce, byId, dropAnywhere, el } from "./preview/dom.js";
import { count } from "./preview/format.js";
import { loader } from "./preview/loading.js";
import { help, listen, switchFullScreen, switchPanels } from "./preview/keys.js";
import { planesView } from "./preview/planes.js";
import { refiner } from "./preview/refine.js";
import { STAGES, gaussianAt, lastStageOf, partsOf, stageOf } from "./preview/scene.js";
import { addressed, download, jobIn, namesSource } from "./preview/sources.js";
import { stage } from "./preview/stage.js";
import { plyStatisticsView, statisticsView } from "./preview/statistics.js";
import { Trouble, aborted, trouble } from "./preview/trouble.js";

/**
 * @typedef {import("./preview/scene.js").Scene} Scene
 * @typedef {import("./preview/sources.js").Source} Source
 * @typedef {import("./preview/loading.js").Load} Load
 */

/** Larger scenes are refused: few browsers could hold them, and a small file may claim any size. */
const MOST_GAUSSIANS = 10_000_000;

const loads = loader();
const view = stage(trouble);
/** What is shown. @type {{scene: Scene, source: Source, seconds: number | null} | null} */
let shown = null;

/**
 * Do something that takes a while, with the card that shows how far it is.
 * @param {string} what
 * @param {(load: Load) => Promise<void>} work
 */
async function during(what, work) {
  const load = loads.begin(what);
  trouble(view.failure); // which stays true, whatever is opened
  try {
    await work(load);
  } catch (error) {
    if (!aborted(error)) trouble(error);
  }
  load.done();
  byId("empty").hidden = !byId("viewport").hidden || !byId("loading").hidden;
}

/**
 * @param {Source} source
 * @param {Load} load
 */
async function openContainer(source, load) {
  /** @type {Set<string>} */
  const arrived = new Set();
  const { ready } = view;
  /** @type {Parameters<typeof refiner>[0]["show"]} */
  const show = (scene, stage, fresh) => view.show(scene, partsOf(arrived, stage), fresh);
  const refine = refiner({ ready, show }, (scene) => shown?.scene === scene);
  const begun = performance.now();
  /** @param {string} file @param {Scene} scene */
  function onPlane(file, scene) {
    if (load.signal.aborted) return;
    arrived.add(file);
    if (shown?.scene !== scene) {
      shown = { scene, source, seconds: null };
      entitle(source.name);
      view.conceal(); // another scene's picture under this one's name, if its positions never come
    }
    refine(scene, stageOf(arrived, scene.degree));
  }
  /** @param {import("./types.js").Progress} progress */
  function onProgress({ received, total, decoded, planes }) {
    // Of a folder the files are announced one by one: unless it has been said before, nobody knows the sum.
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
      maxGaussians: MOST_GAUSSIANS,
      onProgress,
      onPlane,
    });
    shown = { scene, source, seconds: (performance.now() - begun) / 1000 };
    refine(scene, STAGES.whole);
    await view.settled;
    announce(`${source.name}: ${count(scene.count)} Gaussians.`);
  } catch (error) {
    if (shown?.source === source && !load.signal.aborted) refine(shown.scene, lastStageOf(arrived));
    throw error;
  } finally {
    if (shown?.source === source) showFacts(); // also what there is of it after an error
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

/** @param {File} file @param {Load} load */
async function openPly(file, load) {
  const bytes = new Uint8Array(await file.arrayBuffer());
  load.signal.throwIfAborted();
  const gaussians = await readable(view.showPly(bytes));
  shown = null;
  entitle(file.name);
  byId("statistics").replaceChildren(...plyStatisticsView(gaussians, file.size));
  byId("planes").replaceChildren();
  byId("panel").hidden = false;
  byId("compare").hidden = true;
  announce(`${file.name}: ${count(gaussians)} Gaussians.`);
}

/** @param {Uint8Array} bytes */
async function compareWith(bytes) {
  if (!shown) return;
  await readable(view.compare(bytes));
  shown.source.originalBytes ??= bytes.length;
  byId("statistics").replaceChildren(...statisticsView({ ...shown.source, ...shown }));
  labelCompare();
  announce("Original to the left, compressed to the right of the handle.");
}

/** @template T @param {Promise<T>} reading */
const readable = (reading) =>
  reading.catch((error) => {
    throw error instanceof Trouble
      ? error
      : new Trouble("This .ply cannot be read: it holds no Gaussians, or is damaged.");
  });

function labelCompare() {
  const [verb, what] = view.comparing ? ["End", "\u00a0comparison"] : ["Compare", "\u00a0with original"];
  byId("compare").replaceChildren(verb, el("span", { class: view.comparing ? null : "roomy" }, what));
}

async function pressCompare() {
  const original = shown?.source.original;
  if (view.comparing) view.endComparison();
  else if (original) await during("Loading the original", async (load) => compareWith(await download(original, load)));
  else pick(".ply");
  labelCompare();
}

/** @param {File[]} files */
async function take(files) {
  const container = files.find((file) => !isPly(file));
  const ply = files.find(isPly);
  if (container) {
    const source = { name: container.name.replace(/\.zip$/i, ""), container, bytes: container.size };
    await during(`Opening ${container.name}`, (load) => openContainer(source, load));
  }
  if (!ply) return;
  if (shown) await during(`Reading ${ply.name}`, async () => compareWith(new Uint8Array(await ply.arrayBuffer())));
  else await during(`Reading ${ply.name}`, (load) => openPly(ply, load));
}

/** @param {File} file */
const isPly = (file) => /\.ply$/i.test(file.name);

/** @param {string} accept */
function pick(accept) {
  byId("file").accept = accept;
  byId("file").click();
}

/** @param {string} name */
function entitle(name) {
  byId("title").textContent = name;
  document.title = `${name} · kissgs`;
}

/** @param {string} id @param {(button: any) => void} action */
const onPress = (id, action) => byId(id).addEventListener("click", () => action(byId(id)));

onPress("open", () => pick(".zip,.ply"));
onPress("choose", () => pick(".zip,.ply"));
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
listen({ picture: byId("viewport"), home: view.home, move: view.press });

const job = jobIn(location);
if (job) byId("home").href = `../#${job}`;
if (namesSource(location))
  during("Opening the container", async (load) => openContainer(await addressed(location, load.signal), load));
else byId("empty").hidden = false;
