/** Names of the files of a container on this page. */

/** @type {[RegExp, string][]} */
const NAMES = [
  [/^active_mask\b/, "Mask"],
  [/^means_(bytes_1|u)\b/, "Positions, high bytes"],
  [/^means_(bytes_0|l)\b/, "Positions, low bytes"],
  [/^f_dc\b/, "Base colours"],
  [/^sh0\b/, "Colours, opacities"],
  [/^opacities\b/, "Opacities"],
  [/^scales\b/, "Scales"],
  [/^quat(ernion)?s\b/, "Rotations"],
  [/^(f_rest|shN)_labels\b/, "SH labels"],
  [/^(f_rest|shN)_centroids\b/, "SH codebook"],
  [/\.(json|ya?ml)$/, "Metadata"],
];

/** @param {string} file */
export const planeName = (file) => NAMES.find(([pattern]) => pattern.test(file))?.[1] ?? file;

/**
 * Return files in the order of the list above.
 * @param {string[]} files
 */
export function inOrder(files) {
  const rank = (/** @type {string} */ file) => NAMES.findIndex(([pattern]) => pattern.test(file));
  return [...files].sort((a, b) => rank(a) - rank(b));
}

/**
 * Return the bytes of each attribute, largest first; files of one attribute are added.
 * @param {Record<string, number>} sizes
 * @returns {[string, number][]}
 */
export function attributes(sizes) {
  /** @type {Map<string, number>} */
  const sums = new Map();
  for (const [file, size] of Object.entries(sizes)) sums.set(planeName(file), (sums.get(planeName(file)) ?? 0) + size);
  return [...sums].sort(([, a], [, b]) => b - a);
}
