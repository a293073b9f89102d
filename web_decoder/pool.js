/** A pool of workers that decode images. */

import { decodeNatively, decodePlane } from "./plane.js";

/** @import { Plane, Task } from "./types.js" */

/** Images with fewer pixels are decoded in the caller's thread, which takes less time than a message to a worker. */
const MIN_WORKER_PIXELS = 128 ** 2;
const MAX_WORKERS = 4;

/** Workers, started when needed; the caller's thread where there are none. */
export class Pool {
  /** Bytes that each worker has yet to decode. @type {Map<Worker, number>} */
  workers = new Map();
  /** The latest task of the caller's thread. @type {Promise<unknown>} */
  last = Promise.resolve();
  closed = false;

  /** @param {number} [maxWorkers] */
  constructor(maxWorkers = Math.min(globalThis.navigator?.hardwareConcurrency ?? 1, MAX_WORKERS)) {
    this.maxWorkers = maxWorkers;
  }

  /**
   * @param {Task} task
   * @returns {Promise<Plane>}
   */
  async decode(task) {
    const plane = await decodeNatively(task); // in the browser's own threads
    if (plane) return plane;
    const worker = sizeOf(task) < MIN_WORKER_PIXELS ? undefined : this.choose();
    return worker ? this.inWorker(worker, task) : this.inCaller(task);
  }

  /** Return the worker with the fewest bytes to decode; start another one if all are busy and there may be more. */
  choose() {
    const [[worker, load] = []] = [...this.workers].sort(([, a], [, b]) => a - b);
    if ((worker && !load) || this.workers.size >= this.maxWorkers) return worker;
    try {
      const another = startWorker();
      this.workers.set(another, 0);
      return another;
    } catch {
      this.maxWorkers = 0; // Node.js has no workers of this kind
      return worker;
    }
  }

  /** @type {(worker: Worker, task: Task) => Promise<Plane>} */
  inWorker(worker, task) {
    const size = task.bytes.length;
    this.workers.set(worker, (this.workers.get(worker) ?? 0) + size);
    return new Promise((resolve, reject) => {
      const { port1, port2 } = new MessageChannel();
      // The worker could not be loaded: the page's policy forbids it, or a bundler omitted it.
      const failed = () => {
        end();
        this.workers.delete(worker);
        this.maxWorkers = 0;
        resolve(this.inCaller(task));
      };
      const end = () => {
        port1.close();
        worker.removeEventListener("error", failed); // it would keep the task's bytes and plane in memory
      };
      port1.onmessage = ({ data: { plane, error } }) => {
        end();
        this.workers.set(worker, (this.workers.get(worker) ?? size) - size);
        if (plane) resolve(plane);
        else reject(new Error(error));
      };
      worker.addEventListener("error", failed);
      worker.postMessage({ task: { ...task, bytes: task.bytes.slice() }, port: port2 }, [port2]);
    });
  }

  /** Decode in the caller's thread, one image after the other, with a turn of the event loop between them. @type {(task: Task) => Promise<Plane>} */
  inCaller(task) {
    const plane = this.last.then(pause).then(() => {
      if (this.closed) throw new Error("closed");
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

/** Number of pixels; if that is unknown, a smaller one from the bytes. @param {Task} task */
const sizeOf = ({ width, height, bytes }) => (width && height ? width * height : bytes.length);

function startWorker() {
  try {
    return new Worker(new URL("./worker.js", import.meta.url), { type: "module" });
  } catch {
    // A script of another origin can only be imported.
    const script = `import ${JSON.stringify(new URL("./worker.js", import.meta.url))}`;
    return new Worker(URL.createObjectURL(new Blob([script], { type: "text/javascript" })), { type: "module" });
  }
}

/** Wait for a turn of the event loop; a timer would take 4 ms. */
const pause = () =>
  new Promise((resolve) => {
    const { port1, port2 } = new MessageChannel();
    port1.onmessage = () => {
      port1.close();
      resolve(undefined);
    };
    port2.postMessage(0);
  });
