/** How many pixels a box of a scene covers in a view. */

/**
 * @typedef {{low: number[], high: number[]}} Box corners
 * @typedef {object} View
 * @property {number[][]} planes that bound what is visible: x, y, z and offset, positive inside
 * @property {number[]} eye position of the camera
 * @property {number} focal focal length, pixels
 * @property {number} pixels of the image
 */

/**
 * @param {ArrayLike<number>} matrix of 16 numbers, column by column, from the scene to clip coordinates
 * @param {number[]} eye position of the camera in the scene
 * @param {number} focal focal length, pixels
 * @param {number} pixels of the image
 * @returns {View}
 */
export function viewOf(matrix, eye, focal, pixels) {
  const [x, y, , w] = [0, 1, 2, 3].map((row) => [0, 4, 8, 12].map((column) => matrix[row + column]));
  const sum = (/** @type {number[]} */ one, /** @type {number} */ sign) => w.map((value, i) => value + sign * one[i]);
  return { planes: [w, sum(x, 1), sum(x, -1), sum(y, 1), sum(y, -1)], eye, focal, pixels };
}

/** Whether no part of a box is visible; some boxes near an edge count as visible. @type {(view: View, box: Box) => boolean} */
export const isOutside = ({ planes }, { low, high }) =>
  planes.some(([x, y, z, offset]) => {
    const [px, py, pz] = [x > 0 ? high[0] : low[0], y > 0 ? high[1] : low[1], z > 0 ? high[2] : low[2]];
    return x * px + y * py + z * pz + offset < 0;
  });

/**
 * Return the pixels that a box covers, at most all: the mean over all directions, which is a quarter of its surface.
 * @type {(view: View, box: Box) => number}
 */
export function areaOf({ eye, focal, pixels }, { low, high }) {
  const [a, b, c] = low.map((start, axis) => high[axis] - start);
  const distance = Math.hypot(...low.map((start, axis) => (start + high[axis]) / 2 - eye[axis]));
  return Math.min(pixels, (((a * b + b * c + c * a) / 2) * focal ** 2) / (distance ** 2 || Number.MIN_VALUE));
}
