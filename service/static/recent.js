/** The list of recent jobs, which can be opened or deleted. */

import { active, call, json, remove } from "./api.js";
import { announce, byId, el, time } from "./dom.js";
import { ago, short } from "./format.js";
import { explain, sentence } from "./problems.js";
import { stateLabel } from "./labels.js";

/** @typedef {import("./api.js").Status} Status */

const PAGE_SIZE = 10;
const MAX_PAGE_SIZE = 100; // limit of the service
const REFRESH_MS = 5000; // while a listed job has not ended

/**
 * @param {(id: string) => void} deleted
 */
export function recentJobs(deleted) {
  const [list, more] = [byId("recent-list"), byId("recent-more")];
  /** @type {Map<string, ReturnType<typeof row>>} */
  const rows = new Map();
  /** @type {string | null} */
  let next = null;
  let timer = 0;

  /** Reload the list with its present length. */
  async function load() {
    clearTimeout(timer);
    await withErrors(async () => {
      const limit = Math.min(MAX_PAGE_SIZE, Math.max(PAGE_SIZE, rows.size));
      /** @type {import("./api.js").JobPage} */
      const page = await json(`/v1/jobs?limit=${limit}`);
      arrange(page.jobs);
      updatePaging(page);
    });
  }

  async function older() {
    await withErrors(async () => {
      /** @type {import("./api.js").JobPage} */
      const page = await json(`/v1/jobs?limit=${PAGE_SIZE}&cursor=${next}`);
      arrange([...[...rows.values()].map((row) => row.job()), ...page.jobs]);
      updatePaging(page);
      if (page.jobs[0]) rows.get(page.jobs[0].id)?.focus();
    });
  }

  /** @param {import("./api.js").JobPage} page */
  function updatePaging(page) {
    next = page.next ?? null;
    more.hidden = next === null;
    byId("recent").hidden = rows.size === 0;
    clearTimeout(timer);
    if ([...rows.values()].some((row) => active(row.job()))) timer = window.setTimeout(load, REFRESH_MS);
  }

  /**
   * Show these jobs in this order; remaining rows are not moved, because they may have the focus.
   * @param {Status[]} jobs
   */
  function arrange(jobs) {
    const ids = new Set(jobs.map((job) => job.id));
    for (const [id, row] of rows)
      if (!ids.has(id)) {
        row.element.remove();
        rows.delete(id);
      }
    jobs.forEach((job, at) => {
      const found = rows.get(job.id) ?? row(ask);
      rows.set(job.id, found);
      found.update(job);
      if (list.children[at] !== found.element) list.insertBefore(found.element, list.children[at] ?? null);
    });
  }

  /** @param {Status} job */
  async function ask(job) {
    if (!(await confirmed(job))) return;
    await withErrors(async () => {
      await remove(job.id);
      announce(`${job.name} was deleted.`);
      deleted(job.id);
      await load();
      byId("recent-title").focus({ preventScroll: true }); // the pressed button was removed
    });
  }

  more.addEventListener("click", older);
  return {
    load,
    /**
     * Update the row of a job.
     * @param {Status} job
     * @returns {boolean} whether the job is listed
     */
    see(job) {
      rows.get(job.id)?.update(job);
      return rows.has(job.id);
    },
    stop: () => clearTimeout(timer),
    /** @param {string} id id of the open job, or empty */
    mark: (id) => rows.forEach((row) => row.mark(id)),
  };
}

/** @param {() => Promise<void>} work */
async function withErrors(work) {
  const message = byId("recent-error");
  try {
    await work();
    message.textContent = "";
  } catch (error) {
    const { title, detail } = explain(error);
    message.textContent = `${title}. ${sentence(detail)}`;
    byId("recent").hidden = false;
  }
}

/** @param {(job: Status) => void} ask */
function row(ask) {
  /** @type {Status} */
  let job;
  const link = el("a", { class: "job-name" });
  const image = el("img", { class: "job-image", alt: "", width: 64, height: 48 });
  const [state, ratio, age] = [el("span", { class: "badge" }), el("span", { class: "job-ratio" }), el("span")];
  age.className = "job-age muted";
  const button = el("button", { class: "plain", type: "button", onclick: () => ask(job) }, "Delete");
  const element = el("li", {}, image, link, state, ratio, age, button);
  return {
    element,
    job: () => job,
    focus: () => link.focus(),
    /** @param {string} open */
    mark: (open) =>
      job.id === open ? link.setAttribute("aria-current", "true") : link.removeAttribute("aria-current"),
    /** @param {Status} next */
    update(next) {
      if (next.links.thumbnail && !job?.links.thumbnail) draw(image, next.links.thumbnail);
      job = next;
      link.textContent = job.name;
      link.href = `#${job.id}`;
      state.textContent = stateLabel(job.state);
      state.className = `badge ${job.state}`;
      ratio.textContent = job.sizes ? `${short(job.sizes.ratio)}×` : "";
      age.replaceChildren(time(job.timings.created_at, ago(job.timings.created_at)));
      button.setAttribute("aria-label", `Delete ${job.name}`);
    },
  };
}

/**
 * Show the image of a result, which a link cannot ask for where the service wants a key.
 * @param {HTMLImageElement} image
 * @param {string} path
 */
async function draw(image, path) {
  const answer = await call(path).catch(() => null); // the list is useful without
  if (answer) image.src = URL.createObjectURL(await answer.blob());
}

/**
 * @param {Status} job
 * @returns {Promise<boolean>}
 */
function confirmed(job) {
  /** @type {HTMLDialogElement} */
  const dialog = byId("confirm");
  byId("confirm-title").textContent = `Delete ${job.name}?`;
  byId("confirm-text").textContent = active(job)
    ? "The job is cancelled, and the upload is removed."
    : "All its files on the server are removed. This cannot be undone.";
  byId("confirm-yes").onclick = () => dialog.close("yes");
  byId("confirm-no").onclick = () => dialog.close("");
  dialog.returnValue = ""; // Escape does not change it
  dialog.showModal();
  return new Promise((resolve) => {
    dialog.addEventListener("close", () => resolve(dialog.returnValue === "yes"), { once: true });
  });
}
