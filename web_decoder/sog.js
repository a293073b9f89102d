/** Decoding of SOG containers, versions 1 and 2, to the same arrays as those of SOG-XT containers. */

import { load } from "./container.js";
import { SogAssembly } from "./sog_scene.js";

export { expandSH } from "./container.js";

/** @import { Options, Scene } from "./types.js" */

/** Error of a container; the message is a sentence. */
export class SogError extends Error {
  name = "SogError";
}

/**
 * Decode a container.
 * @param {string | URL | ArrayBuffer | Uint8Array | Blob} source address of a folder (with a slash at its end), of its
 *   meta.json, or of a .sog; or a .sog
 * @param {Options} [options]
 * @returns {Promise<Scene>}
 * @throws {SogError} a file is missing, damaged, invalid or too large
 */
export const decode = (source, options = {}) =>
  load(source, options, {
    name: "SOG",
    images: 7,
    Failure: SogError,
    assemble: (json, maxGaussians) => new SogAssembly(json, maxGaussians),
  });
