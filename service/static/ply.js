/** What the first bytes of a file say: enough to refuse, before the upload, what the service would refuse after it. */

import { bytes, count } from "./format.js";

/**
 * @typedef {{gaussians: number, shDegree: number | null, packed: boolean}} PlyFacts
 *   shDegree is null where the header does not tell, packed is a `.compressed.ply`
 */

/** A file that the service would not take; the message says why, in one sentence. */
export class Unsuitable extends Error {}

/** Number of `f_rest_*` properties of each SH degree. */
const REST_COUNTS = [0, 9, 24, 45];

/**
 * Read the header of a file and hold it against the limits.
 * @param {File} file
 * @param {import("./api.js").Limits} limits
 * @returns {Promise<PlyFacts>}
 * @throws {Unsuitable}
 */
export async function inspect(file, limits) {
  if (file.size > limits.max_upload_bytes) {
    const [size, most] = [bytes(file.size), bytes(limits.max_upload_bytes)];
    throw new Unsuitable(`${file.name} has ${size}; this service takes ${most} at most.`);
  }
  const facts = parse(await head(file, limits.max_header_bytes), file.name);
  if (facts.gaussians > limits.max_gaussians) {
    const [number, most] = [count(facts.gaussians), count(limits.max_gaussians)];
    throw new Unsuitable(`${file.name} has ${number} Gaussians; this service takes ${most} at most.`);
  }
  return facts;
}

/**
 * @param {File} file
 * @param {number} size
 */
async function head(file, size) {
  try {
    return new TextDecoder("latin1").decode(await file.slice(0, size).arrayBuffer());
  } catch {
    throw new Unsuitable(`${file.name} cannot be read: a folder, or a file that has just changed.`);
  }
}

/**
 * @param {string} text
 * @param {string} name
 * @returns {PlyFacts}
 */
function parse(text, name) {
  if (!/^ply\s*\n/.test(text)) throw new Unsuitable(`${name} is no .ply: it does not begin with the word "ply".`);
  const end = text.search(/^end_header\s*$/m);
  if (end < 0) throw new Unsuitable(`${name} is no .ply that can be read: its header does not end.`);
  const header = text.slice(0, end);
  const vertices = header.match(/^element[ \t]+vertex[ \t]+(\d+)/m);
  if (!vertices) throw new Unsuitable(`${name} has no Gaussians: its header names no vertices.`);
  if (Number(vertices[1]) === 0) throw new Unsuitable(`${name} has no Gaussians: it is empty.`);
  const packed = /^element[ \t]+chunk\b/m.test(header);
  const degree = REST_COUNTS.indexOf((header.match(/\bf_rest_\d+/g) ?? []).length);
  return { gaussians: Number(vertices[1]), shDegree: packed || degree < 0 ? null : degree, packed };
}
