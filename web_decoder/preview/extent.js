/** The position and size of a scene. */

import { sigmoid } from "./scene.js";

const SAMPLES = 20_000;
const DISTANT = 0.85; // share of the opacity within the radius; the rest may be sky and outliers

/**
 * The nearest share of a scene that has been merged, and the radius in units of its own. Merging thins dense parts more
 * than sparse ones, so that a sky may be more than half of the coarsest level. A ball of even density has a radius of
 * 1.4 of these units, a disc one of 1.6.
 */
const [NEAR, REACH] = [0.4, 2.5];

/** Length of the mean direction from which far Gaussians do not surround a scene. Half a sphere has 0.5. */
const ONE_SIDED = 0.7;

/**
 * @typedef {{centre: number[], radius: number}} Extent
 * @typedef {[count: number, mean: (index: number) => ArrayLike<number>, weight: (index: number) => number]} Gaussians
 *   their number, positions and opacities
 */

/**
 * Return the opacity-weighted median of a scene, and the radius that contains most of it, without outliers; 1 for a
 * scene without any size.
 * @param {number} count
 * @param {(index: number) => ArrayLike<number>} mean position of a Gaussian
 * @param {(index: number) => number} weight
 * @returns {Extent}
 */
export function extentOf(count, mean, weight) {
  const { centre, radius } = measure(count, mean, weight, false);
  return { centre, radius: radius || 1 };
}

/**
 * @param {number} count
 * @param {(index: number) => ArrayLike<number>} mean
 * @param {(index: number) => number} weight
 * @param {boolean} merged whether what surrounds the scene may have too large a share, and must not set the radius
 */
function measure(count, mean, weight, merged) {
  const step = Math.max(1, Math.floor(count / SAMPLES));
  const [points, weights] = [/** @type {number[][]} */ ([]), /** @type {number[]} */ ([])];
  for (let i = 0; i < count; i += step) {
    points.push(Array.from(mean(i)));
    weights.push(weight(i));
  }
  const centre = [0, 1, 2].map((axis) =>
    quantile(
      points.map((point) => point[axis]),
      weights,
      0.5,
    ),
  );
  const offsets = points.map((point) => point.map((value, axis) => value - centre[axis]));
  const distances = offsets.map((offset) => Math.hypot(...offset));
  const radius = quantile(distances, weights, DISTANT);
  const limit = merged ? REACH * quantile(distances, weights, NEAR) : 0; // 0 also where so many share one position
  const limited = limit > 0 && limit < radius && surrounds(offsets, distances, weights, limit);
  return { centre, radius: limited ? limit : radius };
}

/**
 * Whether what is farther than a radius lies around the scene, not on one side of it.
 * @param {number[][]} offsets from the centre
 * @param {number[]} distances lengths of the offsets
 * @param {number[]} weights
 * @param {number} radius
 */
function surrounds(offsets, distances, weights, radius) {
  const sums = [0, 0, 0];
  let total = 0;
  offsets.forEach((offset, i) => {
    if (distances[i] <= radius) return;
    total += weights[i];
    offset.forEach((value, axis) => (sums[axis] += (weights[i] * value) / distances[i]));
  });
  return Math.hypot(...sums) < ONE_SIDED * total;
}

/** @type {(scene: import("./scene.js").Scene) => Gaussians} */
export const gaussiansOf = ({ count, means, opacities }) => [
  count,
  (i) => means.subarray(3 * i, 3 * i + 3),
  (i) => sigmoid(opacities[i]),
];

/** @param {import("./scene.js").Scene} scene */
export const extentOfScene = (scene) => extentOf(...gaussiansOf(scene));

/**
 * Return the extent of a streamed scene by the Gaussians of its coarsest level, each of which stands for several; null
 * if none were loaded, or if they have no size.
 * @param {import("./lod_tree.js").LodTree["leaves"]} leaves
 * @param {Map<number, import("./scene.js").Scene>} files that hold the level, as far as they were loaded
 * @returns {Extent | null}
 */
export function extentOfCoarsest(leaves, files) {
  const [points, weights] = [/** @type {Float32Array[]} */ ([]), /** @type {number[]} */ ([])];
  for (const { levels } of leaves) {
    const [{ file, offset, count }] = levels;
    const scene = files.get(file);
    if (!scene) continue;
    const each = (levels.at(-1)?.count ?? count) / count;
    for (let row = offset; row < offset + count; row++) {
      points.push(scene.means.subarray(3 * row, 3 * row + 3));
      weights.push(each * sigmoid(scene.opacities[row]));
    }
  }
  const extent = measure(
    points.length,
    (i) => points[i],
    (i) => weights[i],
    true,
  );
  return extent.radius > 0 ? extent : null;
}

/** Ends of the points that stand for a box, as shares of its sides: they spread as far as points all over it. */
const SPREAD = [0.5 - Math.sqrt(1 / 12), 0.5 + Math.sqrt(1 / 12)];

/**
 * Return the extent of a scene of which only boxes are known.
 * @param {import("./coverage.js").Box[]} boxes
 * @param {number[]} weights
 */
export const extentOfBoxes = (boxes, weights) =>
  extentOf(
    8 * boxes.length,
    (i) => {
      const { low, high } = boxes[i >> 3];
      return low.map((start, axis) => start + SPREAD[(i >> axis) & 1] * (high[axis] - start));
    },
    (i) => weights[i >> 3],
  );

/**
 * Return the Gaussians of a mesh, with y down and z ahead.
 * @param {import("@sparkjsdev/spark").SplatMesh} mesh
 * @param {boolean} up whether y points up and z back in the mesh
 * @returns {Gaussians}
 */
export function gaussiansOfMesh(mesh, up) {
  const sign = up ? -1 : 1;
  const [means, weights] = [new Float32Array(3 * mesh.numSplats), new Float32Array(mesh.numSplats)];
  mesh.forEachSplat((index, centre, _scales, _rotation, opacity) => {
    means.set([centre.x, sign * centre.y, sign * centre.z], 3 * index);
    weights[index] = opacity;
  });
  return [mesh.numSplats, (i) => means.subarray(3 * i, 3 * i + 3), (i) => weights[i]];
}

/** @type {(values: number[], weights: number[], share: number) => number} */
const quantile = (values, weights, share) => quantiles(values, weights, [share])[0];

/**
 * Return the values at which ascending shares of the weight are reached; 0 without values.
 * @param {number[]} values
 * @param {number[]} weights
 * @param {number[]} shares
 */
export function quantiles(values, weights, shares) {
  const order = values.map((_, i) => i).sort((a, b) => values[a] - values[b]);
  const total = weights.reduce((sum, weight) => sum + weight, 0);
  let [at, left] = [-1, 0];
  return shares.map((share) => {
    left += share * total;
    while (at < order.length - 1 && (at < 0 || left > 0)) left -= weights[order[++at]];
    const value = values[order[at]] ?? 0;
    left -= share * total;
    return value;
  });
}
