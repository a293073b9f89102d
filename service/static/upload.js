/** Bringing a scene to the service, with a card that shows how far it is. */

import { Problem, authorization, refused, unreachable } from "./api.js";
import { announce, byId, el, entitle } from "./dom.js";
import { bytes, percent, roughly } from "./format.js";
import { problemBox } from "./trouble.js";

/** @typedef {import("./compose.js").Order} Order */

/**
 * One upload at a time, in its own card: other jobs can be looked at while it goes on.
 * @param {{started: () => void, accepted: (job: import("./api.js").Status, order: Order) => void,
 *   abandoned: (order: Order) => void}} watcher
 */
export function uploader(watcher) {
  const card = byId("upload");
  /** @type {XMLHttpRequest | null} */
  let request = null;

  const warn = (/** @type {BeforeUnloadEvent} */ event) => event.preventDefault();

  function finish() {
    request = null;
    window.removeEventListener("beforeunload", warn);
    entitle();
  }

  function close() {
    card.hidden = true;
    card.replaceChildren();
  }

  /**
   * @param {Order} order
   * @param {string} idempotencyKey the same for every try: a job whose answer was lost is not made twice
   */
  function send(order, idempotencyKey) {
    const view = progressView(order.file, () => request?.abort());
    card.replaceChildren(...view.children);
    card.hidden = false;
    window.addEventListener("beforeunload", warn);
    watcher.started();
    card.querySelector("h1").focus();
    request = post(order, idempotencyKey, {
      progress: view.update,
      accepted(job) {
        finish();
        close();
        watcher.accepted(job, order);
      },
      failed(problem) {
        finish();
        if (problem.code === "unauthorized") return close(); // the page asks for another key
        card.replaceChildren(...failedView(order, problem, () => send(order, idempotencyKey), giveUp));
        card.querySelector("h1").focus();
      },
      aborted: giveUp,
    });

    function giveUp() {
      finish();
      close();
      announce("The upload was cancelled.");
      watcher.abandoned(order);
    }
  }

  return {
    /** @param {Order} order */
    send: (order) => send(order, uniqueKey()),
    /** Whether its card is to be seen, with an upload or with what became of it. */
    shown: () => !card.hidden,
    /** Whether bytes are on their way. */
    busy: () => request !== null,
    /** Forget an upload that has failed. */
    dismiss: close,
  };
}

/**
 * @param {Order} order
 * @param {string} idempotencyKey
 * @param {{progress: (sent: number) => void, accepted: (job: any) => void, failed: (problem: Problem) => void,
 *   aborted: () => void}} then
 */
function post({ file, options }, idempotencyKey, then) {
  const request = new XMLHttpRequest(); // fetch cannot tell how much of a body has been sent
  const query = new URLSearchParams({ name: file.name, options: JSON.stringify(options) });
  request.open("POST", `/v1/jobs?${query}`);
  const headers = {
    ...authorization(),
    "Content-Type": "application/octet-stream",
    "Idempotency-Key": idempotencyKey,
  };
  for (const [name, value] of Object.entries(headers)) request.setRequestHeader(name, value);
  request.upload.onprogress = (event) => then.progress(event.loaded);
  request.onload = () => {
    if (request.status < 300) then.accepted(JSON.parse(request.responseText));
    else then.failed(refused(request.status, request.responseText));
  };
  request.onerror = () => then.failed(unreachable());
  request.onabort = then.aborted;
  request.send(file);
  return request;
}

/**
 * @param {File} file
 * @param {() => void} abort
 */
function progressView(file, abort) {
  const bar = el("progress", { max: 1, value: 0, "aria-labelledby": "upload-title" });
  const [done, left] = [el("span", {}, "0%"), el("span", {}, "")];
  const begun = performance.now();
  const children = [
    el("p", { class: "kicker" }, "Uploading"),
    el("h1", { id: "upload-title", tabindex: "-1" }, file.name),
    bar,
    el("p", { class: "spread muted" }, done, left),
    el("div", { class: "buttons" }, el("button", { class: "quiet", type: "button", onclick: abort }, "Cancel upload")),
  ];
  /** @param {number} loaded */
  function update(loaded) {
    const fraction = file.size ? Math.min(1, loaded / file.size) : 1;
    const spent = (performance.now() - begun) / 1000;
    bar.value = fraction;
    done.textContent = `${bytes(loaded)} of ${bytes(file.size)} · ${percent(fraction)}`;
    if (fraction >= 1) left.textContent = "The service checks it…";
    else if (spent > 1) left.textContent = `${roughly((spent / fraction) * (1 - fraction))} left`; // not from the first packet
    entitle(`${percent(fraction)} ${file.name}`);
  }
  return { children, update };
}

/**
 * @param {Order} order
 * @param {Problem} problem
 * @param {() => void} retry
 * @param {() => void} giveUp
 */
function failedView({ file }, problem, retry, giveUp) {
  const again = problem.document.retryable
    ? el("button", { class: "primary", type: "button", onclick: retry }, "Try again")
    : null;
  return [
    el("p", { class: "kicker bad" }, "Upload failed"),
    el("h1", { id: "upload-title", tabindex: "-1" }, file.name),
    problemBox(problem.document),
    el("div", { class: "buttons" }, again, el("button", { class: "quiet", type: "button", onclick: giveUp }, "Back")),
  ];
}

/** Random, also where `randomUUID` is missing: browsers have it on https and localhost only. */
function uniqueKey() {
  if (crypto.randomUUID) return crypto.randomUUID();
  return [...crypto.getRandomValues(new Uint8Array(16))].map((byte) => byte.toString(16).padStart(2, "0")).join("");
}
