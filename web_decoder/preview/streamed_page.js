/** Showing a streamed scene on the page: it follows the camera, and tells what is drawn. */

import { budgetOf } from "./device.js";
import { byId } from "./dom.js";
import { extentOfBoxes, extentOfCoarsest } from "./extent.js";
import { parseTree } from "./lod_tree.js";
import { UserError, sentenceOf, showProblem, withdrawProblem } from "./problem.js";
import { isAntialiased } from "./scene.js";
import { StreamedFiles } from "./streamed_files.js";
import { streamedStatisticsView } from "./statistics.js";
import { Streaming } from "./streaming.js";

/** @typedef {import("./streamed_meshes.js").Content} Content */
/** @typedef {import("./scene.js").Scene} Scene */

/** Shortest time between two choices of levels while the camera moves, milliseconds, and in units of what one takes. */
const [INTERVAL, REST] = [100, 5];

/**
 * Show a streamed scene; resolves when its coarsest level is drawn, and the scene goes on from there.
 * @param {string} address of the manifest
 * @param {import("./loading.js").Load} load
 * @param {ReturnType<typeof import("./stage.js").stage>} view
 * @returns {Promise<number>} the number of Gaussians of the finest level and the environment
 */
export async function openStreamed(address, load, view) {
  const begun = performance.now();
  const files = new StreamedFiles(address, (received) => load.progress({ received, total: 0 }));
  const tree = parseTree(await files.manifest(load.signal));
  const budget = budgetOf(location.search);
  await view.settled;
  if (view.failure) return tree.count; // the page says why nothing can be drawn
  const { contentOf } = await import("./streamed_meshes.js");
  load.signal.throwIfAborted();

  /** Seconds and bytes until the first image. @type {{seconds: number, bytes: number} | null} */
  let first = null;
  let needed = 0;
  /** Why files cannot be loaded, and the one that the page has shown. @type {Map<number, UserError>} */
  const losses = new Map();
  /** @type {UserError | null} */
  let announced = null;
  /** Files of the coarsest level until the camera has been placed by them. @type {Map<number, Scene> | null} */
  let coarsest = new Map();
  let antialiased = true;
  let timer = 0;
  let closed = false;
  /** @type {(error?: unknown) => void} */
  let ended = () => {};

  /** @param {number} file @param {unknown} error */
  function lose(file, error) {
    const what = streaming.base.includes(file) ? "part of the scene is missing" : "its part of the scene stays coarse";
    losses.set(file, new UserError(`${tree.files[file]}: ${sentenceOf(error).replace(/[.]$/, "")}; ${what}.`));
  }

  /** Say what this view lacks, once; the user may close the message. */
  function tell() {
    const loss = losses.get(streaming.lacking[0]) ?? null;
    if (loss === announced) return;
    withdrawProblem(announced);
    if (loss) showProblem(loss);
    announced = loss;
  }
  /** @type {Streaming<Scene, Content>} */
  const streaming = new Streaming(tree, {
    budget,
    load: (file, signal) => files.load(file, tree.files[file], signal),
    prepare: (file, scene, signal) => {
      viewer.antialiased = antialiased &&= isAntialiased(scene); // if all files are
      if (file !== tree.environment && streaming.base.includes(file)) coarsest?.set(file, scene);
      return contentOf(scene, signal);
    },
    draw: (parts) => viewer.setParts(parts),
    changed: () => soon(0),
    failed: lose,
  });
  const weights = tree.leaves.map((leaf) => leaf.levels.at(-1)?.count ?? 0);
  const viewer = await view.stream(extentOfBoxes(tree.leaves, weights), close, tree.view);

  let interval = INTERVAL;
  function soon(wait = interval) {
    if (!timer && !closed) timer = setTimeout(look, wait);
  }

  function look() {
    timer = 0;
    const before = performance.now();
    if (streaming.begun && coarsest) {
      const extent = extentOfCoarsest(tree.leaves, coarsest);
      if (extent) view.place(extent);
      coarsest = null;
    }
    streaming.look(viewer.sight);
    tell();
    interval = Math.max(INTERVAL, REST * (performance.now() - before));
    if (streaming.begun) needed ||= files.received;
    if (streaming.begun && !streaming.drawn.some(({ leaves }) => leaves)) ended(); // no file could be loaded
    const { drawn, surrounding, complete } = streaming;
    const facts = {
      tree,
      budget,
      drawn,
      surrounding,
      complete,
      received: files.received,
      total: files.total(tree),
      first,
    };
    byId("statistics").replaceChildren(...streamedStatisticsView(facts));
  }

  function close() {
    closed = true;
    clearTimeout(timer);
    viewer.afterFrame = () => {};
    streaming.close();
    files.close();
    ended();
  }

  viewer.afterFrame = () => {
    if (!first && streaming.begun && viewer.hasDrawn) {
      first = { seconds: (performance.now() - begun) / 1000, bytes: needed };
      ended();
    }
    soon();
  };
  await new Promise((resolve, reject) => {
    ended = resolve;
    load.signal.addEventListener("abort", () => {
      if (!first) view.conceal();
      reject(load.signal.reason);
    });
    look();
  });
  const { count, environment, rows } = tree;
  return count + (environment === null ? 0 : rows[environment]);
}
