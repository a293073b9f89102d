/** Threads that decode images. */

import { decodeNatively, decodePlane } from "./plane.js";

/** @import { Plane, Task } from "./types.js" */

/** Pixels of images that are decoded sooner than a worker can be told. */
const FEW_PIXELS = 128 ** 2;
const MAX_WORKERS = 4;

/** Workers, started as they are needed, or the caller's thread where there are none. */
export class Pool {
  /** Bytes that each has still to do. @type {Map<Worker, number>} */
  workers = new Map();
  /** What the caller's thread is doing. @type {Promise<unknown>} */
  last = Promise.resolve();
  closed = false;

  /** @param {number} [most] workers */
  constructor(most = Math.min(globalThis.navigator?.hardwareConcurrency ?? 1, MAX_WORKERS)) {
    this.most = most;
  }

  /**
   * @param {Task} task
   * @returns {Promise<Plane>}
   */
  async decode(task) {
    const plane = await decodeNatively(task); // in threads of the browser's own
    if (plane) return plane;
    const worker = task.width * task.height < FEW_PIXELS ? undefined : this.choose();
    return worker ? this.inWorker(worker, task) : this.here(task);
  }

  /** The worker with the least to do. */
  choose() {
    const [[worker, load] = []] = [...this.workers].sort(([, a], [, b]) => a - b);
    if ((worker && !load) || this.workers.size >= this.most) return worker;
    try {
      const another = start();
      this.workers.set(another, 0);
      return another;
    } catch {
      this.most = 0; // Node has none
      return worker;
    }
  }

  /** @type {(worker: Worker, task: Task) => Promise<Plane>} */
  inWorker(worker, task) {
    const size = task.bytes.length;
    this.workers.set(worker, (this.workers.get(worker) ?? 0) + size);
    return new Promise((resolve, reject) => {
      const { port1, port2 } = new MessageChannel();
      port1.onmessage = ({ data: { plane, error } }) => {
        port1.close();
        this.workers.set(worker, (this.workers.get(worker) ?? size) - size);
        if (plane) resolve(plane);
        else reject(new Error(error));
      };
      // It could not be loaded: a page's policy forbids it, or a bundler left it out.
      worker.addEventListener("error", () => {
        port1.close();
        this.workers.delete(worker);
        this.most = 0;
        resolve(this.here(task));
      });
      worker.postMessage({ task: { ...task, bytes: task.bytes.slice() }, port: port2 }, [port2]);
    });
  }

  /** One image after the other, and whatever else waits for the thread in between. @type {(task: Task) => Promise<Plane>} */
  here(task) {
    const plane = this.last.then(pause).then(() => {
      if (this.closed) throw new Error("ended");
      return decodePlane(task);
    });
    this.last = plane.catch(() => {});
    return plane;
  }

  close() {
    this.closed = true;
    for (const worker of this.workers.keys()) worker.terminate();
  }
}

function start() {
  try {
    return new Worker(new URL("./worker.js", import.meta.url), { type: "module" });
  } catch {
    // Scripts from another origin may only be imported.
    const script = `import ${JSON.stringify(new URL("./worker.js", import.meta.url))}`;
    return new Worker(URL.createObjectURL(new Blob([script], { type: "text/javascript" })), { type: "module" });
  }
}

/** Let the event loop turn; timers would take 4 ms each. */
const pause = () =>
  new Promise((resolve) => {
    const { port1, port2 } = new MessageChannel();
    port1.onmessage = () => {
      port1.close();
      resolve(undefined);
    };
    port2.postMessage(0);
  });
