/** Decoding of SOG-XT containers to typed arrays, image by image as they arrive. */

import { load } from "./container.js";
import { Assembly, PLANES } from "./scene.js";

export { expandSH } from "./container.js";

/** @import { Options, Scene } from "./types.js" */

/** Error of a container; the message is a sentence. */
export class SogxtError extends Error {
  name = "SogxtError";
}

/**
 * Decode a container.
 * @param {string | URL | ArrayBuffer | Uint8Array | Blob} source address of a folder (with a slash at its end), of its
 *   meta.json, or of a zip; or a zip
 * @param {Options} [options]
 * @returns {Promise<Scene>}
 * @throws {SogxtError} a file is missing, damaged, invalid or too large
 */
export const decode = (source, options = {}) =>
  load(source, options, {
    name: "SOG-XT",
    images: PLANES.length,
    Failure: SogxtError,
    assemble: (json, maxGaussians, yaml) => new Assembly(json, maxGaussians, yaml),
  });
