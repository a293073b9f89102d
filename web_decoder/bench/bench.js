/** What bench/decoder.py asks of a page, a fresh one for each: the first time counts loading and compiling as well. */

import { openZip } from "../zip.js";

/**
 * Milliseconds of every repetition.
 * @param {"javascript" | "workers" | "native" | "webp.js" | "libwebp"} what
 * @param {string} url of a container
 * @param {number} repetitions
 */
async function measure(what, url, repetitions) {
  const zip = new Uint8Array(await (await fetch(url)).arrayBuffer());
  /** @type {Uint8Array[]} */
  const images = [];
  for (const [file, read] of openZip(zip)) if (file.endsWith(".webp")) images.push(await read(1 << 28));
  const times = [];
  /** @type {(() => unknown) | undefined} */
  let task;
  for (let i = 0; i < repetitions; i++) {
    const start = performance.now();
    task ??= await load(what, zip, images);
    await task();
    times.push(performance.now() - start);
  }
  return times;
}

/**
 * @param {string} what
 * @param {Uint8Array} zip
 * @param {Uint8Array[]} images
 * @returns {Promise<() => unknown>}
 */
async function load(what, zip, images) {
  if (what === "webp.js") {
    const { decodeWebP } = await import("../webp.js");
    return () => images.forEach((bytes) => decodeWebP(bytes));
  }
  if (what === "libwebp") {
    const { default: instantiate } = await import("../node_modules/@jsquash/webp/codec/dec/webp_dec.js");
    const libwebp = await instantiate();
    return () => images.forEach((bytes) => libwebp.decode(bytes));
  }
  const { decode } = await import("../sogxt.js");
  const native = what === "native";
  return () => decode(zip, what === "javascript" ? { workers: 0, native } : { native });
}

Object.assign(window, { measure });
