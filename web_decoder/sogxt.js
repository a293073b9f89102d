/** Decoding of SOG-XT containers to typed arrays, image by image as they arrive. */

import { Pool } from "./pool.js";
import { Assembly, COEFFICIENTS, MASK, META, PLANES } from "./scene.js";
import { collect, openZip } from "./zip.js";

/** @import { Options, Scene } from "./types.js" */
/** @typedef {(file: string, limit: number) => Promise<Uint8Array>} Read */
/** @typedef {(received: number, total: number) => void} Count */

/** Number of images of a coarse rendering, which are downloaded before the others: mask, coarse positions, colours. */
const COARSE_PLANES = 3;
const MAX_META_BYTES = 1 << 20;
const MAX_ZIP_BYTES = 1 << 30;

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
export async function decode(source, options = {}) {
  const { signal, maxGaussians = 2e7, native = true } = options;
  const stop = new AbortController();
  const aborting = signal ? AbortSignal.any([signal, stop.signal]) : stop.signal;
  const progress = { received: 0, total: 0, decoded: 0, planes: PLANES.length };
  /** @type {unknown[]} */
  const callbackErrors = []; // thrown by functions of the caller
  /** @type {(work: () => void) => void} */
  const call = (work) => {
    try {
      work();
    } catch (error) {
      callbackErrors.push(error);
      throw error;
    }
  };
  const reportProgress = () => call(() => options.onProgress?.({ ...progress }));
  const pool = new Pool(options.workers);
  try {
    const read = await open(source, { ...options.request, signal: aborting }, (received, total) => {
      progress.received += received;
      progress.total += total;
      reportProgress();
    });
    const assembly = new Assembly(await read(META, MAX_META_BYTES), maxGaussians);
    const { scene } = assembly;
    /** @type {Promise<Uint8Array>[]} */
    const arriving = [];
    const loads = PLANES.map(async (file, i) => {
      const [width, height] = assembly.sizeOf(file);
      if (i >= COARSE_PLANES) await Promise.all(arriving.slice(0, COARSE_PLANES)).catch(() => {});
      arriving[i] = read(file, 4096 + 5 * width * height); // lossless WebP takes at most 4 bytes per pixel
      const bytes = await arriving[i];
      const checksum = scene.meta.kissgs?.crc32?.[file];
      const plane = await pool.decode({ file, bytes, width, height, native, checksum });
      if (file !== MASK) await loads[0]; // other images need the mask
      aborting.throwIfAborted();
      scene.sizes[file] = bytes.length;
      if (options.keepPlanes) scene.planes[file] = plane;
      assembly.put(file, plane.rgba);
      progress.decoded++;
      reportProgress();
      call(() => options.onPlane?.(file, scene));
    });
    const aborted = new Promise((_, reject) => aborting.addEventListener("abort", () => reject(aborting.reason)));
    // After an error in one image, the others are still put into the scene.
    await Promise.race([Promise.allSettled(loads), aborted]);
    await Promise.all(loads);
    return scene;
  } catch (error) {
    signal?.throwIfAborted();
    throw callbackErrors.length ? callbackErrors[0] : new SogxtError(messageOf(error), { cause: error });
  } finally {
    stop.abort();
    pool.close();
  }
}

/**
 * Return the SH coefficients of each Gaussian from the codebook.
 * @param {Scene} scene
 * @returns {Float32Array} 3 K N
 */
export function expandSH({ count, degree, labels, centroids }) {
  const size = 3 * COEFFICIENTS[degree];
  const shN = new Float32Array(count * size);
  for (let i = 0, at = 0; i < count; i++) {
    for (let from = labels[i] * size, end = from + size; from < end;) shN[at++] = centroids[from++];
  }
  return shN;
}

/** @type {(error: unknown) => string} */
const messageOf = (error) => (error instanceof Error ? error.message : String(error));

/** @type {(bytes: Uint8Array, hint: string) => ReturnType<typeof openZip>} */
function zipOf(bytes, hint) {
  try {
    return openZip(bytes);
  } catch (error) {
    throw new Error(messageOf(error) + hint);
  }
}

/** @type {(source: Parameters<typeof decode>[0], request: RequestInit, count: Count) => Promise<Read>} */
async function open(source, request, count) {
  let hint = "";
  if (typeof source === "string" || source instanceof URL) {
    const url = new URL(source, globalThis.location?.href);
    if (/\/(meta\.json)?$/.test(url.pathname)) {
      return (file, limit) => download(new URL(file + url.search, url), limit, request, count);
    }
    source = await download(url, MAX_ZIP_BYTES, request, count);
    hint = " (the address of a folder ends with a slash)";
  } else {
    if (source instanceof Blob) source = await source.arrayBuffer();
    count(source.byteLength, source.byteLength);
  }
  const files = zipOf(source instanceof Uint8Array ? source : new Uint8Array(source), hint);
  return async (file, limit) => {
    const read = files.get(file);
    if (!read) throw new Error(`this is no SOG-XT container: it has no ${file}`);
    return read(limit);
  };
}

/** @type {(url: URL, limit: number, request: RequestInit, count: Count) => Promise<Uint8Array>} */
async function download(url, limit, request, count) {
  const file = url.pathname.split("/").pop();
  /** @type {(why: string) => never} */
  const fail = (why) => {
    throw new Error(`${file} cannot be fetched: ${why}`);
  };
  const response = await fetch(url, request).catch((error) => fail(messageOf(error)));
  if (!response.ok || !response.body) return fail(`the server answers with status ${response.status}`);
  count(0, Number(response.headers.get("Content-Length")));
  return collect(response.body, limit, (received) => count(received, 0)).catch((error) => fail(messageOf(error)));
}
