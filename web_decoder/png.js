/** Decoder of PNG for planes of SOG containers: 8 bits per channel or fewer, without interlacing, alpha untouched. */

import { collect, crc32 } from "./zip.js";

/** @import { Plane } from "./types.js" */

/** @type {(why: string) => never} */
const fail = (why) => {
  throw new Error(why);
};

const MAGIC = [0x89, 0x50, 0x4e, 0x47, 13, 10, 26, 10];
/** Number of channels by colour type: grey, RGB, palette, grey with alpha, RGBA. */
const CHANNELS = /** @type {Record<number, number>} */ ({ 0: 1, 2: 3, 3: 1, 4: 2, 6: 4 });
const [GREY, PALETTE] = [0, 3];

/** @param {Uint8Array} bytes */
export const isPng = (bytes) => MAGIC.every((value, at) => bytes[at] === value);

/**
 * Decode a PNG file.
 * @param {Uint8Array} bytes
 * @param {number} maxPixels checked before memory is allocated
 * @returns {Promise<Plane>}
 */
export async function decodePng(bytes, maxPixels) {
  const chunks = chunksOf(bytes);
  const header = chunks.get("IHDR")?.[0];
  const data = chunks.get("IDAT");
  if (header?.length !== 13 || !data) return fail("damaged: its PNG header or data are missing");
  const view = new DataView(header.buffer, header.byteOffset);
  const [width, height, depth, colour] = [view.getUint32(0), view.getUint32(4), header[8], header[9]];
  const channels = CHANNELS[colour];
  if (depth > 8) fail(`${depth} bits per channel; planes have 8`);
  if (!width || !height || !channels || ![1, 2, 4, 8].includes(depth) || (depth < 8 && channels > 1))
    fail("damaged: its PNG header is impossible");
  if (header[12]) fail("interlaced PNG, which is not supported: store it without interlacing");
  if (width * height > maxPixels) fail(`${width} x ${height} pixels, more than the ${maxPixels} allowed`);
  const rowBytes = Math.ceil((width * channels * depth) / 8);
  const rows = await inflate(data, (rowBytes + 1) * height);
  undoFilters(rows, rowBytes, Math.max(1, (channels * depth) / 8));
  const table = tableOf(colour, depth, chunks.get("PLTE")?.[0], chunks.get("tRNS")?.[0]);
  const rgba = new Uint8Array(4 * width * height);
  const sample = new Uint8Array(4);
  for (let y = 0, at = 0; y < height; y++) {
    const row = rows.subarray(y * (rowBytes + 1) + 1, (y + 1) * (rowBytes + 1));
    for (let x = 0; x < width; x++, at += 4) {
      for (let c = 0; c < channels; c++) {
        const bit = (x * channels + c) * depth;
        sample[c] = (row[bit >> 3] >> (8 - depth - (bit & 7))) & ((1 << depth) - 1);
      }
      table(sample, rgba, at);
    }
  }
  return { width, height, rgba };
}

/** Return the content of the chunks, by kind. @param {Uint8Array} bytes */
function chunksOf(bytes) {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.length);
  /** @type {Map<string, Uint8Array[]>} */
  const chunks = new Map();
  for (let at = MAGIC.length; !chunks.has("IEND");) {
    if (at + 12 > bytes.length || at + 12 + view.getUint32(at) > bytes.length) fail("cut off");
    const [start, end] = [at + 8, at + 8 + view.getUint32(at)];
    if (crc32(bytes.subarray(at + 4, end)) !== view.getUint32(end)) fail("damaged: it does not match its checksums");
    const kind = String.fromCharCode(...bytes.subarray(at + 4, start));
    chunks.set(kind, [...(chunks.get(kind) ?? []), bytes.subarray(start, end)]);
    at = end + 4;
  }
  return chunks;
}

/** @type {(data: Uint8Array[], size: number) => Promise<Uint8Array>} */
async function inflate(data, size) {
  const stream = new Blob(/** @type {Uint8Array<ArrayBuffer>[]} */ (data)).stream();
  const rows = await collect(stream.pipeThrough(new DecompressionStream("deflate")), size).catch(() =>
    fail("damaged: it cannot be unpacked"),
  );
  return rows.length === size ? rows : fail("damaged: it has too few pixels");
}

/** @type {(rows: Uint8Array, rowBytes: number, step: number) => void} */
function undoFilters(rows, rowBytes, step) {
  /** @type {Uint8Array} */
  let above = new Uint8Array(rowBytes + 1);
  for (let start = 0; start < rows.length; start += rowBytes + 1) {
    const row = rows.subarray(start, start + rowBytes + 1);
    const filter = row[0];
    if (filter > 4) fail(`damaged: a filter ${filter}`);
    for (let i = 1; filter && i <= rowBytes; i++) {
      const [left, corner] = i > step ? [row[i - step], above[i - step]] : [0, 0];
      if (filter === 1) row[i] += left;
      else if (filter === 2) row[i] += above[i];
      else if (filter === 3) row[i] += (left + above[i]) >> 1;
      else row[i] += nearest(left, above[i], corner);
    }
    above = row;
  }
}

/** The neighbour that is nearest to left + above - corner. @type {(left: number, above: number, corner: number) => number} */
function nearest(left, above, corner) {
  const [a, b, c] = [above - corner, left - corner, left + above - 2 * corner].map(Math.abs);
  return a <= b && a <= c ? left : b <= c ? above : corner;
}

/**
 * Return a function that writes the pixel of a sample.
 * @type {(colour: number, depth: number, palette?: Uint8Array, alpha?: Uint8Array) =>
 *   (sample: Uint8Array, rgba: Uint8Array, at: number) => void}
 */
function tableOf(colour, depth, palette = new Uint8Array(), alpha) {
  if (colour === PALETTE) {
    return ([index], rgba, at) => {
      for (let c = 0; c < 3; c++) rgba[at + c] = palette[3 * index + c] ?? 0;
      rgba[at + 3] = alpha?.[index] ?? 255;
    };
  }
  const grey = colour % 4 === GREY;
  const scale = 255 / ((1 << depth) - 1);
  const [red, green, blue] = grey ? [0, 0, 0] : [0, 1, 2];
  const opacity = colour > PALETTE ? CHANNELS[colour] - 1 : null;
  // Without an alpha channel, one colour may be transparent; it is stored with 16 bits per channel.
  const clear = alpha && [1, 3, 5].slice(0, grey ? 1 : 3).map((at) => alpha[at]);
  return (sample, rgba, at) => {
    rgba[at] = scale * sample[red];
    rgba[at + 1] = scale * sample[green];
    rgba[at + 2] = scale * sample[blue];
    const hidden = clear?.every((value, c) => value === sample[c]);
    rgba[at + 3] = opacity !== null ? sample[opacity] : hidden ? 0 : 255;
  };
}
