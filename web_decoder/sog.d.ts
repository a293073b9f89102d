import type { Options, Scene } from "./types.js";

export { expandSH } from "./types.js";

/** Error of a container; the message is a sentence. */
export declare class SogError extends Error {}

/**
 * Decode a SOG container, version 1 or 2, to the same arrays as a SOG-XT container. There are no checksums of pixels, so
 * that the browser's own decoder is not used.
 * @param source address of a folder (with a slash at its end), of its meta.json, or of a .sog; or a .sog
 * @throws {SogError} a file is missing, damaged, invalid or too large
 */
export declare function decode(
  source: string | URL | ArrayBuffer | Uint8Array | Blob,
  options?: Options,
): Promise<Scene>;
