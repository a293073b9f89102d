/** Decoding stages of a scene, and the values of one Gaussian in natural units. */

/** @typedef {import("../types.js").Scene} Scene */
/** @typedef {import("../types.js").Plane} Plane */

const SH_CONSTANT = 0.28209479177387814;

/** @param {number} logit */
export const sigmoid = (logit) => 1 / (1 + Math.exp(-logit));

/** @param {number} sh0 */
export const baseColour = (sh0) => 0.5 + SH_CONSTANT * sh0;

/** Whether a container says that its scene was trained with antialiasing. @param {Scene} scene */
export const isAntialiased = ({ meta }) =>
  String(meta?.model || meta?.asset?.model || (meta?.antialias === true && "antialiased")).toLowerCase() ===
  "antialiased";

/** Point of the world that positions are relative to. @param {Scene} scene @returns {[number, number, number]} */
export const originOf = ({ meta }) => meta?.kissgs?.origin ?? [0, 0, 0];

/** Stages of decoding, each of which is worth a new rendering. */
export const STAGES = /** @type {const} */ ({ nothing: 0, coarse: 1, base: 2, whole: 3 });

/** @typedef {import("../types.js").Attribute} Attribute */

/** @type {Attribute[]} */
const POSITIONS = ["cells", "high means"];
/** @type {Attribute[]} */
const COARSE = [...POSITIONS, "sh0"];
/** @type {Attribute[]} */
const BASE = [...COARSE, "opacities", "scales", "quats", "low means"];
/** @type {Attribute[]} */
const SPHERICAL = ["labels", "centroids"];

/** Whether an image of a container gives an attribute. @type {(scene: Scene, file: string, attribute: Attribute) => boolean} */
export const gives = ({ contents }, file, attribute) => contents[file]?.includes(attribute) ?? false;

/** Whether a scene has an attribute, because its image has been decoded and kept. @type {(scene: Scene, attribute: Attribute) => boolean} */
export const holds = (scene, attribute) => Object.keys(scene.planes).some((file) => gives(scene, file, attribute));

/**
 * @param {Set<Attribute>} arrived whose images have been decoded
 * @param {number} degree
 */
export function stageOf(arrived, degree) {
  const have = (/** @type {Attribute[]} */ attributes) => attributes.every((attribute) => arrived.has(attribute));
  if (have(BASE)) return degree === 0 || have(SPHERICAL) ? STAGES.whole : STAGES.base;
  return have(COARSE) ? STAGES.coarse : STAGES.nothing;
}

/**
 * Return the stage to draw after an error, when no more images will arrive.
 * @param {Set<Attribute>} arrived
 */
export const lastStageOf = (arrived) => (POSITIONS.every((part) => arrived.has(part)) ? STAGES.whole : STAGES.nothing);

/**
 * Return which parts of a rendering are final: positions with opacities, sizes, spherical harmonics.
 * @param {Set<Attribute>} arrived
 * @param {number} stage
 * @returns {Parts}
 */
export const partsOf = (arrived, stage) => ({
  placed: arrived.has("low means") && arrived.has("opacities"), // the extent depends on both
  sized: stage >= STAGES.base && arrived.has("scales"),
  spherical: SPHERICAL.every((part) => arrived.has(part)),
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
    deviations: holds(scene, "scales") ? three(scene.scales).map(Math.exp) : [0, 0, 0],
    rotation: stored.map((part) => part / length),
    opacity: sigmoid(scene.opacities[index]),
    colour: three(scene.sh0).map(baseColour),
    label: scene.labels.length ? scene.labels[index] : null,
  };
}

/** @typedef {ReturnType<typeof gaussianAt>} Gaussian */
