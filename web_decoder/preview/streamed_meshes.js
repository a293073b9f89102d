/** Spark's meshes of a streamed scene: one for each file, of those of its rows that are drawn. */

import { SplatMesh } from "@sparkjsdev/spark";
import { packInTurns, packedRows } from "./pack.js";

/**
 * @typedef {object} Content of a file, ready to be drawn
 * @property {number} count number of its Gaussians
 * @property {import("./pack.js").Packed} packed
 * @property {number[]} centre of the file, in the scene
 */

/**
 * Prepare a decoded file. Each has an origin and ranges of its own, which the quantisation of Spark is made for.
 * @param {import("./scene.js").Scene} scene
 * @param {AbortSignal} signal
 * @returns {Promise<Content>}
 */
export async function contentOf(scene, signal) {
  const centre = middleOf(scene.means);
  return { count: scene.count, packed: await packInTurns(scene, centre, signal), centre };
}

/**
 * Return a mesh of some rows.
 * @param {Content} content
 * @param {[offset: number, count: number][]} ranges
 * @param {number[]} origin position in the scene that is the viewer's origin
 */
export function meshOf({ packed, centre }, ranges, origin) {
  const { splats, encoding } = packedRows(packed, ranges);
  const mesh = new SplatMesh({ packedSplats: splats, splatEncoding: encoding });
  const [x, y, z] = centre.map((value, axis) => value - origin[axis]);
  mesh.position.set(x, -y, -z); // scenes have y down and z ahead
  return mesh;
}

/** Return the mean position. @param {Float32Array} means */
function middleOf(means) {
  const sums = [0, 0, 0];
  for (let at = 0; at < means.length; at++) sums[at % 3] += means[at];
  return sums.map((sum) => sum / (means.length / 3 || 1));
}
