/** A streamed scene: which files are loaded and which rows of them are drawn, as the camera moves. */

import { chooseLevels } from "./choice.js";
import { areaOf, isOutside } from "./coverage.js";
import { planFiles } from "./file_plan.js";
import { FileStore } from "./file_store.js";
import { UserError } from "./problem.js";

/**
 * @typedef {import("./lod_tree.js").LodTree} LodTree
 * @typedef {import("./coverage.js").View} View
 * @typedef {import("./choice.js").Level} Level
 * @typedef {[offset: number, count: number][]} Ranges rows of a file
 */

/** Files of Gaussians that are loaded at once; each may be a folder of up to eight files. */
const FILES_AT_ONCE = 2;

/** Gaussians in memory for each that may be drawn: a file is loaded whole, even if one leaf of it is drawn. */
const HELD_PER_DRAWN = 4;

/**
 * @template {{count: number}} S a loaded file, with the number of its rows
 * @template T what is drawn of it
 */
export class Streaming {
  /** Index of the level of each leaf that is drawn, -1 for none. @type {number[]} */
  #shown;
  /** Index of the level of each leaf that is loaded if it is not. @type {number[]} */
  #wanted;
  /** Pixels of each leaf, 0 of those that the image does not show. @type {number[]} */
  #visible = [];
  /** What is drawn of each file, as text to compare. @type {Map<number, string>} */
  #drawn = new Map();
  /** Whether something has arrived that is not drawn yet. */
  #stale = true;

  /**
   * @param {LodTree} tree
   * @param {object} options
   * @param {number} options.budget largest number of Gaussians to draw
   * @param {(file: number, signal: AbortSignal) => Promise<S>} options.load
   * @param {(file: number, loaded: S, signal: AbortSignal) => Promise<T>} options.prepare called for files that have the
   *   rows that the tree names
   * @param {(parts: Map<number, {content: T, ranges: Ranges} | null>) => void} options.draw draws other rows of some
   *   files than before, or none; all at once, so that no leaf is drawn in two levels, or in none
   * @param {() => void} options.changed called when a file has arrived or will not: time to `look` again
   * @param {(file: number, error: unknown) => void} options.failed
   */
  constructor(tree, { budget, load, prepare, draw, changed, failed }) {
    this.tree = tree;
    this.budget = budget;
    this.draw = draw;
    const { leaves, rows, environment } = tree;
    this.#shown = leaves.map(() => -1);
    this.#wanted = leaves.map(() => 0);
    this.levels = leaves.map((leaf) => leaf.levels);
    /** Files that are always held: those of the coarsest levels, and the environment. */
    this.base = [...new Set(this.levels.map(([coarsest]) => coarsest.file))];
    if (environment !== null) this.base.push(environment);
    this.room = Math.max(
      HELD_PER_DRAWN * budget,
      this.#rowsOf(this.base) + rows.reduce((most, own) => Math.max(most, own), 0),
    );
    this.store = new FileStore({
      ...{ sizes: rows, room: this.room, most: FILES_AT_ONCE, failed },
      load: async (file, signal) => prepare(file, this.#checked(file, await load(file, signal)), signal),
      changed: () => {
        this.#stale = true;
        changed();
      },
    });
  }

  /** @param {number} file @param {S} loaded */
  #checked(file, loaded) {
    const { rows, files, environment } = this.tree;
    if (file === environment) rows[file] = loaded.count; // the manifest does not tell it
    if (loaded.count < rows[file])
      throw new UserError(
        `${files[file]} has ${loaded.count} Gaussians, fewer than the list of this scene's files names`,
      );
    return loaded;
  }

  /** Whether all coarsest levels have arrived, or cannot. */
  get begun() {
    return this.base.every((file) => this.store.has(file) || this.store.isLost(file));
  }

  /** Whether everything that the camera sees is drawn as well as the budget allows. */
  get complete() {
    return this.begun && this.store.idle && !this.#stale;
  }

  /** Number of leaves and of Gaussians drawn, by level; the environment is not among them. */
  get drawn() {
    const found = Array.from({ length: this.tree.levels }, () => ({ leaves: 0, gaussians: 0 }));
    this.#shown.forEach((at, leaf) => {
      if (at < 0) return;
      const { level, count } = this.levels[leaf][at];
      found[level].leaves++;
      found[level].gaussians += count;
    });
    return found;
  }

  /** Number of Gaussians of the environment that are drawn: all or none. */
  get surrounding() {
    const { environment, rows } = this.tree;
    return environment !== null && this.#drawn.has(environment) ? rows[environment] : 0;
  }

  /** Files that cannot be loaded, and whose rows the latest view lacks. */
  get lacking() {
    const { environment } = this.tree;
    const needed = environment === null ? [] : [environment];
    this.levels.forEach((levels, leaf) => {
      const [at, wanted] = [this.#shown[leaf], this.#wanted[leaf]];
      if (!this.#visible[leaf] || at >= wanted) return;
      if (at < 0) needed.push(levels[0].file);
      needed.push(levels[wanted].file);
    });
    return [...new Set(needed)].filter(this.store.isLost);
  }

  /**
   * Choose files and levels for a camera, and draw what has changed.
   * @param {View} view
   */
  look(view) {
    const { leaves, rows, environment } = this.tree;
    const areas = leaves.map((leaf) => areaOf(view, leaf));
    const outside = leaves.map((leaf) => isOutside(view, leaf));
    const visible = (this.#visible = areas.map((area, leaf) => (outside[leaf] ? 0 : area)));
    const budget = this.budget - (environment === null ? 0 : rows[environment]);
    this.#wanted = chooseLevels(this.levels, visible, budget, { current: this.#wanted });
    this.store.want(this.begun ? [...this.base, ...this.#files(visible)] : this.base);
    const loaded = rows.map((_, file) => this.store.has(file));
    const options = { available: (/** @type {Level} */ { file }) => loaded[file], current: this.#shown };
    const inside = chooseLevels(this.levels, visible, budget, options);
    // What the image does not show has what remains of the budget, for the moment when the camera turns to it.
    const others = areas.map((area, leaf) => (outside[leaf] ? area : 0));
    const coarsest = this.levels.map((levels) => levels.findIndex(options.available));
    const left = budget - this.#countOf(inside) + this.#countOf(coarsest);
    const turned = chooseLevels(this.levels, others, left, options);
    this.#shown = inside.map((at, leaf) => (outside[leaf] ? turned[leaf] : at));
    this.#stale = false;
    this.#redraw();
  }

  /** Forget everything. */
  close() {
    this.store.close();
  }

  /** @param {number[]} files */
  #rowsOf = (files) => files.reduce((sum, file) => sum + this.tree.rows[file], 0);

  /** @param {number[]} chosen */
  #countOf = (chosen) => chosen.reduce((sum, at, leaf) => sum + (this.levels[leaf][at]?.count ?? 0), 0);

  /** Return the files to hold beside those of `base`. @param {number[]} visible pixels of each leaf */
  #files(visible) {
    const { rows } = this.tree;
    const { has, isLost } = this.store;
    return planFiles(this.levels, this.#wanted, visible, rows, this.room - this.#rowsOf(this.base), has, isLost);
  }

  #redraw() {
    /** @type {Map<number, Ranges>} */
    const ranges = new Map();
    this.#shown.forEach((at, leaf) => {
      if (at < 0) return;
      const { file, offset, count } = this.levels[leaf][at];
      const own = ranges.get(file) ?? [];
      own.push([offset, count]);
      ranges.set(file, own);
    });
    const { environment } = this.tree;
    if (environment !== null && this.store.has(environment)) ranges.set(environment, [[0, Infinity]]);
    /** @type {Map<number, {content: T, ranges: Ranges} | null>} */
    const parts = new Map();
    for (const file of this.#drawn.keys()) if (!ranges.has(file)) parts.set(file, null);
    for (const [file, own] of ranges) {
      const content = this.store.get(file);
      if (content !== undefined && this.#drawn.get(file) !== String(own)) parts.set(file, { content, ranges: own });
    }
    if (!parts.size) return;
    for (const [file, part] of parts)
      if (part) this.#drawn.set(file, String(part.ranges));
      else this.#drawn.delete(file);
    this.draw(parts);
  }
}
