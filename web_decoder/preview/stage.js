/** The stage: viewer, camera and comparison, if this browser can draw them. */

import { byId } from "./dom.js";
import { UserError } from "./problem.js";

/** @typedef {import("./scene.js").Scene} Scene */

const BACKGROUNDS = { dark: "#0b0a10", white: "#ffffff" };
/** Longest wait for the first image, milliseconds. */
const LONGEST_WAIT = 10_000;
const MAX_PIXEL_RATIO = 2; // a higher one costs much and is hardly visible

const LOST = "The graphics driver has reset, so the rendering is gone; reload the page to draw it again.";

/** The modules that need Spark, which may not be installed. */
async function modules() {
  if (!document.createElement("canvas").getContext("webgl2"))
    throw new UserError(
      "This browser has no WebGL2, so the scene cannot be drawn; its statistics and planes are shown.",
    );
  try {
    return await Promise.all([import("./viewer.js"), import("./navigation.js"), import("./compare.js")]);
  } catch {
    throw new UserError(
      "The viewer is not installed, so the scene cannot be drawn; `kissgs-serve viewer` or `scripts/vendor` installs it.",
    );
  }
}

/** @param {(error: unknown) => void} failed called if nothing can be drawn */
export function stage(failed) {
  const [container, canvas] = [byId("stage"), byId("viewport")];
  /** @type {{viewer: import("./viewer.js").Viewer, camera: ReturnType<typeof import("./navigation.js").navigation>} | null} */
  let live = null;
  /** @type {Awaited<ReturnType<typeof import("./compare.js").comparison>> | null} */
  let beside = null;
  let endStream = () => {};
  let white = false;

  const ready = modules().then(([{ Viewer }, { navigation }, { comparison }]) => {
    const viewer = new Viewer(canvas, { lost: () => fail(new UserError(LOST)) });
    live = { viewer, camera: navigation(viewer) };
    new ResizeObserver(fit).observe(container);
    paint();
    return { ...live, comparison };
  });
  /** @type {unknown} */
  let failure = null;
  const fail = (/** @type {unknown} */ error) => failed((failure = error));
  ready.catch(fail);

  const viewers = () => [live?.viewer, beside?.original].filter((viewer) => viewer !== undefined);

  function fit() {
    const { clientWidth: width, clientHeight: height } = container;
    if (!width || !height || canvas.hidden) return;
    const covered = container.getBoundingClientRect().bottom - byId("tools").getBoundingClientRect().top;
    const ratio = Math.min(MAX_PIXEL_RATIO, devicePixelRatio);
    for (const viewer of viewers()) viewer.resize(width, height, ratio, Math.min(Math.max(covered, 0), height / 3));
    if (!live?.camera.moved) live?.camera.home();
  }

  function paint() {
    const colour = white ? BACKGROUNDS.white : BACKGROUNDS.dark;
    for (const viewer of viewers()) viewer.setBackground(colour);
    container.style.backgroundColor = colour;
  }

  /** @param {boolean} fresh whether this is another scene than before */
  function reveal(fresh) {
    const first = canvas.hidden;
    canvas.hidden = false;
    byId("tools").hidden = false;
    byId("empty").hidden = true;
    if (first) fit();
    if (fresh || !live?.camera.moved) live?.camera.home();
  }

  function endComparison() {
    beside?.end();
    beside = null;
  }

  /** End what belongs to the former scene. */
  function endFormer() {
    endComparison();
    endStream();
    endStream = () => {};
  }

  return {
    /** Resolves when a scene can be shown; never if that is impossible. @type {Promise<void>} */
    ready: new Promise((resolve) =>
      ready.then(
        () => resolve(),
        () => {},
      ),
    ),
    /** Resolves when it is known whether a scene can be shown. @type {Promise<unknown>} */
    settled: ready.catch(() => {}),
    /** The error why no scene can be shown, or null. */
    get failure() {
      return failure;
    },
    /**
     * @param {Scene} scene
     * @param {import("./scene.js").Parts} parts that have arrived
     * @param {boolean} fresh
     */
    show(scene, parts, fresh) {
      if (fresh) endFormer();
      live?.viewer.setScene(scene, parts, live.camera.moved);
      reveal(fresh);
    },
    /** @param {import("./file_types.js").FileType} type @param {Uint8Array} bytes */
    async showFile(type, bytes) {
      const { viewer } = await ready;
      const count = await viewer.setFile(type, bytes); // the former scene goes on if this fails
      endFormer();
      reveal(true);
      return count;
    },
    /**
     * Begin a scene that the caller draws in parts, and return the viewer.
     * @param {import("./extent.js").Extent} extent
     * @param {() => void} ended called when another scene is shown, or none
     * @param {import("./view.js").View | null} first the recorded view
     */
    async stream(extent, ended, first) {
      const { viewer } = await ready;
      endFormer();
      endStream = ended;
      viewer.setExtent(extent, first);
      reveal(true);
      return viewer;
    },
    /** Place a scene that is drawn in parts anew. @param {import("./extent.js").Extent} extent */
    place(extent) {
      if (!live) return;
      live.viewer.refineExtent(extent, live.camera.moved);
      if (!live.camera.moved) live.camera.home();
    },
    /** @param {import("./file_types.js").FileType} type @param {Uint8Array} bytes */
    async compare(type, bytes) {
      const { viewer, comparison } = await ready;
      endComparison();
      beside = await comparison(container, viewer, type, bytes);
      fit();
      paint();
    },
    endComparison,
    /** Wait until the scene is in the image, or cannot be soon. */
    async drawn() {
      for (const end = performance.now() + LONGEST_WAIT; performance.now() < end;) {
        await new Promise((resolve) => setTimeout(resolve, 20));
        if (failure) return;
        if (live?.viewer.hasDrawn) return live.viewer.finished();
      }
    },
    /** Show nothing until the next scene. */
    conceal() {
      endFormer();
      canvas.hidden = true;
      byId("tools").hidden = true;
    },
    get comparing() {
      return beside !== null;
    },
    /** @param {import("./scene.js").Gaussian | null} gaussian */
    mark: (gaussian) => viewers().forEach((viewer) => viewer.mark(gaussian)),
    home: () => live?.camera.home(),
    /** @param {KeyboardEvent} event */
    press: (event) => live?.camera.press(event) ?? false,
    /** @returns {boolean} whether the background is white now */
    switchBackground() {
      white = !white;
      paint();
      return white;
    },
  };
}
