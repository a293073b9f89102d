/** The view of a queued or running job: stage, progress and time estimate. */

import { announce, el, setTitle } from "./dom.js";
import { clock, percent, roughly } from "./format.js";
import { jobLabel } from "./labels.js";
import { plannedStages, stageLabel } from "./stages.js";

/** @typedef {import("./api.js").Status} Status */

/**
 * Create the view of a job that has not ended.
 * @param {Status} first
 * @param {boolean} training whether the server can train
 * @param {() => void} cancel
 */
export function runningView(first, training, cancel) {
  const kicker = el("p", { class: "kicker" });
  const [headline, amount] = [el("span", { class: "stage" }), el("span", { class: "stage" })];
  const bar = el("progress", { max: 1, "aria-label": "Progress of this stage" });
  const [elapsed, left] = [el("span"), el("span")];
  const note = el("p", { class: "note small muted", hidden: true }); // not announced: it changes often
  const notice = el("p", { class: "small muted", hidden: true }, "The connection was lost; reconnecting…");
  const button = el("button", { class: "quiet", type: "button", onclick: press }, "Cancel job");
  const steps = stepList(plannedStages(first, training));
  const children = [
    kicker,
    el("h1", { id: "job-title", tabindex: "-1" }, first.name),
    el("p", { class: "muted" }, jobLabel(first)),
    el("p", { class: "spread" }, headline, amount),
    bar,
    el("p", { class: "spread muted" }, elapsed, left),
    note,
    steps.element,
    notice,
    el("div", { class: "buttons" }, button),
  ];
  let [status, seen, stage] = [first, performance.now(), ""];

  function press() {
    button.disabled = true;
    button.textContent = "Cancelling…";
    cancel();
  }

  /** @param {string} text */
  function setHeadline(text) {
    if (headline.textContent === text) return;
    headline.textContent = text;
    announce(`${first.name}: ${text}.`);
  }

  /** @param {Status} next */
  function update(next) {
    [status, seen] = [next, performance.now()];
    const queued = next.state === "queued";
    kicker.textContent = queued ? "Queued" : "Compressing";
    steps.element.hidden = queued;
    if (queued) {
      stage = "";
      setHeadline(next.position === 1 ? "Next in the queue" : `Number ${next.position ?? "?"} in the queue`);
      note.hidden = true;
      showFraction(0);
    } else if (!stage) setHeadline("Starting");
    tick();
  }

  /** @param {import("./api.js").Progress} now */
  function progress(now) {
    if (now.stage !== stage) {
      stage = now.stage;
      steps.at(stage);
      setHeadline(stageLabel(stage));
      note.hidden = true;
    }
    showFraction(now.fraction);
    note.textContent = now.note ?? "";
    if (now.note) note.hidden = false; // stays visible for the whole stage, so that the layout is stable
  }

  /**
   * Show the completed fraction; many stages report only 0 or 1, and then the bar is indeterminate.
   * @param {number} fraction
   */
  function showFraction(fraction) {
    const known = fraction > 0 && fraction < 1;
    if (known) bar.value = fraction;
    else bar.removeAttribute("value");
    amount.textContent = known ? percent(fraction) : "";
    setTitle(`${known ? percent(fraction) : "…"} ${first.name}`);
  }

  function tick() {
    const since = (performance.now() - seen) / 1000;
    elapsed.textContent =
      status.timings.run_seconds === undefined ? "" : `${clock(status.timings.run_seconds + since)} elapsed`;
    const seconds = status.estimate ? Math.max(1, status.estimate.seconds_left - since) : null;
    left.textContent = seconds === null ? "" : `${roughly(seconds)} left`;
  }

  update(first);
  return {
    children,
    update,
    progress,
    tick,
    restarted() {
      stage = "";
      steps.at("");
      note.hidden = true;
    },
    /** @param {boolean} connected */
    connection: (connected) => (notice.hidden = connected),
    /** Enable the cancel button again after a failed cancellation. */
    release() {
      button.disabled = false;
      button.textContent = "Cancel job";
    },
  };
}

/**
 * Create the list of past, present and future stages.
 * @param {string[]} planned
 */
function stepList(planned) {
  const element = el("ol", { class: "steps", "aria-label": "Stages" });
  /** @type {string[]} */
  let passed = [];

  /** @param {string} now empty before the first stage */
  function at(now) {
    if (!now) passed = [];
    else if (!passed.includes(now)) passed.push(now);
    const ahead = planned.slice(1 + Math.max(...planned.map((name, at) => (passed.includes(name) ? at : -1))));
    const items = [...passed, ...ahead.filter((name) => !passed.includes(name))].map((name) => {
      const here = name === now;
      const kind = here ? "now" : passed.includes(name) ? "past" : "later";
      return el("li", { class: kind, "aria-current": here ? "step" : null }, stageLabel(name));
    });
    element.replaceChildren(...items);
  }

  at("");
  return { element, at };
}
