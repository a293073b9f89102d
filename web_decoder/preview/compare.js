/** Two renderings of one view with a handle between them: the original to its left, the compressed scene to its right. */

import { el } from "./dom.js";
import { Viewer } from "./viewer.js";

const STEP = 2; // of an arrow key, per cent
const LARGE_STEP = 10; // of a page key, per cent

/**
 * @param {HTMLElement} stage
 * @param {Viewer} compressed
 * @param {import("./file_types.js").FileType} type of the original
 * @param {Uint8Array} bytes of the original
 */
export async function comparison(stage, compressed, type, bytes) {
  const canvas = el("canvas", { class: "original", "aria-hidden": "true" });
  const handle = el(
    "div",
    {
      class: "handle",
      role: "slider",
      tabindex: 0,
      "aria-label": "Where the original ends and the compressed scene begins",
      "aria-valuemin": 0,
      "aria-valuemax": 100,
    },
    el("span", { "aria-hidden": "true" }),
  );
  const labels = ["original", "compressed"].map((text) => el("span", { class: `side ${text}-side` }, text));
  const parts = [canvas, ...labels, handle];
  let share = 50;

  /** @param {number} percent */
  function divideAt(percent) {
    share = Math.min(100, Math.max(0, percent));
    stage.style.setProperty("--share", `${share}%`);
    handle.setAttribute("aria-valuenow", Math.round(share));
    handle.setAttribute("aria-valuetext", `${Math.round(share)} % original`);
  }

  handle.addEventListener("pointerdown", (/** @type {PointerEvent} */ event) => {
    event.preventDefault();
    handle.focus();
    handle.setPointerCapture(event.pointerId);
  });
  handle.addEventListener("pointermove", (/** @type {PointerEvent} */ event) => {
    if (!handle.hasPointerCapture(event.pointerId)) return;
    const { left, width } = stage.getBoundingClientRect();
    divideAt((100 * (event.clientX - left)) / width);
  });
  handle.addEventListener("keydown", (/** @type {KeyboardEvent} */ event) => {
    const to = moveOf(event.key, share);
    if (to === null) return;
    event.preventDefault();
    divideAt(to);
  });

  const original = new Viewer(canvas, { lost: compressed.lost });
  try {
    await original.setFile(type, bytes, compressed);
  } catch (error) {
    original.dispose();
    throw error;
  }
  compressed.canvas.after(...parts);
  compressed.afterFrame = () => original.follow(compressed.camera);
  divideAt(50);

  return {
    original,
    end() {
      compressed.afterFrame = () => {};
      original.dispose();
      for (const part of parts) part.remove();
    },
  };
}

/**
 * @param {string} key
 * @param {number} share
 * @returns {number | null} null if the key does not move the handle
 */
function moveOf(key, share) {
  /** @type {Record<string, number>} */
  const steps = {
    ArrowLeft: -STEP,
    ArrowDown: -STEP,
    ArrowRight: STEP,
    ArrowUp: STEP,
    PageDown: -LARGE_STEP,
    PageUp: LARGE_STEP,
  };
  if (key in steps) return share + steps[key];
  return { Home: 0, End: 100 }[key] ?? null;
}
