/** Loading of a streamed scene: its manifest, its files, and how many bytes they take. */

import { Pool } from "../pool.js";
import { collect } from "../zip.js";
import { decode } from "./decode.js";
import { MAX_FILE_GAUSSIANS } from "./lod_tree.js";
import { UserError } from "./problem.js";
import { get } from "./sources.js";

/** @typedef {import("./lod_tree.js").LodTree} LodTree */

/** Largest manifest; one of a thousand leaves and ten levels takes 700 kB. */
const MAX_MANIFEST_BYTES = 1 << 25;

/** Files of one scene, decoded in workers that they share. */
export class StreamedFiles {
  /** Bytes received, of all files and of files that were cancelled. */
  received = 0;
  /** Bytes of each complete file. @type {Map<number, number>} */
  #sizes = new Map();
  #pool = new Pool();
  #manifest = 0;

  /**
   * @param {string} address of the manifest; the files lie in its folder
   * @param {(received: number) => void} counted called when more bytes have arrived
   */
  constructor(address, counted) {
    this.address = new URL(address);
    this.counted = counted;
  }

  /** @param {AbortSignal} signal */
  async manifest(signal) {
    const { body } = await get(this.address.href, { signal });
    const stream = /** @type {ReadableStream<Uint8Array<ArrayBuffer>>} */ (body);
    const bytes = await collect(stream, MAX_MANIFEST_BYTES).catch((error) => {
      throw signal.aborted
        ? error
        : new UserError("The list of this scene's files cannot be read: it was cut off, or is too large.");
    });
    this.received = this.#manifest = bytes.length;
    return bytes;
  }

  /**
   * Decode a file: a folder's `meta.json` with its images, a `.sog`, or the `.zip` of a SOG-XT container.
   * @param {number} file
   * @param {string} name relative to the manifest
   * @param {AbortSignal} signal
   */
  async load(file, name, signal) {
    const url = new URL(name, this.address);
    url.search = this.address.search; // of addresses with a signature
    let own = 0;
    const scene = await decode(url.href, {
      ...{ signal, pool: this.#pool, maxGaussians: MAX_FILE_GAUSSIANS },
      onProgress: ({ received }) => {
        this.received += received - own;
        own = received;
        this.counted(this.received);
      },
    });
    this.#sizes.set(file, own);
    return scene;
  }

  /** Return the bytes of the whole scene, estimated from the files that have arrived. @param {LodTree} tree */
  total({ rows }) {
    const files = [...this.#sizes];
    const known = files.reduce((sum, [, size]) => sum + size, 0);
    const ofRows = files.reduce((sum, [file]) => sum + rows[file], 0);
    const others = rows.reduce((sum, count, file) => sum + (this.#sizes.has(file) ? 0 : count), 0);
    return this.#manifest + known + others * (known / Math.max(1, ofRows));
  }

  close() {
    this.#pool.close();
  }
}
