import type { Plane } from "./types.js";

/** What is wrong with a file, in a sentence. */
export declare class WebPError extends Error {}

/**
 * Decode a lossless WebP file, exactly.
 * @throws {WebPError} the file is damaged, lossy, animated or has more pixels than allowed (67 million unless given)
 */
export declare function decodeWebP(bytes: Uint8Array | ArrayBuffer, limits?: { maxPixels?: number }): Plane;
