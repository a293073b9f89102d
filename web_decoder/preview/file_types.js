/** The files of single scenes that Spark reads: all other files are containers, which this project decodes. */

import { checkedView } from "./view.js";

/** @typedef {"ply" | "spz" | "splat" | "ksplat"} FileType */

/** Types by Spark's names of them, which are the endings too. @type {FileType[]} */
const FILE_TYPES = ["ply", "spz", "splat", "ksplat"];

/** Endings for the choice of a file. */
export const FILE_ENDINGS = FILE_TYPES.map((type) => `.${type}`).join();

/** Return the type of a file by its name; of a container, none. @param {string} name */
export const fileTypeOf = (name) => FILE_TYPES.find((type) => name.toLowerCase().endsWith(`.${type}`));

/** Return the type of a format by the service's name of it; of a container, none. @param {string} format */
export const fileTypeOfFormat = (format) => FILE_TYPES.find((type) => type === format);

/** Comments in a `.ply` that say whether the scene is antialiased, as in kissgs/io/ply_rows.py. */
const MARK =
  /^(?:comment|obj_info)\s+(?:(?:splat_?render_?mode|rasteri[sz]e[-_ ]?mode)\s*[:=]?\s*([\w-]+)|(?:trained with )?(?:anti[-_ ]?alias(?:ed|ing)?|mip[-_ ]?splatting)\s*(?:[:=]?\s*([\w.]+))?)\s*$/i;
/** Largest header that is searched for a mark. */
const MAX_HEADER_BYTES = 1 << 20;
/** Byte of a `.spz` header with flags, of which the first is that of antialiased scenes. */
const SPZ_FLAGS = 14;

/**
 * Whether a file says that its scene was trained with antialiasing.
 * @param {FileType} type
 * @param {Uint8Array} bytes
 */
export async function isMarked(type, bytes) {
  if (type === "ply") return isMarkedPly(headerOf(bytes));
  return type === "spz" && ((await startOf(bytes))[SPZ_FLAGS] & 1) === 1;
}

/** Whether the last comment that says whether the scene is antialiased says so. @param {string} header */
function isMarkedPly(header) {
  const comments = header.split(/\r?\n/);
  const found = comments.map((line) => line.match(MARK)).findLast((match) => match !== null);
  if (!found) return false;
  const [, mode, flag = "yes"] = found;
  return mode ? /^(mip|mip-splatting|antialiased)$/i.test(mode) : /^(1|1\.0|true|yes|on|enabled)$/i.test(flag);
}

/** Return the view that a comment of a `.ply` records, or null. @param {FileType} type @param {Uint8Array} bytes */
export function viewInFile(type, bytes) {
  if (type !== "ply") return null;
  const [, text] = headerOf(bytes).match(/^comment kissgs view (\{.*\})\s*$/m) ?? [];
  try {
    return text ? checkedView(JSON.parse(text)) : null;
  } catch {
    return null;
  }
}

/** Return the header of a `.ply`, or nothing if it does not end. @param {Uint8Array} bytes */
function headerOf(bytes) {
  const text = new TextDecoder("latin1").decode(bytes.subarray(0, MAX_HEADER_BYTES));
  return text.slice(0, Math.max(text.search(/^end_header/m), 0));
}

/** Return the first bytes of a `.spz`, which is gzip up to version 3. @param {Uint8Array} bytes */
async function startOf(bytes) {
  if (bytes[0] !== 0x1f) return bytes;
  const packed = new Blob([/** @type {Uint8Array<ArrayBuffer>} */ (bytes.subarray(0, 1 << 16))]);
  const reader = packed.stream().pipeThrough(new DecompressionStream("gzip")).getReader();
  const { value } = await reader.read().catch(() => ({ value: undefined })); // Spark names the damage
  reader.cancel().catch(() => {}); // the rest is cut off
  return value ?? new Uint8Array();
}

/** Whether y points up and z back in files of this type, as in three.js, not down and ahead. @param {FileType} type */
export const pointsUp = (type) => type === "spz";
