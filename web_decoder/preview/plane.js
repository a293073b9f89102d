/** View of one plane of a container, large enough to point at its pixels. */

import { el } from "./dom.js";
import { bytes } from "./format.js";
import { readout } from "./readout.js";
import { planeName } from "./words.js";

/** @type {Record<string, [number, number]>} */
const STEPS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

/**
 * @param {import("./scene.js").Scene} scene
 * @param {string} file
 * @param {Int32Array} indexOfCell -1 where there is no Gaussian
 * @param {(index: number | null) => void} mark a Gaussian, or none
 */
export function planeView(scene, file, indexOfCell, mark) {
  const plane = scene.planes[file];
  const name = planeName(file);
  const canvas = canvasOf(plane, {
    tabindex: 0,
    role: "application",
    "aria-roledescription": "plane",
    "aria-label": `${name}: ${plane.width} by ${plane.height} pixels. Arrow keys go from pixel to pixel.`,
  });
  paint(canvas, plane);
  const cursor = el("span", { class: "cursor", "aria-hidden": "true", hidden: true });
  const hint = "Point at or tap a pixel, or use the arrow keys, to find its Gaussian in the scene.";
  const output = el("div", { class: "readout small", role: "status" }, el("p", { class: "muted" }, hint));
  pointing(canvas, plane, {
    at(pixel) {
      cursor.hidden = false;
      cursor.style.left = `${(100 * (pixel.x + 0.5)) / plane.width}%`;
      cursor.style.top = `${(100 * (pixel.y + 0.5)) / plane.height}%`;
      const { index, content } = readout(scene, file, pixel, indexOfCell);
      output.replaceChildren(...content);
      mark(index);
    },
    away: () => mark(null),
  });
  const facts = `${plane.width} × ${plane.height} · ${bytes(scene.sizes[file] ?? 0)}`;
  const heading = el("span", {}, el("b", {}, name), " ", el("span", { class: "muted small" }, facts));
  return [el("p", { class: "spread" }, heading, enlarger()), el("div", { class: "frame" }, canvas, cursor), output];
}

/**
 * Report the pixel that is selected by pointer or keys.
 * @param {HTMLCanvasElement} canvas
 * @param {{width: number, height: number}} plane
 * @param {{at: (pixel: {x: number, y: number}) => void, away: () => void}} then
 */
function pointing(canvas, plane, then) {
  let pixel = { x: 0, y: 0 };

  /** @param {number} x @param {number} y */
  function pointAt(x, y) {
    pixel = { x: Math.min(plane.width - 1, Math.max(0, x)), y: Math.min(plane.height - 1, Math.max(0, y)) };
    then.at(pixel);
  }

  /** @param {PointerEvent} event */
  function point(event) {
    const { left, top, width, height } = canvas.getBoundingClientRect();
    const [across, down] = [(event.clientX - left) / width, (event.clientY - top) / height];
    pointAt(Math.floor(across * plane.width), Math.floor(down * plane.height));
  }

  canvas.addEventListener("pointerdown", point);
  canvas.addEventListener("pointermove", point);
  canvas.addEventListener("pointerleave", ({ pointerType }) => {
    if (pointerType !== "touch" && document.activeElement !== canvas) then.away(); // a finger leaves after each tap
  });
  canvas.addEventListener("focus", () => canvas.matches(":focus-visible") && then.at(pixel));
  canvas.addEventListener("blur", then.away);
  canvas.addEventListener("keydown", (event) => {
    const step = STEPS[event.key];
    if (!step) return;
    event.preventDefault();
    pointAt(pixel.x + step[0], pixel.y + step[1]);
  });
}

/** Return the button that enlarges and shrinks the planes. */
function enlarger() {
  const button = el("button", { type: "button", class: "quiet small", onclick: press });
  const label = (/** @type {boolean} */ wide) => (button.textContent = wide ? "Shrink" : "Enlarge");
  function press() {
    label(document.body.classList.toggle("wide"));
  }
  label(document.body.classList.contains("wide"));
  return button;
}

/**
 * Return a blank canvas for a plane.
 * @param {import("./scene.js").Plane} plane
 * @param {Record<string, any>} attributes
 * @returns {HTMLCanvasElement}
 */
export const canvasOf = ({ width, height }, attributes) => el("canvas", { width, height, ...attributes });

/**
 * Paint a plane with levels stretched from black to white, so that a mask of ones is visible. Alpha is ignored: in rotations
 * it is data, not transparency.
 * @param {HTMLCanvasElement} canvas
 * @param {import("./scene.js").Plane} plane
 */
export function paint(canvas, { width, height, rgba }) {
  let largest = 1;
  for (let at = 0; at < rgba.length && largest < 255; at += 4)
    largest = Math.max(largest, rgba[at], rgba[at + 1], rgba[at + 2]);
  const table = new Uint8ClampedArray(256).map((_, level) => (255 * level) / largest);
  const pixels = new Uint8ClampedArray(rgba.length);
  for (let at = 0; at < rgba.length; at += 4) {
    pixels[at] = table[rgba[at]];
    pixels[at + 1] = table[rgba[at + 1]];
    pixels[at + 2] = table[rgba[at + 2]];
    pixels[at + 3] = 255;
  }
  canvas.getContext("2d")?.putImageData(new ImageData(pixels, width, height), 0, 0);
}
