/** Reader of zip files: stored or deflated entries, with checksums and limits. */

/** Error of a zip file; the message is a sentence. */
export class ZipError extends Error {
  name = "ZipError";
}

const END = 0x06054b50;
const ENTRY = 0x02014b50;
const LOCAL = 0x04034b50;
const END_SIZE = 22;
const MAX_COMMENT = 0xffff;
const MAX_ENTRIES = 1000;
const MAX_DIRECTORY = 1 << 21;

/** Four tables, for four bytes at a time. */
const CRC = new Int32Array(4 * 256);
for (let i = 0; i < CRC.length; i++) {
  let value = i < 256 ? i : CRC[i - 256];
  for (let bit = 0; bit < 8; bit++) value = value & 1 ? (value >>> 1) ^ 0xedb88320 : value >>> 1;
  CRC[i] = value;
}

/**
 * Return the CRC-32 of zip, PNG and zlib.
 * @param {Uint8Array} bytes
 */
export function crc32(bytes) {
  if (bytes.byteOffset & 3) bytes = new Uint8Array(bytes); // a copy; slice() of a Buffer would share memory
  const words = new Int32Array(bytes.buffer, bytes.byteOffset, bytes.length >> 2);
  let crc = -1;
  for (let i = 0; i < words.length; i++) {
    crc ^= words[i];
    crc = CRC[768 + (crc & 255)] ^ CRC[512 + ((crc >>> 8) & 255)] ^ CRC[256 + ((crc >>> 16) & 255)] ^ CRC[crc >>> 24];
  }
  for (let i = bytes.length & ~3; i < bytes.length; i++) crc = (crc >>> 8) ^ CRC[(crc ^ bytes[i]) & 255];
  return ~crc >>> 0;
}

/**
 * Return functions that read the files of a zip, by file name without folders.
 * @param {Uint8Array} bytes the zip
 * @returns {Map<string, (limit: number) => Promise<Uint8Array>>} functions of the largest size allowed; they throw ZipError too
 * @throws {ZipError} it is not a zip, or truncated
 */
export function openZip(bytes) {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.length);
  let end = bytes.length - END_SIZE;
  while (end >= 0 && view.getUint32(end, true) !== END)
    end = end > bytes.length - END_SIZE - MAX_COMMENT ? end - 1 : -1;
  if (end < 0) throw new ZipError("not a zip file, or one that is cut off");
  const count = view.getUint16(end + 10, true);
  const size = view.getUint32(end + 12, true);
  const offset = view.getUint32(end + 16, true);
  if (count === 0xffff || offset === 0xffffffff)
    throw new ZipError("a 64-bit zip, which is not supported: store fewer and smaller files");
  if (count > MAX_ENTRIES) throw new ZipError(`a zip of more than ${MAX_ENTRIES} files`);
  const files = new Map();
  const before = end - size - offset; // data before the zip, such as a self-extractor
  const damaged = new ZipError("the zip's table of files is damaged");
  if (before < 0 || size > MAX_DIRECTORY) throw damaged;
  let at = end - size;
  for (let i = 0; i < count; i++) {
    if (at + 46 > end || view.getUint32(at, true) !== ENTRY) throw damaged;
    const path = bytes.subarray(at + 46, at + 46 + view.getUint16(at + 28, true));
    const name = new TextDecoder("utf-8", { ignoreBOM: true }).decode(path).replace(/.*[\\/]/s, "");
    const entry = {
      name,
      path,
      flags: view.getUint16(at + 8, true),
      method: view.getUint16(at + 10, true),
      crc: view.getUint32(at + 16, true),
      packed: view.getUint32(at + 20, true),
      size: view.getUint32(at + 24, true),
      local: before + view.getUint32(at + 42, true),
    };
    if (files.has(name)) throw new ZipError(`the zip has ${name} twice`);
    if (name) files.set(name, (/** @type {number} */ limit) => read(bytes, view, entry, limit));
    at += 46 + path.length + view.getUint16(at + 30, true) + view.getUint16(at + 32, true);
  }
  if (at !== end) throw damaged;
  return files;
}

/**
 * @param {Uint8Array} bytes
 * @param {DataView} view
 * @param {{name: string, path: Uint8Array, flags: number, method: number, crc: number, packed: number, size: number, local: number}} entry
 * @param {number} limit
 */
async function read(bytes, view, { name, path, flags, method, crc, packed, size, local }, limit) {
  if (size > limit) throw new ZipError(`${name} has ${size} bytes, more than the ${limit} that it may have`);
  if (flags & 1) throw new ZipError(`${name} is encrypted`);
  if (
    local + 30 + path.length > bytes.length ||
    view.getUint32(local, true) !== LOCAL ||
    view.getUint16(local + 26, true) !== path.length ||
    path.some((byte, i) => byte !== bytes[local + 30 + i])
  )
    throw new ZipError(`${name} is not where the zip says`);
  const start = local + 30 + view.getUint16(local + 26, true) + view.getUint16(local + 28, true);
  let content = bytes.subarray(start, start + packed);
  if (content.length !== packed) throw new ZipError(`${name} is cut off`);
  if (method === 8) {
    const stream = new Blob([/** @type {Uint8Array<ArrayBuffer>} */ (content)]).stream();
    content = await collect(stream.pipeThrough(new DecompressionStream("deflate-raw")), size).catch(() => {
      throw new ZipError(`${name} is damaged: it cannot be unpacked`);
    });
  } else if (method !== 0) {
    throw new ZipError(`${name} has compression method ${method}, which is not supported: store or deflate it`);
  }
  if (content.length !== size || crc32(content) !== crc)
    throw new ZipError(`${name} is damaged: it does not match its checksum`);
  return content;
}

/**
 * Read a stream to its end.
 * @param {ReadableStream<Uint8Array>} stream
 * @param {number} limit largest number of bytes
 * @param {(bytes: number) => void} [count] called with the size of each chunk
 */
export async function collect(stream, limit, count) {
  const chunks = [];
  let length = 0;
  for (const reader = stream.getReader(); ;) {
    const { done, value } = await reader.read();
    if (done) return new Uint8Array(await new Blob(chunks).arrayBuffer());
    chunks.push(/** @type {Uint8Array<ArrayBuffer>} */ (value));
    length += value.length;
    count?.(value.length);
    if (length > limit) throw new ZipError(`more than the ${limit} bytes that it may have`);
  }
}
