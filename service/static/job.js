/** The card of one job, from its place in the queue to its end. */

import { Problem, active, cancel, status as statusOf } from "./api.js";
import { announce, byId, el, entitle } from "./dom.js";
import { follow } from "./follow.js";
import { count, short } from "./format.js";
import { resultView } from "./result.js";
import { runningView } from "./running.js";
import { explain, problemBox } from "./trouble.js";
import { stateWord } from "./words.js";

/** @typedef {import("./api.js").Status} Status */

/**
 * Shows one job at a time.
 * @param {{keyed: boolean, seen: (status: Status | null) => void, again: (status: Status) => void}} page
 *   seen is told every status that arrives, null for a job that is lost; again is called when a scene shall be submitted
 *   once more
 */
export function jobCard(page) {
  const card = byId("job");
  let stop = () => {};
  let shown = ""; // the id

  /** @param {(Node | string)[]} children @param {boolean} [focus] */
  function fill(children, focus = false) {
    const keeps = focus || card.contains(document.activeElement); // what had the focus goes: keep it in the card
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

  /** @param {Status | null} status @param {Problem} [problem] why there is none */
  function end(status, problem) {
    stop();
    stop = () => {};
    if (status) {
      fill(ended(status));
      announce(summary(status));
      entitle(`${stateWord(status.state)}: ${status.name}`);
    } else if (problem) fill(missing(problem));
    page.seen(status);
  }

  /** @param {Status} status */
  function ended(status) {
    if (status.state === "succeeded" && status.sizes)
      return [...resultView({ ...status, sizes: status.sizes }, page.keyed), another()];
    const retry = status.state === "cancelled" || status.state === "expired" || status.problem?.retryable;
    return [
      el("p", { class: `kicker ${status.state === "failed" ? "bad" : ""}` }, stateWord(status.state)),
      el("h1", { id: "job-title", tabindex: "-1" }, status.name),
      el("p", { class: "muted" }, `${count(status.gaussians)} Gaussians · ${status.options.preset} preset`),
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
    entitle();
  }

  /** @param {string} id @param {boolean} focus whether somebody asked for it just now */
  async function open(id, focus) {
    close();
    shown = id;
    try {
      const status = await statusOf(id);
      if (shown !== id) return; // another was opened while this one was on its way
      card.hidden = false;
      if (active(status)) return watch(status, focus);
      fill(ended(status), focus);
      entitle(`${stateWord(status.state)}: ${status.name}`);
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
  if (status.state === "cancelled") return "It was cancelled before it was done.";
  const gone = "Its time is over, and its files were removed.";
  return status.sizes ? `${gone} The container was ${short(status.sizes.ratio)} times smaller than the upload.` : gone;
}

/** @param {Status} status */
function summary(status) {
  const gain = status.sizes ? `, ${short(status.sizes.ratio)} times smaller` : "";
  return `${status.name}: ${stateWord(status.state)}${gain}.`;
}
