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

/**
 * Return what is drawn and loaded of a streamed scene.
 * @param {object} facts
 * @param {import("./lod_tree.js").LodTree} facts.tree
 * @param {number} facts.budget largest number of Gaussians that are drawn
 * @param {{leaves: number, gaussians: number}[]} facts.drawn by level
 * @param {number} facts.surrounding number of Gaussians drawn of the environment
 * @param {boolean} facts.complete whether nothing is to be loaded for this view
 * @param {number} facts.received bytes
 * @param {number} facts.total bytes, estimated
 * @param {{seconds: number, bytes: number} | null} facts.first when the first image was drawn; null before
 */
export function streamedStatisticsView({ tree, budget, drawn, surrounding, complete, received, total, first }) {
  const gaussians = drawn.reduce((sum, level) => sum + level.gaussians, surrounding);
  const all = tree.count + (tree.environment === null ? 0 : tree.rows[tree.environment]);
  return [
    el("h2", { id: "statistics-title" }, "Statistics"),
    list([
      ["Gaussians drawn", count(gaussians), `of ${count(all)}`],
      ["At most", count(budget), "on this device"],
      ["Loaded", bytes(received), `of about ${bytes(Math.max(received, total))}`],
      ["First image", first ? duration(first.seconds) : "…", first ? `after ${bytes(first.bytes)}` : undefined],
      ["Levels", count(tree.levels)],
      ["This view", complete ? "complete" : "loading"],
    ]),
    levelTable(drawn, tree.leaves.length, tree.environment === null ? null : surrounding),
  ];
}

/**
 * @param {{leaves: number, gaussians: number}[]} drawn
 * @param {number} leaves
 * @param {number | null} surrounding Gaussians drawn of the environment; null without one
 */
function levelTable(drawn, leaves, surrounding) {
  const rows = drawn.map(({ leaves: own, gaussians }, level) =>
    tableRow(level ? `Level ${level}` : "Level 0, finest", own / leaves, count(own), count(gaussians)),
  );
  if (surrounding !== null) rows.push(tableRow("Environment", surrounding && 1, "", count(surrounding)));
  return barTable("What is drawn", ["Level", "Parts", "Gaussians"], rows);
}

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
  const lines = rows.map(([name, size]) => tableRow(name, size / largest, bytes(size), share(size / total)));
  return barTable("Where the bytes go", ["Attribute", "Size", "Share"], lines);
}

/** @param {string} name @param {number} part length of the bar, 0 to 1 @param {string} value @param {string} remark */
function tableRow(name, part, value, remark) {
  const bar = el("span");
  bar.style.inlineSize = `${100 * part}%`;
  return el(
    "tr",
    {},
    el("th", { scope: "row" }, name),
    el("td", { class: "bar", "aria-hidden": "true" }, part ? bar : null),
    el("td", {}, value),
    el("td", { class: "muted" }, remark),
  );
}

/** @param {string} caption @param {string[]} heads of the columns but that of bars @param {HTMLElement[]} rows */
function barTable(caption, [first, ...others], rows) {
  const head = (/** @type {string} */ text) =>
    el("th", { scope: "col" }, el("span", { class: "visually-hidden" }, text));
  return el(
    "table",
    { class: "bytes" },
    el("caption", {}, caption),
    el("thead", {}, el("tr", {}, head(first), el("td", { "aria-hidden": "true" }), ...others.map(head))),
    el("tbody", {}, ...rows),
  );
}
