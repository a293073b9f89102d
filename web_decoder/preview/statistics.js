/** Statistics of a container. */

import { META } from "../container.js";
import { el } from "./dom.js";
import { bytes, count, duration, share, short } from "./format.js";
import { attributes } from "./words.js";

/**
 * @typedef {object} Facts
 * @property {import("./scene.js").Scene} scene
 * @property {number} [bytes] size of the container, if known; else the sum of its files is used
 * @property {number} [originalBytes]
 * @property {number | null} seconds to load and decode; null if that failed
 */

/** @param {Facts} facts */
export function statisticsView({ scene, bytes: known, originalBytes, seconds }) {
  const { [META]: metadata, ...images } = scene.sizes;
  const loaded = Object.values(images).reduce((sum, size) => sum + size, 0);
  const whole = known !== undefined && seconds !== null;
  const total = Math.max(known ?? 0, loaded + (whole ? 0 : metadata));
  // Metadata is smaller inside a zip, and not all of it was needed.
  const sizes = { ...images, [META]: whole ? total - loaded : metadata };
  /** @type {[string, string, string?][]} */
  const pairs = [
    ["Gaussians", count(scene.count)],
    ["SH degree", String(scene.degree)],
    ["Bytes", bytes(total), count(total)],
    ["Per Gaussian", seconds === null ? "not known" : perGaussian(total, scene.count)],
    ["Loaded in", seconds === null ? "cut short" : duration(seconds)],
    [
      "Original",
      originalBytes ? `${short(originalBytes / total)}×` : "not known",
      originalBytes ? `of ${bytes(originalBytes)}` : undefined,
    ],
  ];
  return [el("h2", { id: "statistics-title" }, "Statistics"), list(pairs), table(sizes, total)];
}

/**
 * @param {number} size
 * @param {number} gaussians
 */
const perGaussian = (size, gaussians) => (gaussians ? `${short((8 * size) / gaussians)} bits` : "none");

/**
 * Return the statistics of a file that Spark has read.
 * @param {number} gaussians
 * @param {number} size
 */
export const fileStatisticsView = (gaussians, size) => [
  el("h2", { id: "statistics-title" }, "Statistics"),
  list([
    ["Gaussians", count(gaussians)],
    ["Bytes", bytes(size), count(size)],
    ["Per Gaussian", perGaussian(size, gaussians)],
  ]),
];

/** @param {[string, string, string?][]} pairs */
function list(pairs) {
  const items = pairs.map(([name, value, remark]) =>
    el("div", {}, el("dt", {}, name), el("dd", {}, value, remark ? el("small", {}, remark) : null)),
  );
  return el("dl", { class: "facts" }, ...items);
}

/**
 * @param {Record<string, number>} sizes
 * @param {number} total
 */
function table(sizes, total) {
  const rows = attributes(sizes);
  const largest = Math.max(...rows.map(([, size]) => size));
  const lines = rows.map(([name, size]) => {
    const bar = el("span");
    bar.style.inlineSize = `${(100 * size) / largest}%`;
    return el(
      "tr",
      {},
      el("th", { scope: "row" }, name),
      el("td", { class: "bar", "aria-hidden": "true" }, bar),
      el("td", {}, bytes(size)),
      el("td", { class: "muted" }, share(size / total)),
    );
  });
  const head = (/** @type {string} */ text) =>
    el("th", { scope: "col" }, el("span", { class: "visually-hidden" }, text));
  return el(
    "table",
    { class: "bytes" },
    el("caption", {}, "Where the bytes go"),
    el("thead", {}, el("tr", {}, head("Attribute"), el("td", { "aria-hidden": "true" }), head("Size"), head("Share"))),
    el("tbody", {}, ...lines),
  );
}
