/** One image of a container: decoded and verified. */

import { decodeWebP } from "./webp.js";
import { crc32 } from "./zip.js";

/** @import { Plane, Task } from "./types.js" */

/** Where a lossless WebP file has its size, if nothing stands before its picture; the bit above tells of alpha. */
const [HEADER, SIDE_BITS] = [21, 14];

/**
 * @param {Task} task
 * @returns {Plane}
 */
export function decodePlane({ file, bytes, width, height, checksum }) {
  try {
    const plane = decodeWebP(bytes, { maxPixels: width * height });
    if (plane.width !== width || plane.height !== height) {
      throw new Error(`${plane.width} x ${plane.height} pixels, not ${width} x ${height}`);
    }
    if (checksum !== undefined && crc32(plane.rgba) !== checksum) {
      throw new Error("damaged: other pixels than were stored");
    }
    return plane;
  } catch (error) {
    throw new Error(`${file}: ${error instanceof Error ? error.message : error}`, { cause: error });
  }
}

/**
 * By the browser, where a checksum proves what it gives, and for images without alpha: browsers multiply colours by
 * alpha and divide again.
 * @param {Task} task
 * @returns {Promise<Plane | undefined>}
 */
export async function decodeNatively({ bytes, width, height, checksum, native }) {
  if (!native || checksum === undefined || !("ImageDecoder" in globalThis) || bytes.length < HEADER + 4)
    return undefined;
  const header = new DataView(bytes.buffer, bytes.byteOffset).getInt32(HEADER, true);
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
