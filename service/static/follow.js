/** Tracking of a job until its end, over lost connections and restarts of the service. */

import { Problem, active, call, status as statusOf } from "./api.js";
import { messages } from "./events.js";

const REFRESH_MS = 3000; // of the status, which has the queue position and the time estimate
const MAX_RETRY_MS = 15000; // between attempts to connect

/**
 * @typedef {import("./api.js").Status} Status
 * @typedef {object} Watcher
 * @property {(status: Status) => void} status called for each status, from the start to the end
 * @property {(progress: import("./api.js").Progress) => void} progress
 * @property {() => void} restarted the job has started again
 * @property {(connected: boolean) => void} connection
 * @property {(problem: Problem) => void} lost the job cannot be tracked any more
 */

/**
 * Track a job that has not ended.
 * @param {string} id
 * @param {Watcher} watcher
 * @returns {() => void} stops tracking
 */
export function follow(id, watcher) {
  const stopper = new AbortController();
  const { signal } = stopper;
  const stop = () => stopper.abort();
  /** @type {boolean | null} null until the first attempt has ended */
  let connected = null;

  /** @param {Status} status */
  function accept(status) {
    if (signal.aborted) return;
    watcher.status(status);
    if (!active(status)) stop();
    else if (!connected && status.progress) watcher.progress(status.progress);
  }

  /** @param {unknown} error */
  function handleError(error) {
    if (signal.aborted) return;
    if (error instanceof Problem && error.final) {
      stop();
      return watcher.lost(error);
    }
    setConnected(false);
  }

  /** @param {boolean} now */
  function setConnected(now) {
    if (now !== connected) watcher.connection(now);
    connected = now;
  }

  /** @param {import("./events.js").Message} message */
  async function handle({ event, data }) {
    const content = JSON.parse(data);
    if (event === "progress") return watcher.progress(content);
    if (event !== "state") return;
    if (content.start > 1) watcher.restarted();
    if (content.job) accept(content.job);
    else if (!active(content)) accept(await statusOf(id, signal)); // for example after a deletion
  }

  async function listen() {
    let [last, failures] = ["", 0];
    while (!signal.aborted) {
      try {
        const headers = last ? { "Last-Event-ID": last } : undefined;
        const answer = await call(`/v1/jobs/${id}/events`, { headers, signal });
        setConnected(true);
        if (answer.status === 204 || !answer.body) accept(await statusOf(id, signal));
        else
          for await (const message of messages(answer.body)) {
            failures = 0;
            last = message.id || last;
            await handle(message);
          }
        failures += 1; // the stream ended before the job: the service is stopping
      } catch (error) {
        failures += 1;
        handleError(error);
      }
      await sleep(Math.min(MAX_RETRY_MS, 500 * 2 ** failures), signal);
    }
  }

  async function refresh() {
    while (!signal.aborted) {
      try {
        accept(await statusOf(id, signal));
      } catch (error) {
        handleError(error);
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
 * @param {AbortSignal} signal ends the wait early
 */
function sleep(milliseconds, signal) {
  return new Promise((resolve) => {
    if (signal.aborted) return resolve(undefined);
    const timer = setTimeout(resolve, milliseconds);
    signal.addEventListener("abort", () => (clearTimeout(timer), resolve(undefined)), { once: true });
  });
}
