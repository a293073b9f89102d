/** Upload of a scene, with a card that shows its progress. */

import { Problem, authorization, refused, unreachable } from "./api.js";
import { announce, byId, el, setTitle } from "./dom.js";
import { bytes, percent, roughly } from "./format.js";
import { problemBox } from "./problems.js";

/** @typedef {import("./compose.js").Submission} Submission */

const GONE = "The service no longer has the photographs of the earlier job. Go back, and choose their archive again.";

/**
 * Create the upload card, for one upload at a time; other jobs can be opened during an upload.
 * @param {{started: () => void, accepted: (job: import("./api.js").Status, submission: Submission) => void,
 *   abandoned: (submission: Submission) => void}} callbacks
 */
export function uploader(callbacks) {
  const card = byId("upload");
  /** @type {XMLHttpRequest | null} */
  let request = null;

  const warn = (/** @type {BeforeUnloadEvent} */ event) => event.preventDefault();

  function finish() {
    request = null;
    window.removeEventListener("beforeunload", warn);
    setTitle();
  }

  function close() {
    card.hidden = true;
    card.replaceChildren();
  }

  /**
   * @param {Submission} submission
   * @param {string} idempotencyKey unchanged in repetitions, so that a job is not created twice if a response was lost
   */
  function send(submission, idempotencyKey) {
    const view = progressView(submission, () => request?.abort());
    card.replaceChildren(...view.children);
    card.hidden = false;
    window.addEventListener("beforeunload", warn);
    callbacks.started();
    card.querySelector("h1").focus();
    request = post(submission, idempotencyKey, {
      progress: view.update,
      accepted(job) {
        finish();
        close();
        callbacks.accepted(job, submission);
      },
      failed(problem) {
        finish();
        if (problem.code === "unauthorized") return close(); // the page shows the key form
        card.replaceChildren(...failedView(submission, problem, () => send(submission, idempotencyKey), giveUp));
        card.querySelector("h1").focus();
      },
      aborted: giveUp,
    });

    function giveUp() {
      finish();
      close();
      announce("The upload was cancelled.");
      callbacks.abandoned(submission);
    }
  }

  return {
    /** @param {Submission} submission */
    send: (submission) => send(submission, uniqueKey()),
    /** Whether the card is visible, with an upload or its failure. */
    shown: () => !card.hidden,
    /** Whether an upload is in progress. */
    busy: () => request !== null,
    /** Close the card after a failed upload. */
    dismiss: close,
  };
}

/**
 * @param {Submission} submission
 * @param {string} idempotencyKey
 * @param {{progress: (sent: number) => void, accepted: (job: any) => void, failed: (problem: Problem) => void,
 *   aborted: () => void}} then
 */
function post({ file, capture, options }, idempotencyKey, then) {
  const request = new XMLHttpRequest(); // fetch does not report upload progress
  const form = new FormData();
  if (capture) form.append("capture", capture);
  form.append("file", file);
  const query = new URLSearchParams({ name: file.name, options: JSON.stringify(options) });
  request.open("POST", `/v1/jobs?${query}`);
  const headers = {
    ...authorization(),
    "Idempotency-Key": idempotencyKey,
    ...(!capture && { "Content-Type": "application/octet-stream" }), // else the browser's, of a form
  };
  for (const [name, value] of Object.entries(headers)) request.setRequestHeader(name, value);
  request.upload.onprogress = (event) => then.progress(event.loaded);
  request.onload = () => {
    if (request.status < 300) then.accepted(JSON.parse(request.responseText));
    else then.failed(refused(request.status, request.responseText));
  };
  request.onerror = () => then.failed(unreachable());
  request.onabort = then.aborted;
  request.send(capture ? form : file);
  return request;
}

/**
 * @param {Submission} submission
 * @param {() => void} abort
 */
function progressView({ file, capture }, abort) {
  const size = file.size + (capture?.size ?? 0);
  const bar = el("progress", { max: 1, value: 0, "aria-labelledby": "upload-title" });
  const [done, left] = [el("span", {}, "0%"), el("span", {}, "")];
  const started = performance.now();
  const children = [
    el("p", { class: "kicker" }, "Uploading"),
    el("h1", { id: "upload-title", tabindex: "-1" }, file.name),
    bar,
    el("p", { class: "spread muted" }, done, left),
    el("div", { class: "buttons" }, el("button", { class: "quiet", type: "button", onclick: abort }, "Cancel upload")),
  ];
  /** @param {number} loaded */
  function update(loaded) {
    const fraction = size ? Math.min(1, loaded / size) : 1;
    const spent = (performance.now() - started) / 1000;
    bar.value = fraction;
    done.textContent = `${bytes(Math.min(loaded, size))} of ${bytes(size)} · ${percent(fraction)}`;
    if (fraction >= 1)
      left.textContent = capture
        ? "The service checks the scene and its photographs…"
        : "The service checks the scene…";
    else if (spent > 1) left.textContent = `${roughly((spent / fraction) * (1 - fraction))} left`; // the first second is not representative
    setTitle(`${percent(fraction)} ${file.name}`);
  }
  return { children, update };
}

/**
 * @param {Submission} submission
 * @param {Problem} problem
 * @param {() => void} retry
 * @param {() => void} giveUp
 */
function failedView({ file, options }, problem, retry, giveUp) {
  const gone = problem.code === "gone" && options.capture ? { ...problem.document, detail: GONE } : problem.document;
  const again = problem.document.retryable
    ? el("button", { class: "primary", type: "button", onclick: retry }, "Try again")
    : null;
  return [
    el("p", { class: "kicker bad" }, "Upload failed"),
    el("h1", { id: "upload-title", tabindex: "-1" }, file.name),
    problemBox(gone),
    el("div", { class: "buttons" }, again, el("button", { class: "quiet", type: "button", onclick: giveUp }, "Back")),
  ];
}

/** Return a random key, also without `randomUUID`, which browsers provide on https and localhost only. */
function uniqueKey() {
  if (crypto.randomUUID) return crypto.randomUUID();
  return [...crypto.getRandomValues(new Uint8Array(16))].map((byte) => byte.toString(16).padStart(2, "0")).join("");
}
