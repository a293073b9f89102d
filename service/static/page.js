/** The page as a whole: which of its cards is to be seen, and what leads from one to the other. */

import { json } from "./api.js";
import { composer, dropAnywhere } from "./compose.js";
import { byId } from "./dom.js";
import { gate } from "./gate.js";
import { jobCard } from "./job.js";
import { recentJobs } from "./recent.js";
import { trouble } from "./trouble.js";
import { uploader } from "./upload.js";

/** The job that the address names: a reload, or a link sent to somebody, leads back to it. */
const jobInAddress = () => location.hash.match(/^#([0-9a-f]{32})$/)?.[1] ?? "";

/**
 * @param {import("./api.js").Limits} limits
 * @param {import("./api.js").Presets} presets
 */
function run(limits, presets) {
  /** What was uploaded from this tab, for another try. @type {Map<string, import("./compose.js").Order>} */
  const orders = new Map();
  const recent = recentJobs((id) => id === job.shown() && home());
  const upload = uploader({ started: () => show(false), accepted, abandoned: () => show(true) });
  const compose = composer(limits, presets, upload.send);
  const job = jobCard({ keyed: limits.keys_required, seen, again });

  function home() {
    location.hash = "";
  }

  async function refresh() {
    await recent.load();
    recent.mark(job.shown());
  }

  /** @param {import("./api.js").Status | null} status */
  function seen(status) {
    if (!status || !recent.see(status)) refresh();
  }

  /** @param {boolean} focus whether somebody has just asked for what is shown now */
  function show(focus) {
    const id = jobInAddress();
    if (id && id !== job.shown()) job.open(id, focus);
    if (!id) job.close();
    compose.show(!id && !upload.shown());
    if (!id && focus && !upload.shown()) compose.focus();
    recent.mark(id);
    if (focus) window.scrollTo({ top: 0 });
  }

  /** @param {import("./api.js").Status} status @param {import("./compose.js").Order} order */
  function accepted(status, order) {
    orders.set(status.id, order);
    if (!jobInAddress()) location.hash = status.id; // unless another job is being looked at
    refresh();
  }

  /** @param {import("./api.js").Status} status */
  function again(status) {
    const order = orders.get(status.id);
    home();
    compose.prefer(status.options);
    if (order && !upload.busy()) upload.send(order);
    else compose.ask(`Choose ${status.name}.ply once more: this page does not have it any more.`);
  }

  window.addEventListener("hashchange", () => show(true));
  document.addEventListener("visibilitychange", () => !document.hidden && !byId("app").hidden && refresh());
  dropAnywhere({
    willing: () => !byId("app").hidden && !upload.busy(), // one after the other
    take(file) {
      upload.dismiss();
      home();
      show(false); // the address may have been that already
      compose.take(file);
    },
  });
  gate(limits.keys_required, {
    enter() {
      show(false);
      refresh();
    },
    leave() {
      recent.stop();
      job.close();
    },
  });
}

async function start() {
  trouble(null);
  try {
    const [limits, presets, version] = await Promise.all([json("/v1/limits"), json("/v1/presets"), json("/version")]);
    byId("version").textContent = `kissgs ${version.kissgs} · API ${version.api} · ${version.container}`;
    run(limits, presets);
  } catch (error) {
    trouble(error, start);
  }
}

start();
