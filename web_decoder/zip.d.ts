/** Error of a zip file; the message is a sentence. */
export declare class ZipError extends Error {}

/**
 * Return functions that read the files of a zip, by file name without folders, given the largest size allowed. Their
 * results may share the memory of `bytes`.
 * @throws {ZipError} not a zip, or truncated; the functions: damaged, encrypted or larger than the limit
 */
export declare function openZip(bytes: Uint8Array): Map<string, (limit: number) => Promise<Uint8Array>>;

/** Return the CRC-32 of zip, PNG and zlib. */
export declare function crc32(bytes: Uint8Array): number;

/** Read a stream of at most `limit` bytes; `count` is called with the size of each chunk. */
export declare function collect(
  stream: ReadableStream<Uint8Array>,
  limit: number,
  count?: (bytes: number) => void,
): Promise<Uint8Array>;
