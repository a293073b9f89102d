/** Check of a file's beginning before the upload, for errors that the service would report after it. */

import { bytes, count } from "./format.js";

/**
 * @typedef {{gaussians: number | null, shDegree: number | null, packed: boolean}} PlyFacts
 *   gaussians and shDegree are null if unknown; packed means `.compressed.ply`
 */

/** The service would refuse a file; the message is one sentence. */
export class UnsuitableFile extends Error {}

/** @param {string} name */
const NO_SPLATS = (name) =>
  `${name} is a mesh or a point cloud, not a Gaussian splatting scene: send the trained scene.`;

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
  const start = await unpacked(await head(file, limits.max_header_bytes));
  const endings = endingsOf(limits);
  const facts = otherFormat(start, file, endings) ?? parse(new TextDecoder("latin1").decode(start), file.name, endings);
  if (facts.gaussians !== null && facts.gaussians > limits.max_gaussians) {
    const [number, most] = [count(facts.gaussians), count(limits.max_gaussians)];
    throw new UnsuitableFile(`${file.name} has ${number} Gaussians; the limit of this service is ${most}.`);
  }
  return facts;
}

/** Return the endings of files that the service takes. @param {import("./api.js").Limits} limits */
export const endingsOf = ({ formats }) => formats.filter((name) => !name.includes(".")).map((name) => `.${name}`);

/**
 * @param {File} file
 * @param {number} size
 */
async function head(file, size) {
  try {
    return new Uint8Array(await file.slice(0, size).arrayBuffer());
  } catch {
    throw new UnsuitableFile(`${file.name} cannot be read: it is a folder, or it has changed since it was chosen.`);
  }
}

/** Return the first bytes inside gzip, which .spz is up to version 3; others unchanged. @param {Uint8Array<ArrayBuffer>} head */
async function unpacked(head) {
  if (head[0] !== 0x1f) return head;
  const reader = new Blob([head]).stream().pipeThrough(new DecompressionStream("gzip")).getReader();
  const { value } = await reader.read().catch(() => ({ value: head })); // damaged: the service says so
  reader.cancel().catch(() => {}); // the rest was cut off
  return value ?? head;
}

/** Beginnings of formats other than .ply: zip (.sog), gzip that is damaged, .spz, GLB. */
const MARKS = ["PK\x03\x04", "\x1f\x8b", "NGSP", "glTF"];

/**
 * Return what can be seen of a file that is not a .ply; null for a .ply and for anything unknown. Of files that this page
 * does not know by their content, the service reads those with other endings.
 * @param {Uint8Array} head
 * @param {File} file
 * @param {string[]} endings
 * @returns {PlyFacts | null}
 */
function otherFormat(head, file, endings) {
  const unknown = { gaussians: null, shDegree: null, packed: false };
  const start = String.fromCharCode(...head.subarray(0, 24)); // not a TextDecoder: its latin1 is windows-1252
  if (start.startsWith("ply")) return null;
  const mark = MARKS.find((each) => start.startsWith(each));
  if (mark === "NGSP") return { gaussians: numberAt(start, 8), shDegree: Math.min(head[12], 3), packed: false };
  if (mark === "glTF" && !declares(head, "KHR_gaussian_splatting")) throw new UnsuitableFile(NO_SPLATS(file.name));
  if (mark) return unknown;
  if (/\.splat$/i.test(file.name) && file.size % 32 === 0)
    return { gaussians: file.size / 32, shDegree: 0, packed: false };
  if (start.startsWith("\0\x01\0\0") && file.size >= 4096) return { ...unknown, gaussians: numberAt(start, 16) };
  const others = endings.filter((ending) => ending !== ".ply" && ending !== ".splat");
  return others.some((ending) => file.name.toLowerCase().endsWith(ending)) ? unknown : null;
}

/**
 * Whether the JSON of a GLB has a name, or goes on behind what was read of it.
 * @param {Uint8Array} head
 * @param {string} name
 */
function declares(head, name) {
  const text = String.fromCharCode(...head.subarray(12, 16));
  const end = 20 + numberAt(text, 0);
  return end > head.length || new TextDecoder("latin1").decode(head.subarray(20, end)).includes(name);
}

/**
 * Return an unsigned number of four bytes, little-endian.
 * @param {string} text
 * @param {number} at
 */
const numberAt = (text, at) => [3, 2, 1, 0].reduce((sum, i) => sum * 256 + (text.charCodeAt(at + i) || 0), 0);

/**
 * @param {string} text
 * @param {string} name
 * @param {string[]} endings
 * @returns {PlyFacts}
 */
function parse(text, name, endings) {
  if (!/^ply\s*\n/.test(text))
    throw new UnsuitableFile(`${name} is not a scene: send a ${endings.slice(0, -1).join(", ")} or ${endings.at(-1)}.`);
  const end = text.search(/^end_header\s*$/m);
  if (end < 0) throw new UnsuitableFile(`${name} is not a valid .ply: its header has no end.`);
  const header = text.slice(0, end);
  const vertices = header.match(/^element[ \t]+vertex[ \t]+(\d+)/m);
  if (!vertices) throw new UnsuitableFile(`${name} has no Gaussians: its header has no vertex element.`);
  if (Number(vertices[1]) === 0) throw new UnsuitableFile(`${name} has no Gaussians: it is empty.`);
  const packed = /^element[ \t]+chunk\b/m.test(header);
  if (!packed && !/\s(opacity|scale_\d|rot_\d)\s/.test(header)) throw new UnsuitableFile(NO_SPLATS(name));
  const degree = REST_COUNTS.indexOf((header.match(/\bf_rest_\d+/g) ?? []).length);
  return { gaussians: Number(vertices[1]), shDegree: degree < 0 ? null : degree, packed };
}
