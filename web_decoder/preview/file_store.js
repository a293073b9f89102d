/** The files of a streamed scene that are held: loaded by priority, few at once, and dropped when others need the room. */

/**
 * @template T
 */
export class FileStore {
  /** Loaded files, the one that was wanted longest ago first. @type {Map<number, T>} */
  #held = new Map();
  /** @type {Map<number, AbortController>} */
  #loading = new Map();
  /** Number of failures of each file since it was loaded last. @type {Map<number, number>} */
  #failures = new Map();
  #closed = false;

  /**
   * @param {object} options
   * @param {number[]} options.sizes of the files
   * @param {number} options.room largest sum of the sizes of files that are held or loading
   * @param {number} options.most largest number of files that load at once
   * @param {(file: number, signal: AbortSignal) => Promise<T>} options.load
   * @param {() => void} options.changed called when a file has been loaded, or will not be
   * @param {(file: number, error: unknown) => void} options.failed called when a file has failed twice
   * @param {number} [options.pause] milliseconds before the second attempt
   */
  constructor(options) {
    this.options = options;
  }

  /** @param {number} file */
  get = (file) => this.#held.get(file);

  /** @param {number} file */
  has = (file) => this.#held.has(file);

  /** Whether no file is loading. */
  get idle() {
    return this.#loading.size === 0;
  }

  /** Whether a file has failed twice. @param {number} file */
  isLost = (file) => (this.#failures.get(file) ?? 0) > 1;

  /**
   * Load files that are not held. What else is loading is cancelled; what else is held is dropped as room is needed.
   * @param {number[]} files the most urgent first; those that do not fit are not loaded
   */
  want(files) {
    if (this.#closed) return;
    const wanted = this.#fitting(files.filter((file) => !this.isLost(file)));
    for (const file of [...wanted].reverse()) this.#touch(file);
    for (const [file, stop] of this.#loading) {
      if (wanted.has(file)) continue;
      this.#loading.delete(file);
      stop.abort(new DOMException("not wanted any more", "AbortError"));
    }
    for (const file of wanted) {
      if (this.#loading.size >= this.options.most) break;
      if (this.#held.has(file) || this.#loading.has(file)) continue;
      this.#makeRoom(this.options.sizes[file], wanted);
      this.#begin(file);
    }
  }

  /** Cancel and drop everything. */
  close() {
    this.want([]);
    this.#closed = true;
    this.#held.clear();
  }

  /** @param {number[]} files */
  #fitting(files) {
    let left = this.options.room;
    return new Set(files.filter((file) => (left -= this.options.sizes[file]) >= 0));
  }

  /** @param {number} file */
  #touch(file) {
    const content = this.#held.get(file);
    if (content === undefined) return;
    this.#held.delete(file);
    this.#held.set(file, content);
  }

  /** @param {number} size @param {Set<number>} wanted */
  #makeRoom(size, wanted) {
    const all = [...this.#held.keys(), ...this.#loading.keys()];
    let over = all.reduce((sum, file) => sum + this.options.sizes[file], size) - this.options.room;
    for (const file of [...this.#held.keys()]) {
      if (over <= 0) break;
      if (wanted.has(file)) continue;
      this.#held.delete(file);
      over -= this.options.sizes[file];
    }
  }

  /** @param {number} file */
  async #begin(file) {
    const stop = new AbortController();
    this.#loading.set(file, stop);
    const current = () => this.#loading.get(file) === stop;
    try {
      if (this.#failures.has(file)) await new Promise((resolve) => setTimeout(resolve, this.options.pause ?? 1000));
      stop.signal.throwIfAborted();
      const content = await this.options.load(file, stop.signal);
      if (!current()) return;
      this.#held.set(file, content);
      this.#failures.delete(file);
    } catch (error) {
      if (!current()) return;
      this.#failures.set(file, (this.#failures.get(file) ?? 0) + 1);
      if (this.isLost(file)) this.options.failed(file, error);
    }
    this.#loading.delete(file);
    this.options.changed();
  }
}
