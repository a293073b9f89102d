/** Following a job to its end, over broken connections and restarts of the service. */

import { Problem, active, call, status as statusOf } from "./api.js";
import { messages } from "./events.js";

const REFRESH_MS = 3000; // of the status: only it knows the place in the queue and when the job will be done
const LONGEST_WAIT_MS = 15000; // between two tries to connect

/**
 * @typedef {import("./api.js").Status} Status
 * @typedef {object} Watcher
 * @property {(status: Status) => void} status called first with the status at the start, last with that of the end
 * @property {(progress: import("./api.js").Progress) => void} progress
 * @property {() => void} restarted its work begins anew
 * @property {(connected: boolean) => void} connection
 * @property {(problem: Problem) => void} lost the job cannot be followed any more
 */

/**
 * Follow a job that has not ended.
 * @param {string} id
 * @param {Watcher} watcher
 * @returns {() => void} call it to stop
 */
export function follow(id, watcher) {
  const stopper = new AbortController();
  const { signal } = stopper;
  const stop = () => stopper.abort();
  /** @type {boolean | null} null until the first try has ended */
  let connected = null;

  /** @param {Status} status */
  function accept(status) {
    if (signal.aborted) return;
    watcher.status(status);
    if (!active(status)) stop();
    else if (!connected && status.progress) watcher.progress(status.progress);
  }

  /** @param {unknown} error */
  function stumble(error) {
    if (signal.aborted) return;
    if (error instanceof Problem && error.final) {
      stop();
      return watcher.lost(error);
    }
    connect(false);
  }

  /** @param {boolean} now */
  function connect(now) {
    if (now !== connected) watcher.connection(now);
    connected = now;
  }

  /** @param {import("./events.js").Message} message */
  async function take({ event, data }) {
    const told = JSON.parse(data);
    if (event === "progress") return watcher.progress(told);
    if (event !== "state") return;
    if (told.start > 1) watcher.restarted();
    if (told.job) accept(told.job);
    else if (!active(told)) accept(await statusOf(id, signal)); // deleted in between, or the like
  }

  async function listen() {
    let [last, failures] = ["", 0];
    while (!signal.aborted) {
      try {
        const headers = last ? { "Last-Event-ID": last } : undefined;
        const answer = await call(`/v1/jobs/${id}/events`, { headers, signal });
        connect(true);
        if (answer.status === 204 || !answer.body) accept(await statusOf(id, signal));
        else
          for await (const message of messages(answer.body)) {
            failures = 0;
            last = message.id || last;
            await take(message);
          }
        failures += 1; // it ended, and the job has not: the service is stopping
      } catch (error) {
        failures += 1;
        stumble(error);
      }
      await sleep(Math.min(LONGEST_WAIT_MS, 500 * 2 ** failures), signal);
    }
  }

  async function refresh() {
    while (!signal.aborted) {
      try {
        accept(await statusOf(id, signal));
      } catch (error) {
        stumble(error);
      }
      await sleep(REFRESH_MS, signal);
    }
  }

  listen();
  refresh();
  return stop;
}

/**
 * @param {number} milliseconds
 * @param {AbortSignal} signal ends it early
 */
function sleep(milliseconds, signal) {
  return new Promise((resolve) => {
    if (signal.aborted) return resolve(undefined);
    const timer = setTimeout(resolve, milliseconds);
    signal.addEventListener("abort", () => (clearTimeout(timer), resolve(undefined)), { once: true });
  });
}
