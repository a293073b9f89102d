import type { Plane } from "./types.js";

/** Error of a WebP file; the message is a sentence. */
export declare class WebPError extends Error {}

/**
 * Decode a lossless WebP file exactly.
 * @throws {WebPError} the file is damaged, lossy, animated or has more than `maxPixels` pixels (default: 67 million)
 */
export declare function decodeWebP(bytes: Uint8Array | ArrayBuffer, limits?: { maxPixels?: number }): Plane;
