/** Which level of detail each leaf of a streamed scene is drawn in, within a budget of Gaussians. */

/**
 * @typedef {object} Level of a leaf
 * @property {number} level 0 is the finest
 * @property {number} file index in the manifest's `filenames`
 * @property {number} offset first row in the file
 * @property {number} count number of Gaussians
 * @property {number} error root mean square error of an image that the leaf fills
 */

/**
 * How much more a level that is in use counts: so the choice does not alternate between two that are about as good.
 */
export const IN_USE = 1.25;

/**
 * Return for each leaf which of its levels to draw: an index into its list, or -1 if none is available.
 *
 * All leaves begin with their coarsest level, whatever the budget. Then the leaf is refined whose squared error, times
 * the pixels that it covers, falls most per additional Gaussian, until no step fits into the budget. A level that has a
 * Gaussian per pixel already is not refined.
 * @param {Level[][]} leaves levels of each leaf, the coarsest first
 * @param {ArrayLike<number>} areas pixels that each leaf covers
 * @param {number} budget largest number of Gaussians
 * @param {object} [options]
 * @param {(level: Level) => boolean} [options.available] default: all are
 * @param {ArrayLike<number>} [options.current] the former result
 * @returns {number[]}
 */
export function chooseLevels(leaves, areas, budget, { available = () => true, current = [] } = {}) {
  const chosen = leaves.map((levels) => levels.findIndex(available));
  let left = chosen.reduce((rest, at, leaf) => (at < 0 ? rest : rest - leaves[leaf][at].count), budget);

  /** Return the best step of a leaf that fits, or null. @param {number} leaf @returns {Step | null} */
  function stepOf(leaf) {
    const levels = leaves[leaf];
    const from = levels[chosen[leaf]];
    /** @type {Step | null} */
    let best = null;
    let before = from; // the level that makes this step superfluous if it has a Gaussian per pixel
    for (let to = chosen[leaf] + 1; to < levels.length; to++) {
      if (!available(levels[to])) continue;
      const area = areas[leaf] * (to <= (current[leaf] ?? -1) ? IN_USE : 1);
      if (before.count >= area) break;
      before = levels[to];
      const cost = before.count - from.count;
      const gain = area * (from.error ** 2 - before.error ** 2);
      const slope = gain / Math.max(cost, 1);
      if (gain > 0 && cost <= left && slope >= (best?.slope ?? 0)) best = { leaf, to, cost, slope };
    }
    return best;
  }

  const heap = new Heap();
  const offer = (/** @type {number} */ leaf) => {
    const step = chosen[leaf] < 0 ? null : stepOf(leaf);
    if (step) heap.push(step);
  };
  for (const leaf of leaves.keys()) offer(leaf);
  for (let step = heap.pop(); step; step = heap.pop()) {
    if (step.cost <= left) {
      chosen[step.leaf] = step.to;
      left -= step.cost;
    }
    offer(step.leaf); // the next step, or a smaller one
  }
  return chosen;
}

/** @typedef {{leaf: number, to: number, cost: number, slope: number}} Step */

/** A binary heap whose first element has the largest slope; of equal ones, the leaf that comes first. */
class Heap {
  /** @type {Step[]} */
  #steps = [];

  /** @param {number} i @param {number} j */
  #before(i, j) {
    const [one, other] = [this.#steps[i], this.#steps[j]];
    return one.slope > other.slope || (one.slope === other.slope && one.leaf < other.leaf);
  }

  /** @param {number} i @param {number} j */
  #swap(i, j) {
    [this.#steps[i], this.#steps[j]] = [this.#steps[j], this.#steps[i]];
  }

  /** @param {Step} step */
  push(step) {
    let at = this.#steps.push(step) - 1;
    for (let up = (at - 1) >> 1; at > 0 && this.#before(at, up); up = (at - 1) >> 1) {
      this.#swap(at, up);
      at = up;
    }
  }

  /** @returns {Step | undefined} */
  pop() {
    const [first] = this.#steps;
    const last = this.#steps.pop();
    if (!this.#steps.length || !last) return first;
    this.#steps[0] = last;
    for (let at = 0, next = 0; ; at = next) {
      for (const child of [2 * at + 1, 2 * at + 2])
        if (child < this.#steps.length && this.#before(child, next)) next = child;
      if (next === at) return first;
      this.#swap(at, next);
    }
  }
}
