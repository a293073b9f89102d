/** A job that waits or runs: where it is, and how long it will take. */

import { announce, el, entitle } from "./dom.js";
import { clock, count, percent, roughly } from "./format.js";
import { plannedStages, stageWord } from "./words.js";

/** @typedef {import("./api.js").Status} Status */

/**
 * The view of one job on its way.
 * @param {Status} first
 * @param {() => void} cancel
 */
export function runningView(first, cancel) {
  const kicker = el("p", { class: "kicker" });
  const [headline, amount] = [el("span", { class: "stage" }), el("span", { class: "stage" })];
  const bar = el("progress", { max: 1, "aria-label": "Of this stage" });
  const [elapsed, left] = [el("span"), el("span")];
  const note = el("p", { class: "note small muted", hidden: true }); // not read out: it changes all the time
  const notice = el("p", { class: "small muted", hidden: true }, "The connection was lost; connecting again…");
  const button = el("button", { class: "quiet", type: "button", onclick: press }, "Cancel job");
  const steps = stepList(first);
  const children = [
    kicker,
    el("h1", { id: "job-title", tabindex: "-1" }, first.name),
    el("p", { class: "muted" }, `${count(first.gaussians)} Gaussians · ${first.options.preset} preset`),
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
  function headlineIs(text) {
    if (headline.textContent === text) return;
    headline.textContent = text;
    announce(`${first.name}: ${text}.`);
  }

  /** @param {Status} next */
  function update(next) {
    [status, seen] = [next, performance.now()];
    const queued = next.state === "queued";
    kicker.textContent = queued ? "Waiting" : "Compressing";
    steps.element.hidden = queued;
    if (queued) {
      stage = "";
      headlineIs(next.position === 1 ? "Next in the queue" : `Number ${next.position ?? "?"} in the queue`);
      note.hidden = true;
      measure(0);
    } else if (!stage) headlineIs("Starting");
    tick();
  }

  /** @param {import("./api.js").Progress} now */
  function progress(now) {
    if (now.stage !== stage) {
      stage = now.stage;
      steps.at(stage);
      headlineIs(stageWord(stage));
      note.hidden = true;
    }
    measure(now.fraction);
    note.textContent = now.note ?? "";
    if (now.note) note.hidden = false; // for the whole stage, so that nothing jumps while it has nothing to say
  }

  /**
   * Many stages do not tell how far they are, or go on after all that they count: then the bar says only that they do.
   * @param {number} fraction
   */
  function measure(fraction) {
    const known = fraction > 0 && fraction < 1;
    if (known) bar.value = fraction;
    else bar.removeAttribute("value");
    amount.textContent = known ? percent(fraction) : "";
    entitle(`${known ? percent(fraction) : "…"} ${first.name}`);
  }

  function tick() {
    const since = (performance.now() - seen) / 1000;
    elapsed.textContent =
      status.timings.run_seconds === undefined ? "" : `${clock(status.timings.run_seconds + since)} elapsed`;
    const guess = status.estimate ? Math.max(1, status.estimate.seconds_left - since) : null;
    left.textContent = guess === null ? "" : `${roughly(guess)} left`;
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
    /** It could not be cancelled: let it be tried again. */
    release() {
      button.disabled = false;
      button.textContent = "Cancel job";
    },
  };
}

/**
 * The stages: those behind, this one, and those that will come.
 * @param {Status} status
 */
function stepList(status) {
  const planned = plannedStages(status);
  const element = el("ol", { class: "steps", "aria-label": "Stages" });
  /** @type {string[]} */
  let passed = [];

  /** @param {string} now empty before the first */
  function at(now) {
    if (!now) passed = [];
    else if (!passed.includes(now)) passed.push(now);
    const ahead = planned.slice(1 + Math.max(...planned.map((name, at) => (passed.includes(name) ? at : -1))));
    const items = [...passed, ...ahead.filter((name) => !passed.includes(name))].map((name) => {
      const here = name === now;
      const kind = here ? "now" : passed.includes(name) ? "past" : "later";
      return el("li", { class: kind, "aria-current": here ? "step" : null }, stageWord(name));
    });
    element.replaceChildren(...items);
  }

  at("");
  return { element, at };
}
