/** Decoding and verification of one image of a container. */

import { decodeWebP } from "./webp.js";
import { crc32 } from "./zip.js";

/** @import { Plane, Task } from "./types.js" */

/** Offset of the size in a lossless WebP file whose only chunk is the image, and bits per side; alpha is the next bit. */
const [SIZE_OFFSET, SIDE_BITS] = [21, 14];

/**
 * Decode an image in JavaScript, and check its size and checksum.
 * @param {Task} task
 * @returns {Plane}
 */
export function decodePlane({ file, bytes, pixels, width, height, checksum }) {
  try {
    const plane = decodeWebP(bytes, { maxPixels: pixels });
    if (width !== undefined && (plane.width !== width || plane.height !== height)) {
      throw new Error(`${plane.width} x ${plane.height} pixels, not ${width} x ${height}`);
    }
    if (checksum !== undefined && crc32(plane.rgba) !== checksum) {
      throw new Error("damaged: its pixels do not match their checksum");
    }
    return plane;
  } catch (error) {
    throw new Error(`${file}: ${error instanceof Error ? error.message : error}`, { cause: error });
  }
}

/**
 * Decode an image by the browser, if it has a checksum that verifies the result and no alpha, which browsers would
 * premultiply; undefined if that is not possible.
 * @param {Task} task
 * @returns {Promise<Plane | undefined>}
 */
export async function decodeNatively({ bytes, width, height, checksum, native }) {
  if (!native || checksum === undefined || !width || !height) return undefined;
  if (!("ImageDecoder" in globalThis) || bytes.length < SIZE_OFFSET + 4) return undefined;
  const header = new DataView(bytes.buffer, bytes.byteOffset).getInt32(SIZE_OFFSET, true);
  if (header !== ((width - 1) | ((height - 1) << SIDE_BITS))) return undefined;
  const data = /** @type {Uint8Array<ArrayBuffer>} */ (bytes);
  const decoder = new ImageDecoder({ data, type: "image/webp", colorSpaceConversion: "none" });
  try {
    const { image } = await decoder.decode();
    const rgba = new Uint8Array(4 * width * height);
    await image.copyTo(rgba, { format: "RGBA" });
    image.close();
    return crc32(rgba) === checksum ? { width, height, rgba } : undefined;
  } catch {
    return undefined;
  } finally {
    decoder.close();
  }
}
