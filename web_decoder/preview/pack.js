/** Conversion of a decoded scene to Spark's format: 16 bytes per Gaussian, and up to 40 more for spherical harmonics. */

import { PackedSplats, utils } from "@sparkjsdev/spark";
import { baseColour, sigmoid } from "./scene.js";

/** @typedef {import("./scene.js").Scene} Scene */
/** @typedef {NonNullable<PackedSplats["splatEncoding"]>} Encoding */

const BANDS = [
  { name: "sh1", words: 2, from: 0, to: 3, encode: utils.encodeSh1Rgb },
  { name: "sh2", words: 4, from: 3, to: 8, encode: utils.encodeSh2Rgb },
  { name: "sh3", words: 4, from: 8, to: 15, encode: utils.encodeSh3Rgb },
];

/** Lower limit of log-scales, so that a single outlier does not coarsen the quantisation of all. */
const SMALLEST_LOG_SCALE = -14;

/**
 * @typedef {object} Packed arrays of Spark's texture and of its spherical harmonics, by row
 * @property {number} count
 * @property {Uint32Array} words four of each Gaussian
 * @property {Record<string, Uint32Array>} extra
 * @property {Encoding} encoding
 */

/** Gaussians that are converted before other events get a turn: some 10 ms. */
const TURN = 10_000;

/**
 * @param {Scene} scene
 * @param {number[]} centre subtracted from all positions, which are half floats, accurate only near zero
 * @param {object} how
 * @param {number | null} how.size standard deviation of all Gaussians until scales have arrived; null afterwards
 * @param {boolean} how.spherical whether the spherical harmonics have arrived
 */
export function pack(scene, centre, how) {
  const { packed, rows } = packing(scene, centre, how);
  rows(0, scene.count);
  return splatsOf(packed);
}

/**
 * Convert a whole scene without stopping the page for long.
 * @param {Scene} scene
 * @param {number[]} centre as of `pack`
 * @param {AbortSignal} signal
 */
export async function packInTurns(scene, centre, signal) {
  const { packed, rows } = packing(scene, centre, { size: null, spherical: true });
  for (let from = 0; from < scene.count; from += TURN) {
    await new Promise((resolve) => setTimeout(resolve));
    signal.throwIfAborted();
    rows(from, Math.min(scene.count, from + TURN));
  }
  return packed;
}

/**
 * Return Spark's form of some rows.
 * @param {Packed} packed
 * @param {[offset: number, count: number][]} ranges
 */
export function packedRows({ count: all, words, extra, encoding }, ranges) {
  const kept = ranges.map(([offset, count]) => [offset, Math.min(all, offset + count)]);
  const count = kept.reduce((sum, [from, to]) => sum + to - from, 0);
  const room = utils.computeMaxSplats(count);
  const gather = (/** @type {Uint32Array} */ array) => {
    const [size, out] = [
      array.length / utils.computeMaxSplats(all),
      new Uint32Array((array.length / utils.computeMaxSplats(all)) * room),
    ];
    let at = 0;
    for (const [from, to] of kept) {
      out.set(array.subarray(size * from, size * to), size * at);
      at += to - from;
    }
    return out;
  };
  const gathered = Object.fromEntries(Object.entries(extra).map(([name, array]) => [name, gather(array)]));
  return splatsOf({ count, words: gather(words), extra: gathered, encoding });
}

/** @param {Packed} packed */
const splatsOf = ({ count, words, extra, encoding }) => ({
  splats: new PackedSplats({ packedArray: words, numSplats: count, extra, splatEncoding: encoding }),
  encoding,
});

/** @param {Scene} scene @param {number[]} centre @param {{size: number | null, spherical: boolean}} how */
function packing(scene, centre, { size, spherical }) {
  const { count, means, quats } = scene;
  const encoding = encodingOf(scene, size);
  // Spark shows whole rows of its texture only: shorter arrays would lose Gaussians.
  const room = utils.computeMaxSplats(count);
  const words = new Uint32Array(4 * room);
  /** @param {number} from @param {number} to */
  function rows(from, to) {
    for (let i = from, a = 3 * from, q = 4 * from; i < to; i++, a += 3, q += 4) {
      const length = Math.hypot(quats[q], quats[q + 1], quats[q + 2], quats[q + 3]) || 1;
      utils.setPackedSplat(
        words,
        i,
        means[a] - centre[0],
        means[a + 1] - centre[1],
        means[a + 2] - centre[2],
        size ?? Math.exp(Math.max(SMALLEST_LOG_SCALE, scene.scales[a])),
        size ?? Math.exp(Math.max(SMALLEST_LOG_SCALE, scene.scales[a + 1])),
        size ?? Math.exp(Math.max(SMALLEST_LOG_SCALE, scene.scales[a + 2])),
        quats[q + 1] / length,
        quats[q + 2] / length,
        quats[q + 3] / length,
        quats[q] / length,
        sigmoid(scene.opacities[i]),
        baseColour(scene.sh0[a]),
        baseColour(scene.sh0[a + 1]),
        baseColour(scene.sh0[a + 2]),
        encoding,
      );
    }
  }
  const extra = spherical ? sphericalHarmonics(scene, encoding, room) : {};
  return { packed: { count, words, extra, encoding }, rows };
}

/**
 * Return the ranges of Spark's quantisation, no wider than the scene needs.
 * @param {Scene} scene
 * @param {number | null} size
 */
function encodingOf(scene, size) {
  const [darkest, brightest] = rangeOf(scene.sh0);
  const [smallest, largest] = size === null ? rangeOf(scene.scales) : [Math.log(size), Math.log(size)];
  const lnScaleMin = Math.max(SMALLEST_LOG_SCALE, smallest);
  const encoding = {
    rgbMin: Math.min(0, baseColour(darkest)),
    rgbMax: Math.max(1, baseColour(brightest)),
    lnScaleMin,
    lnScaleMax: Math.max(lnScaleMin + 1, largest),
    sh1Max: 1,
    sh2Max: 1,
    sh3Max: 1,
    lodOpacity: false, // required by Spark's reader of .ply files
  };
  const names = /** @type {const} */ (["sh1Max", "sh2Max", "sh3Max"]);
  names.forEach((name, at) => (encoding[name] = largestOf(scene, BANDS[at].from, BANDS[at].to) || 1));
  return encoding;
}

/** @param {Float32Array} values */
function rangeOf(values) {
  let [low, high] = [Infinity, -Infinity];
  for (const value of values) {
    if (value < low) low = value;
    if (value > high) high = value;
  }
  return [low, high];
}

/** @param {number} degree */
const coefficientsOf = (degree) => [0, 3, 8, 15][degree];

/**
 * @param {Scene} scene
 * @param {number} from
 * @param {number} to
 */
function largestOf({ centroids, degree }, from, to) {
  const stride = 3 * coefficientsOf(degree);
  let largest = 0;
  if (3 * to > stride) return largest;
  for (let entry = 0; entry < centroids.length; entry += stride)
    for (let at = entry + 3 * from; at < entry + 3 * to; at++) largest = Math.max(largest, Math.abs(centroids[at]));
  return largest;
}

/**
 * Encode each codebook entry once, and copy the words to Gaussians, which is many times faster.
 * @param {Scene} scene
 * @param {ReturnType<typeof encodingOf>} encoding
 * @param {number} room
 */
function sphericalHarmonics({ count, degree, labels, centroids }, encoding, room) {
  /** @type {Record<string, Uint32Array>} */
  const extra = {};
  if (!labels.length || !centroids.length) return extra;
  const stride = 3 * coefficientsOf(degree);
  const entries = centroids.length / stride;
  for (const { name, words, from, to, encode } of BANDS.slice(0, degree)) {
    const book = new Uint32Array(words * entries);
    for (let entry = 0; entry < entries; entry++)
      encode(book, entry, centroids.subarray(entry * stride + 3 * from, entry * stride + 3 * to), encoding);
    const all = (extra[name] = new Uint32Array(words * room));
    for (let i = 0, at = 0; i < count; i++)
      for (let word = words * labels[i], end = word + words; word < end; word++) all[at++] = book[word];
  }
  return extra;
}
