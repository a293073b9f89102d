/** The page: which of its cards is visible, and the transitions between them. */

import { json } from "./api.js";
import { composer, dropAnywhere } from "./compose.js";
import { byId } from "./dom.js";
import { gate } from "./gate.js";
import { jobCard } from "./job.js";
import { showProblem } from "./problems.js";
import { recentJobs } from "./recent.js";
import { uploader } from "./upload.js";

/** Return the id of the job in the page's address, which makes links to jobs possible; empty if there is none. */
const jobInAddress = () => location.hash.match(/^#([0-9a-f]{32})$/)?.[1] ?? "";

/**
 * @param {import("./api.js").Limits} limits
 * @param {import("./api.js").Presets} presets
 */
function run(limits, presets) {
  /** Submissions from this tab, for repetitions. @type {Map<string, import("./compose.js").Submission>} */
  const submissions = new Map();
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

  /** @param {boolean} focus whether the user has requested this view */
  function show(focus) {
    const id = jobInAddress();
    if (id && id !== job.shown()) job.open(id, focus);
    if (!id) job.close();
    compose.show(!id && !upload.shown());
    if (!id && focus && !upload.shown()) compose.focus();
    recent.mark(id);
    if (focus) window.scrollTo({ top: 0 });
  }

  /** @param {import("./api.js").Status} status @param {import("./compose.js").Submission} submission */
  function accepted(status, submission) {
    submissions.set(status.id, submission);
    compose.sent();
    if (!jobInAddress()) location.hash = status.id; // unless another job is open
    refresh();
  }

  /** @param {import("./api.js").Status} status */
  function again(status) {
    const submission = submissions.get(status.id);
    home();
    compose.prefer(status.options);
    if (submission && !upload.busy()) upload.send(submission);
    else compose.showError(`Choose the file of ${status.name} again: this page no longer has the file.`);
  }

  window.addEventListener("hashchange", () => show(true));
  document.addEventListener("visibilitychange", () => !document.hidden && !byId("app").hidden && refresh());
  dropAnywhere({
    accepts: () => !byId("app").hidden && !upload.busy(), // one upload at a time
    choose(file) {
      upload.dismiss();
      home();
      show(false); // the address may not have changed
      compose.choose(file);
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
  showProblem(null);
  try {
    const [limits, presets, version] = await Promise.all([json("/v1/limits"), json("/v1/presets"), json("/version")]);
    byId("version").textContent = `kissgs ${version.kissgs} · API ${version.api}`;
    run(limits, presets);
  } catch (error) {
    showProblem(error, start);
  }
}

start();
