/** What the files of a container are called here. */

/** @type {[RegExp, string][]} */
const NAMES = [
  [/^active_mask\b/, "Mask"],
  [/^means_bytes_1\b/, "Positions, high bytes"],
  [/^means_bytes_0\b/, "Positions, low bytes"],
  [/^f_dc\b/, "Colours"],
  [/^opacities\b/, "Opacity"],
  [/^scales\b/, "Sizes"],
  [/^quaternions\b/, "Rotations"],
  [/^f_rest_labels\b/, "SH labels"],
  [/^f_rest_centroids\b/, "SH codebook"],
  [/\.(json|ya?ml)$/, "Metadata"],
];

/** @param {string} file */
export const planeName = (file) => NAMES.find(([pattern]) => pattern.test(file))?.[1] ?? file;

/**
 * Files in the order of the list above.
 * @param {string[]} files
 */
export function inOrder(files) {
  const place = (/** @type {string} */ file) => NAMES.findIndex(([pattern]) => pattern.test(file));
  return [...files].sort((a, b) => place(a) - place(b));
}

/**
 * Bytes of each attribute, largest first; files of one meaning are added up.
 * @param {Record<string, number>} sizes
 * @returns {[string, number][]}
 */
export function attributes(sizes) {
  /** @type {Map<string, number>} */
  const sums = new Map();
  for (const [file, size] of Object.entries(sizes)) sums.set(planeName(file), (sums.get(planeName(file)) ?? 0) + size);
  return [...sums].sort(([, a], [, b]) => b - a);
}
