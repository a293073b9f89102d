/** Decodes containers by jobs, and reports results and events as JSON; used in Node.js, in pages and in workers. */

import * as sog from "../../web_decoder/sog.js";
import * as sogxt from "../../web_decoder/sogxt.js";

let unpacked = 0;
const Native = globalThis.DecompressionStream;
/** Counts the bytes that are unpacked. */
globalThis.DecompressionStream = class {
  constructor(format) {
    const { readable, writable } = new Native(format);
    const transform = (bytes, controller) => ((unpacked += bytes.length), controller.enqueue(bytes));
    Object.assign(this, { writable, readable: readable.pipeThrough(new TransformStream({ transform })) });
  }
};

const FIELDS = ["means", "quats", "scales", "opacities", "sh0", "labels", "centroids", "cells"];

const toBase64 = (array) => {
  const bytes = new Uint8Array(array.buffer, array.byteOffset, array.byteLength);
  let text = "";
  for (let i = 0; i < bytes.length; i += 8192) text += String.fromCharCode(...bytes.subarray(i, i + 8192));
  return btoa(text);
};

/** Return a source for `decode`: an address, or bytes in one of several types. */
function sourceOf({ url, base64, as = "bytes" }) {
  if (url) return as === "URL" ? new URL(url) : url;
  const bytes = Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0));
  const shifted = new Uint8Array(bytes.length + 7);
  shifted.set(bytes, 3);
  return { bytes, buffer: bytes.buffer, blob: new Blob([bytes]), within: shifted.subarray(3, 3 + bytes.length) }[as];
}

/** Perform one job; never rejects. */
export async function perform({ format = "sogxt", source, options = {}, abort, snapshots, throwAt }) {
  const { decode, expandSH } = format === "sog" ? sog : sogxt;
  const report = { progress: [], order: [], snapshots: {} };
  const stop = new AbortController();
  if (abort === "before") stop.abort();
  if (abort === "reason") stop.abort(new RangeError("a reason"));
  if (abort?.after) setTimeout(() => stop.abort(), abort.after);
  const [start, before] = [performance.now(), unpacked];
  try {
    const scene = await decode(sourceOf(source), {
      ...options,
      ...(abort && { signal: stop.signal }),
      onProgress: (progress) => report.progress.push(progress),
      onPlane: (file, partial) => {
        report.order.push(file);
        if (snapshots?.includes(file)) {
          report.snapshots[file] = Object.fromEntries(FIELDS.map((field) => [field, toBase64(partial[field])]));
        }
        if (abort?.at === file) stop.abort();
        if (throwAt === file) throw new Error("thrown by the caller");
      },
    });
    const { count, degree, gridSide, codebookSide, contents, sizes, meta } = scene;
    Object.assign(report, { count, degree, gridSide, codebookSide, contents, sizes, meta });
    report.types = Object.fromEntries(FIELDS.map((field) => [field, scene[field].constructor.name]));
    report.arrays = Object.fromEntries(
      [...FIELDS.map((f) => [f, scene[f]]), ["shN", expandSH(scene)]].map(([f, a]) => [f, toBase64(a)]),
    );
    report.planes = Object.fromEntries(
      Object.entries(scene.planes).map(([file, { width, height, rgba }]) => [file, [width, height, toBase64(rgba)]]),
    );
  } catch (error) {
    report.error = { name: error.name, message: error.message, stack: String(error.stack), cause: String(error.cause) };
  }
  report.ms = performance.now() - start;
  report.ended = report.order.length;
  await new Promise((resolve) => setTimeout(resolve, abort ? 50 : 0));
  report.unpacked = unpacked - before;
  report.later = report.order.length - report.ended;
  return report;
}
