/** View of all planes of a container; the selected pixel's Gaussian is marked in the scene. */

import { el } from "./dom.js";
import { canvasOf, paint, planeView } from "./plane.js";
import { gives } from "./scene.js";
import { inOrder, planeName } from "./words.js";

/** Longest wait for the browser to be idle, milliseconds. */
const MAX_WAIT = 200;

/** @param {() => void} work */
const whenIdle = (work) =>
  "requestIdleCallback" in window ? requestIdleCallback(work, { timeout: MAX_WAIT }) : setTimeout(work);

/**
 * Paint one plane after the other, until they are removed from the page for a newer scene.
 * @param {[HTMLCanvasElement, import("./scene.js").Plane][]} waiting
 */
function paintInTurn([next, ...others]) {
  if (!next) return;
  whenIdle(() => {
    if (!next[0].isConnected) return;
    paint(...next);
    paintInTurn(others);
  });
}

/**
 * @param {import("./scene.js").Scene} scene
 * @param {(index: number | null) => void} mark a Gaussian, or none
 */
export function planesView(scene, mark) {
  const files = inOrder(Object.keys(scene.planes));
  const indexOfCell = new Int32Array(1 + (scene.cells.at(-1) ?? -1)).fill(-1);
  scene.cells.forEach((cell, index) => (indexOfCell[cell] = index));
  const large = el("div", { class: "plane" });
  const canvases = files.map((file) => canvasOf(scene.planes[file], { "aria-hidden": "true" }));
  const thumbs = files.map((file, at) =>
    el(
      "button",
      { type: "button", class: "thumb", "aria-pressed": "false", onclick: () => choose(file) },
      canvases[at],
      el("span", {}, planeName(file)),
    ),
  );

  /** @param {string} file */
  function choose(file) {
    thumbs.forEach((thumb, at) => thumb.setAttribute("aria-pressed", files[at] === file));
    large.replaceChildren(...planeView(scene, file, indexOfCell, mark));
    mark(null);
  }

  const first = files.find((file) => gives(scene, file, "sh0")) ?? files[0];
  if (first) choose(first);
  paintInTurn(files.map((file, at) => [canvases[at], scene.planes[file]]));
  return [el("h2", { id: "planes-title" }, "Planes"), el("div", { class: "thumbs" }, ...thumbs), large];
}
