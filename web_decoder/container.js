/** Loading of a container: its files from a zip or a folder, and its images one after the other as they arrive. */

import { Pool } from "./pool.js";
import { collect, openZip } from "./zip.js";

/** @import { Options, Plane, Scene, Task } from "./types.js" */
/** @typedef {(file: string, limit: number) => Promise<Uint8Array>} Read */
/** @typedef {(limit: number) => Promise<Uint8Array>} ReadOne */
/** @typedef {(received: number, total: number) => void} Count */

/**
 * A scene that is assembled from decoded images, of which the first is needed by all others.
 * @typedef {object} Assembly
 * @property {Scene} scene
 * @property {string[]} files images in the order of decoding
 * @property {number} coarse number of images of a coarse rendering, which are downloaded before the others
 * @property {(file: string) => {pixels: number, width?: number, height?: number, checksum?: number}} expect
 * @property {(task: Task) => Promise<Plane> | undefined} [decode] decodes images of another kind than WebP
 * @property {(file: string, plane: Plane) => void} put
 */

/**
 * @typedef {object} Format
 * @property {string} name
 * @property {number} images their usual number
 * @property {new (message: string, options: ErrorOptions) => Error} Failure
 * @property {(json: Uint8Array, maxGaussians: number, yaml?: Uint8Array) => Assembly} assemble checks the metadata
 */

export const META = "meta.json";
/** What decoders in Python read; in a zip it is compared. */
export const YAML = "container_meta.yaml";
/** Number of SH coefficients beside `sh0`, by degree. */
export const COEFFICIENTS = [0, 3, 8, 15];
export const MAX_SIGNED_LOG = 88.7; // exp() of more is not a float32

const MAX_META_BYTES = 1 << 20;
const MAX_ZIP_BYTES = 1 << 30;

/**
 * Decode a container.
 * @param {string | URL | ArrayBuffer | Uint8Array | Blob} source address of a folder (with a slash at its end), of its
 *   meta.json, or of a zip; or a zip
 * @param {Options & {pool?: Pool}} options `pool`: workers of several containers
 * @param {Format} format
 * @returns {Promise<Scene>}
 */
export async function load(source, options, { name, images, Failure, assemble }) {
  const { signal, maxGaussians = 2e7, native = true } = options;
  const stop = new AbortController();
  const aborting = signal ? AbortSignal.any([signal, stop.signal]) : stop.signal;
  const progress = { received: 0, total: 0, decoded: 0, planes: images };
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
  const pool = options.pool ?? new Pool(options.workers);
  try {
    const [read, yaml] = await open(source, name, { ...options.request, signal: aborting }, (received, total) => {
      progress.received += received;
      progress.total += total;
      reportProgress();
    });
    const assembly = assemble(await read(META, MAX_META_BYTES), maxGaussians, await yaml?.(MAX_META_BYTES));
    const { scene, files, coarse } = assembly;
    progress.planes = files.length;
    /** @type {Promise<Uint8Array>[]} */
    const arriving = [];
    const loads = files.map(async (file, i) => {
      const expected = assembly.expect(file);
      if (i >= coarse) await Promise.all(arriving.slice(0, coarse)).catch(() => {});
      arriving[i] = read(file, 4096 + 5 * expected.pixels); // lossless images take at most 4 bytes per pixel
      const bytes = await arriving[i];
      const task = { file, bytes, native, ...expected };
      const plane = await (assembly.decode?.(task) ?? pool.decode(task));
      if (i) await loads[0];
      aborting.throwIfAborted();
      scene.sizes[file] = bytes.length;
      if (options.keepPlanes) scene.planes[file] = plane;
      assembly.put(file, plane);
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
    throw callbackErrors.length ? callbackErrors[0] : new Failure(messageOf(error), { cause: error });
  } finally {
    stop.abort();
    if (!options.pool) pool.close();
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

/** @type {(value: any, most: number) => boolean} */
const isDeeper = (value, most) =>
  Object(value) === value && (most < 0 || Object.values(value).some((each) => isDeeper(each, most - 1)));

/**
 * Parse the metadata, an object, nested at most 200 deep.
 * @param {Uint8Array} json
 * @returns {any}
 */
export function parseMeta(json) {
  try {
    const meta = JSON.parse(new TextDecoder("utf-8", { fatal: true }).decode(json));
    if (isDeeper(meta, 200)) throw new Error("too deep");
    return meta;
  } catch (error) {
    throw new Error(`${META} is not readable JSON`, { cause: error });
  }
}

/** The position of a signed logarithm. @type {(log: number) => number} */
export const positionOf = (log) => Math.sign(log) * Math.expm1(Math.abs(log));

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

/** @type {(source: Parameters<typeof load>[0], name: string, request: RequestInit, count: Count) => Promise<[Read, ReadOne?]>} */
async function open(source, name, request, count) {
  let hint = "";
  if (typeof source === "string" || source instanceof URL) {
    const url = new URL(source, globalThis.location?.href);
    if (/\/(meta\.json)?$/.test(url.pathname)) {
      return [(file, limit) => download(new URL(file + url.search, url), limit, request, count)];
    }
    source = await download(url, MAX_ZIP_BYTES, request, count);
    hint = " (the address of a folder ends with a slash)";
  } else {
    if (source instanceof Blob) source = await source.arrayBuffer();
    count(source.byteLength, source.byteLength);
  }
  const files = zipOf(source instanceof Uint8Array ? source : new Uint8Array(source), hint);
  /** @type {Read} */
  const read = async (file, limit) => {
    const one = files.get(file.replace(/.*\//, "")); // as in the zip's table, without folders
    if (!one) throw new Error(`this is no ${name} container: it has no ${file}`);
    return one(limit);
  };
  return [read, files.get(YAML)];
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
