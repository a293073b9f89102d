/** What is wrong with a zip, in a sentence. */
export declare class ZipError extends Error {}

/**
 * The files of a zip by their names without folders, and what reads each, up to so many bytes. `read` may give a part of
 * `bytes`.
 * @throws {ZipError} it is no zip, or cut off; and from `read`: damaged, encrypted, larger than the limit
 */
export declare function openZip(bytes: Uint8Array): Map<string, (limit: number) => Promise<Uint8Array>>;

/** CRC-32 as zip, PNG and zlib have it. */
export declare function crc32(bytes: Uint8Array): number;

/** All that a stream gives, up to so many bytes; `count` is told of each part. */
export declare function collect(
  stream: ReadableStream<Uint8Array>,
  limit: number,
  count?: (bytes: number) => void,
): Promise<Uint8Array>;
