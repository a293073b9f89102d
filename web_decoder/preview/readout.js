/** Description of a pixel of a plane, in natural units. */

import { el } from "./dom.js";
import { count, share, short } from "./format.js";
import { gaussianAt, gives, holds } from "./scene.js";

const TILES_PER_ROW = 5;
/** Entries in a row of the codebook of SOG. */
const ENTRIES_PER_ROW = 64;

/**
 * @param {import("./scene.js").Scene} scene
 * @param {string} file
 * @param {{x: number, y: number}} pixel
 * @param {Int32Array} indexOfCell -1 where there is none
 * @returns {{index: number | null, content: Node[]}} the Gaussian that the pixel belongs to, and the text
 */
export function readout(scene, file, { x, y }, indexOfCell) {
  const plane = scene.planes[file];
  const at = 4 * (y * plane.width + x);
  const levels = [...plane.rgba.subarray(at, at + 4)].join(" ");
  if (gives(scene, file, "centroids")) return { index: null, content: [codebookPixel(scene, file, x, y, levels)] };
  const index = indexOfCell[y * plane.width + x] ?? -1;
  const heading = `Column ${x}, row ${y}: `;
  if (index < 0) return { index: null, content: [el("p", {}, el("b", {}, `${heading}padding`))] };
  return {
    index,
    content: [el("p", {}, el("b", {}, `${heading}Gaussian ${count(index)}`)), values(scene, index, levels)],
  };
}

/**
 * @param {import("./scene.js").Scene} scene
 * @param {number} index
 * @param {string} levels
 */
function values(scene, index, levels) {
  const { mean, deviations, rotation, opacity, colour, label } = gaussianAt(scene, index);
  const swatch = el("span", { class: "swatch" });
  swatch.style.backgroundColor = `rgb(${colour.map((part) => Math.round(255 * part)).join(" ")})`;
  const list = (/** @type {number[]} */ numbers) => numbers.map(short).join("  ");
  /** What it is read from may be damaged. @type {(attribute: import("./scene.js").Attribute, value: string | Node) => string | Node} */
  const from = (attribute, value) => (holds(scene, attribute) ? value : "not known");
  /** @type {[string, string | Node][]} */
  const rows = [
    ["Position", from("high means", list(mean))],
    ["Deviations", from("scales", list(deviations))],
    ["Quaternion", from("quats", rotation.map((part) => part.toFixed(3).replace("-", "−")).join("  "))],
    ["Colour", from("sh0", el("span", {}, swatch, colour.map((part) => Math.round(255 * part)).join("  ")))],
    ["Opacity", from("opacities", share(opacity))],
    ["SH entry", label === null ? "none" : from("labels", count(label))],
    ["Levels RGBA", levels],
  ];
  return el("dl", {}, ...rows.map(([name, value]) => el("div", {}, el("dt", {}, name), el("dd", {}, value))));
}

/**
 * @param {import("./scene.js").Scene} scene
 * @param {string} file
 * @param {number} x
 * @param {number} y
 * @param {string} levels
 */
function codebookPixel(scene, file, x, y, levels) {
  const { codebookSide: side, labels, planes } = scene;
  const across = planes[file].width / ENTRIES_PER_ROW; // coefficients beside each other, in SOG
  const coefficient = side ? Math.floor(y / side) * TILES_PER_ROW + Math.floor(x / side) : x % across;
  const entry = side ? (y % side) * side + (x % side) : y * ENTRIES_PER_ROW + Math.floor(x / across);
  const uses = holds(scene, "labels") ? labels.reduce((sum, label) => sum + Number(label === entry), 0) : null;
  const text = `Entry ${count(entry)}, coefficient ${coefficient + 1}: `;
  return el("p", {}, el("b", {}, text), `levels ${levels}${uses === null ? "" : `, used by ${count(uses)} Gaussians`}`);
}
