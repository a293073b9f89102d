/** Check of a file's header before the upload, for errors that the service would report after it. */

import { bytes, count } from "./format.js";

/**
 * @typedef {{gaussians: number, shDegree: number | null, packed: boolean}} PlyFacts
 *   shDegree is null if unknown; packed means `.compressed.ply`
 */

/** The service would refuse a file; the message is one sentence. */
export class UnsuitableFile extends Error {}

/** Number of `f_rest_*` properties of each SH degree. */
const REST_COUNTS = [0, 9, 24, 45];

/**
 * Read the header of a file and check the limits.
 * @param {File} file
 * @param {import("./api.js").Limits} limits
 * @returns {Promise<PlyFacts>}
 * @throws {UnsuitableFile}
 */
export async function inspect(file, limits) {
  if (file.size > limits.max_upload_bytes) {
    const [size, most] = [bytes(file.size), bytes(limits.max_upload_bytes)];
    throw new UnsuitableFile(`${file.name} has ${size}; the limit of this service is ${most}.`);
  }
  const facts = parse(await head(file, limits.max_header_bytes), file.name);
  if (facts.gaussians > limits.max_gaussians) {
    const [number, most] = [count(facts.gaussians), count(limits.max_gaussians)];
    throw new UnsuitableFile(`${file.name} has ${number} Gaussians; the limit of this service is ${most}.`);
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
    throw new UnsuitableFile(`${file.name} cannot be read: it is a folder, or it has changed since it was chosen.`);
  }
}

/**
 * @param {string} text
 * @param {string} name
 * @returns {PlyFacts}
 */
function parse(text, name) {
  if (!/^ply\s*\n/.test(text)) throw new UnsuitableFile(`${name} is not a .ply: it does not begin with "ply".`);
  const end = text.search(/^end_header\s*$/m);
  if (end < 0) throw new UnsuitableFile(`${name} is not a valid .ply: its header has no end.`);
  const header = text.slice(0, end);
  const vertices = header.match(/^element[ \t]+vertex[ \t]+(\d+)/m);
  if (!vertices) throw new UnsuitableFile(`${name} has no Gaussians: its header has no vertex element.`);
  if (Number(vertices[1]) === 0) throw new UnsuitableFile(`${name} has no Gaussians: it is empty.`);
  const packed = /^element[ \t]+chunk\b/m.test(header);
  const degree = REST_COUNTS.indexOf((header.match(/\bf_rest_\d+/g) ?? []).length);
  return { gaussians: Number(vertices[1]), shDegree: packed || degree < 0 ? null : degree, packed };
}
