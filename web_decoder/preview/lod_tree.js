/** The manifest of a streamed scene: its leaves, and the files that hold their levels. */

import { parseMeta } from "../container.js";
import { UserError } from "./problem.js";
import { checkedView } from "./view.js";

/** @typedef {import("./choice.js").Level} Level */

/**
 * @typedef {object} LodTree
 * @property {number} levels number of levels
 * @property {string[]} files relative to the manifest
 * @property {number[]} rows Gaussians of each file that the leaves name
 * @property {number | null} environment index of the file that is drawn always
 * @property {(import("./coverage.js").Box & {levels: Level[]})[]} leaves levels: the coarsest first
 * @property {number} count Gaussians of the finest level of all leaves
 * @property {import("./view.js").View | null} view the recorded one
 */

const MAX_LEVELS = 64;

/** Files with more rows are refused: encoders of streamed scenes write some 500,000. */
export const MAX_FILE_GAUSSIANS = 10_000_000;

/** Whether an address is that of a manifest, not of a container. @param {string} address */
export const isManifest = (address) => /\/(lod-meta|levels)\.json([?#]|$)/.test(address);

/** @type {(why: string) => never} */
const fail = (why) => {
  throw new UserError(`The list of this scene's files is damaged: ${why}.`);
};

const isWhole = (/** @type {unknown} */ value) => Number.isSafeInteger(value) && Number(value) >= 0;
const isPoint = (/** @type {unknown} */ value) =>
  Array.isArray(value) && value.length === 3 && value.every(Number.isFinite);

/**
 * Whether a name is a path below the manifest's folder: no other site, no folder above. Addresses lose spaces at their
 * ends and control characters, which may hide a folder above.
 * @param {unknown} name
 */
const isBelow = (name) =>
  typeof name === "string" &&
  name === name.trim() &&
  /^(?!\.{1,2}(\/|$))[^/\\:?#%\p{Cc}]+(\/(?!\.{1,2}(\/|$))[^/\\:?#%\p{Cc}]+)*$/u.test(name);

/** Whether two names lead to the same file. @param {string[]} names */
const isRepeated = (names) => new Set(names.map((name) => new URL(name, "http://x/").href)).size < names.length;

/**
 * @param {Uint8Array} json
 * @returns {LodTree}
 */
export function parseTree(json) {
  const document = parse(json);
  if ((document?.version ?? 1) !== 1) fail(`it is of version ${document.version}, and 1 is read`);
  const { lodLevels: levels, filenames, environment, tree } = document ?? {};
  if (!isWhole(levels) || levels < 1 || levels > MAX_LEVELS) fail("its number of levels is missing");
  const files = Array.isArray(filenames) ? [...filenames] : fail("it names no files");
  if (environment ?? null) files.push(environment);
  if (!files.every(isBelow)) fail("it names a file that is not below its folder");
  if (isRepeated(files)) fail("it names a file twice");
  const rows = files.map(() => 0);
  const leaves = leavesOf(tree).map((node) => {
    const { min: low, max: high } = node.bound ?? {};
    if (!isPoint(low) || !isPoint(high)) fail("a leaf has no bounds");
    const own = levelsOf(node, levels, filenames.length);
    for (const { file, offset, count } of own) rows[file] = Math.max(rows[file], offset + count);
    if (own.some(({ file }) => rows[file] > MAX_FILE_GAUSSIANS)) fail("a leaf names more rows than a file may have");
    return { low, high, levels: own };
  });
  const filled = leaves.filter((leaf) => leaf.levels.length);
  if (!filled.length) fail("it has no leaves");
  return {
    ...{ levels, files, rows, leaves: filled },
    view: checkedView(document.kissgs?.view),
    environment: (environment ?? null) ? files.length - 1 : null,
    count: filled.reduce((sum, leaf) => sum + leaf.levels[leaf.levels.length - 1].count, 0),
  };
}

/** @param {Uint8Array} json */
function parse(json) {
  try {
    return parseMeta(json);
  } catch {
    return fail("it is not readable JSON");
  }
}

/** Return the nodes with levels, in the order of the tree. @param {any} tree @returns {any[]} */
function leavesOf(tree) {
  const [leaves, waiting] = [[], [tree]];
  while (waiting.length) {
    const node = waiting.pop();
    if (typeof node !== "object" || node === null) fail("its tree has a node that is none");
    if (node.lods) leaves.push(/** @type {never} */ (node));
    else if (Array.isArray(node.children)) for (const child of [...node.children].reverse()) waiting.push(child);
  }
  return leaves;
}

/**
 * Return the levels of a leaf, the coarsest first. Without measured errors, the square grows with each halving of the
 * Gaussians, as it does in scenes whose errors were measured.
 * @param {any} node
 * @param {number} levels
 * @param {number} files
 * @returns {Level[]}
 */
function levelsOf({ lods, errors }, levels, files) {
  const measured = Array.isArray(errors) && errors.length === levels && errors.every(Number.isFinite);
  const own = Object.entries(lods)
    .map(([key, lod]) => {
      const { file, offset, count } = lod ?? {};
      const level = /^\d{1,2}$/.test(key) ? Number(key) : levels;
      if (level >= levels || ![file, offset, count].every(isWhole) || file >= files)
        fail("a leaf's levels are unclear");
      return { level, file, offset, count };
    })
    .filter(({ count }) => count > 0)
    .sort((one, other) => other.level - one.level);
  const finest = own.at(-1)?.count ?? 1;
  const guess = (/** @type {number} */ count) => Math.sqrt(Math.max(0, Math.log2(finest / count)));
  return own.map((level) => ({ ...level, error: measured ? errors[level.level] : guess(level.count) }));
}
