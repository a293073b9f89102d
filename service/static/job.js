/** The card of a job, from the queue to its end. */

import { Problem, active, cancel, status as statusOf } from "./api.js";
import { announce, byId, el, setTitle } from "./dom.js";
import { follow } from "./follow.js";
import { short } from "./format.js";
import { resultView } from "./result.js";
import { runningView } from "./running.js";
import { explain, problemBox } from "./problems.js";
import { jobLabel, stateLabel } from "./labels.js";

/** @typedef {import("./api.js").Status} Status */

/**
 * Create the job card, which shows one job at a time.
 * @param {{keyed: boolean, seen: (status: Status | null) => void, again: (status: Status) => void}} page
 *   seen is called with each status, null for a job that cannot be tracked any more; again is called to repeat a
 *   submission
 */
export function jobCard(page) {
  const card = byId("job");
  let stop = () => {};
  let shown = ""; // the id

  /** @param {(Node | string)[]} children @param {boolean} [focus] */
  function fill(children, focus = false) {
    const keeps = focus || card.contains(document.activeElement); // keep the focus in the card
    card.replaceChildren(...children);
    if (keeps) card.querySelector("h1")?.focus({ preventScroll: !focus });
  }

  /** @param {Status} status @param {boolean} focus */
  function watch(status, focus) {
    const view = runningView(status, async () => {
      try {
        end(await cancel(status.id));
      } catch (error) {
        view.release();
        card.append(problemBox(explain(error)));
      }
    });
    fill(view.children, focus);
    const ticking = setInterval(view.tick, 1000);
    const unfollow = follow(status.id, {
      ...view,
      status(next) {
        if (!active(next)) return end(next);
        page.seen(next);
        view.update(next);
      },
      lost: (problem) => end(null, problem),
    });
    stop = () => {
      clearInterval(ticking);
      unfollow();
    };
  }

  /** @param {Status | null} status @param {Problem} [problem] reason if there is no status */
  function end(status, problem) {
    stop();
    stop = () => {};
    if (status) {
      fill(ended(status));
      announce(summary(status));
      setTitle(`${stateLabel(status.state)}: ${status.name}`);
    } else if (problem) fill(missing(problem));
    page.seen(status);
  }

  /** @param {Status} status */
  function ended(status) {
    if (status.state === "succeeded" && status.sizes)
      return [...resultView({ ...status, sizes: status.sizes }, page.keyed), another()];
    const retry = status.state === "cancelled" || status.state === "expired" || status.problem?.retryable;
    return [
      el("p", { class: `kicker ${status.state === "failed" ? "bad" : ""}` }, stateLabel(status.state)),
      el("h1", { id: "job-title", tabindex: "-1" }, status.name),
      el("p", { class: "muted" }, jobLabel(status)),
      status.problem ? problemBox(status.problem) : el("p", {}, reason(status)),
      el(
        "div",
        { class: "buttons" },
        retry
          ? el("button", { class: "primary", type: "button", onclick: () => page.again(status) }, "Try again")
          : null,
        el("a", { class: `button ${retry ? "quiet" : "primary"}`, href: "#" }, "Another scene"),
      ),
    ];
  }

  function close() {
    stop();
    stop = () => {};
    shown = "";
    card.hidden = true;
    card.replaceChildren();
    setTitle();
  }

  /** @param {string} id @param {boolean} focus whether the user has requested it */
  async function open(id, focus) {
    close();
    shown = id;
    try {
      const status = await statusOf(id);
      if (shown !== id) return; // another job was opened meanwhile
      card.hidden = false;
      if (active(status)) return watch(status, focus);
      fill(ended(status), focus);
      setTitle(`${stateLabel(status.state)}: ${status.name}`);
    } catch (error) {
      if (shown !== id || (error instanceof Problem && error.code === "unauthorized")) return;
      card.hidden = false;
      const final = error instanceof Problem && error.final;
      fill(missing(error, final ? undefined : () => open(id, true)), focus);
    }
  }

  return { open, close, shown: () => shown };
}

const another = () => el("p", { class: "another" }, el("a", { class: "button quiet", href: "#" }, "Another scene"));

/** @param {unknown} error @param {() => void} [retry] */
function missing(error, retry) {
  return [
    el("h1", { id: "job-title", tabindex: "-1" }, "This job cannot be shown"),
    problemBox(explain(error)),
    el(
      "div",
      { class: "buttons" },
      retry ? el("button", { class: "primary", type: "button", onclick: retry }, "Try again") : null,
      el("a", { class: "button quiet", href: "#" }, "Another scene"),
    ),
  ];
}

/** @param {Status} status */
function reason(status) {
  if (status.state === "cancelled") return "The job was cancelled before it ended.";
  const gone = "The job has expired, and its files were removed.";
  return status.sizes ? `${gone} The container was ${short(status.sizes.ratio)} times smaller than the upload.` : gone;
}

/** @param {Status} status */
function summary(status) {
  const gain = status.sizes ? `, ${short(status.sizes.ratio)} times smaller` : "";
  return `${status.name}: ${stateLabel(status.state)}${gain}.`;
}
