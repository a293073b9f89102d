/** Which files of a streamed scene to hold, so that its leaves come as near to their wanted levels as memory allows. */

import { IN_USE } from "./choice.js";

/** @typedef {import("./choice.js").Level} Level */

/**
 * Return files to hold beside those of the coarsest levels, the most useful first.
 *
 * A file is worth what it takes from the squared errors of its leaves, times their pixels, per Gaussian of the file. The
 * most valuable file that fits is added, again and again; files that others make superfluous are left out. So a coarse
 * file that serves many leaves is held where there is no room for all the fine ones.
 * @param {Level[][]} leaves levels of each leaf, the coarsest first
 * @param {number[]} wanted index of the level that each leaf should have, or a coarser one
 * @param {number[]} areas pixels that each leaf covers
 * @param {number[]} sizes Gaussians of each file
 * @param {number} room sum of the sizes of the files
 * @param {(file: number) => boolean} [held] whether a file is there already, and need not be loaded
 * @param {(file: number) => boolean} [lost] whether a file cannot be loaded
 * @returns {number[]}
 */
export function planFiles(leaves, wanted, areas, sizes, room, held = () => false, lost = () => false) {
  const best = leaves.map(() => 0);
  /** @type {Set<number>} */
  const files = new Set();
  for (let left = room; ;) {
    const gains = gainsOf(leaves, wanted, areas, best);
    let [next, value] = [-1, 0];
    for (const [file, gain] of gains) {
      const worth = ((held(file) ? IN_USE : 1) * gain) / Math.max(1, sizes[file]);
      if (worth > value && sizes[file] <= left && !lost(file)) [next, value] = [file, worth];
    }
    if (next < 0) break;
    files.add(next);
    leaves.forEach((levels, leaf) => {
      for (let at = best[leaf] + 1; at <= wanted[leaf]; at++) if (levels[at].file === next) best[leaf] = at;
    });
    const used = new Set(best.map((at, leaf) => leaves[leaf][at].file));
    for (const file of files) if (!used.has(file)) files.delete(file);
    left = [...files].reduce((rest, file) => rest - sizes[file], room);
  }
  const gains = gainsOf(leaves, best, areas, [], (at, leaf) => at === best[leaf]);
  const worth = (/** @type {number} */ file) => (gains.get(file) ?? 0) / Math.max(1, sizes[file]);
  return [...files].sort((one, other) => worth(other) - worth(one) || one - other);
}

/**
 * Return what each file takes from the errors of leaves that have other levels.
 * @param {Level[][]} leaves
 * @param {number[]} finest index of the finest level that counts
 * @param {number[]} areas
 * @param {number[]} best index of the level that each leaf has
 * @param {(at: number, leaf: number) => boolean} [counts]
 */
function gainsOf(leaves, finest, areas, best, counts = () => true) {
  /** @type {Map<number, number>} */
  const gains = new Map();
  leaves.forEach((levels, leaf) => {
    const from = best[leaf] ?? 0;
    for (let at = from + 1; at <= finest[leaf]; at++) {
      if (!counts(at, leaf)) continue;
      const gain = areas[leaf] * (levels[from].error ** 2 - levels[at].error ** 2);
      if (gain > 0) gains.set(levels[at].file, (gains.get(levels[at].file) ?? 0) + gain);
    }
  });
  return gains;
}
