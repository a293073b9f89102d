/** Decoding stages of a scene, and the values of one Gaussian in natural units. */

/** @typedef {import("../types.js").Scene} Scene */
/** @typedef {import("../types.js").Plane} Plane */

const SH_CONSTANT = 0.28209479177387814;

/** @param {number} logit */
export const sigmoid = (logit) => 1 / (1 + Math.exp(-logit));

/** @param {number} sh0 */
export const baseColour = (sh0) => 0.5 + SH_CONSTANT * sh0;

/** Stages of decoding, each of which is worth a new rendering. */
export const STAGES = /** @type {const} */ ({ nothing: 0, coarse: 1, base: 2, whole: 3 });

const POSITIONS = ["active_mask.webp", "means_bytes_1.webp"];
const COARSE = [...POSITIONS, "f_dc.webp"];
const BASE = [...COARSE, "opacities.webp", "scales.webp", "quaternions.webp", "means_bytes_0.webp"];
const SPHERICAL = ["f_rest_labels.webp", "f_rest_centroids.webp"];

/**
 * @param {Set<string>} arrived files that have been decoded
 * @param {number} degree
 */
export function stageOf(arrived, degree) {
  const have = (/** @type {string[]} */ files) => files.every((file) => arrived.has(file));
  if (have(BASE)) return degree === 0 || have(SPHERICAL) ? STAGES.whole : STAGES.base;
  return have(COARSE) ? STAGES.coarse : STAGES.nothing;
}

/**
 * Return the stage to draw after an error, when no more images will arrive.
 * @param {Set<string>} arrived
 */
export const lastStageOf = (arrived) => (POSITIONS.every((file) => arrived.has(file)) ? STAGES.whole : STAGES.nothing);

/**
 * Return which parts of a rendering are final: positions with opacities, sizes, spherical harmonics.
 * @param {Set<string>} arrived
 * @param {number} stage
 * @returns {Parts}
 */
export const partsOf = (arrived, stage) => ({
  placed: arrived.has("means_bytes_0.webp") && arrived.has("opacities.webp"), // the extent depends on both
  sized: stage >= STAGES.base && arrived.has("scales.webp"),
  spherical: SPHERICAL.every((file) => arrived.has(file)),
});

/** @typedef {{placed: boolean, sized: boolean, spherical: boolean}} Parts */

/**
 * Return the values of a Gaussian in natural units.
 * @param {Scene} scene
 * @param {number} index
 */
export function gaussianAt(scene, index) {
  const three = (/** @type {Float32Array} */ values) => [...values.subarray(3 * index, 3 * index + 3)];
  const stored = [...scene.quats.subarray(4 * index, 4 * index + 4)];
  const length = Math.hypot(...stored) || 1;
  return {
    index,
    mean: three(scene.means),
    deviations: "scales.webp" in scene.planes ? three(scene.scales).map(Math.exp) : [0, 0, 0],
    rotation: stored.map((part) => part / length),
    opacity: sigmoid(scene.opacities[index]),
    colour: three(scene.sh0).map(baseColour),
    label: scene.labels.length ? scene.labels[index] : null,
  };
}

/** @typedef {ReturnType<typeof gaussianAt>} Gaussian */
