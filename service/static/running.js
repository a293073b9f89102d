/** The view of a queued or running job: a bar over the whole job, the time left, and its stages, folded away. */

import { announce, el, setTitle } from "./dom.js";
import { clock, percent, roughly } from "./format.js";
import { jobLabel } from "./labels.js";
import { stageLabel } from "./stages.js";

/** @typedef {import("./api.js").Status} Status */

/**
 * Create the view of a job that has not ended.
 * @param {Status} first
 * @param {() => void} cancel
 */
export function runningView(first, cancel) {
  const [kicker, headline, amount] = [
    el("p", { class: "kicker" }),
    el("span", { class: "stage" }),
    el("span", { class: "stage" }),
  ];
  const bar = el("progress", { max: 1, "aria-label": "Progress" });
  const [elapsed, left] = [el("span"), el("span")];
  const note = el("p", { class: "note small muted" }); // not announced: it changes often
  const steps = el("ol", { class: "steps", "aria-label": "Stages" });
  const summary = el("summary", {}, "Starting");
  const stages = el("details", { class: "small" }, summary, steps, note);
  const notice = el("p", { class: "small muted", hidden: true }, "The connection was lost; reconnecting…");
  const button = el("button", { class: "quiet", type: "button", onclick: press }, "Cancel job");
  const children = [
    kicker,
    el("h1", { id: "job-title", tabindex: "-1" }, first.name),
    el("p", { class: "muted" }, jobLabel(first)),
    el("p", { class: "spread" }, headline, amount),
    bar,
    el("p", { class: "spread muted" }, elapsed, left),
    stages,
    notice,
    el("div", { class: "buttons" }, button),
  ];
  let [status, seen, fraction] = [first, performance.now(), 0];
  /** @type {string[]} names of the stages so far */
  let passed = [];

  function press() {
    button.disabled = true;
    button.textContent = "Cancelling…";
    cancel();
  }

  /** @param {string} text */
  function setHeadline(text) {
    if (text && headline.textContent !== text) announce(`${first.name}: ${text}.`);
    headline.textContent = text;
  }

  /** @param {Status} next */
  function update(next) {
    [status, seen] = [next, performance.now()];
    const queued = next.state === "queued";
    kicker.textContent = queued ? "Queued" : "Compressing";
    stages.hidden = queued;
    if (queued) {
      restarted();
      setHeadline(next.position === 1 ? "Next in the queue" : `Number ${next.position ?? "?"} in the queue`);
    } else setHeadline("");
    tick();
  }

  /** @param {import("./api.js").Progress} now */
  function progress(now) {
    const name = stageLabel(now.stage);
    summary.textContent = name;
    if (!passed.includes(name)) {
      passed.push(name);
      announce(`${first.name}: ${name}.`);
    }
    steps.replaceChildren(
      ...passed.map((each) =>
        el("li", { class: each === name ? "now" : "past", "aria-current": each === name ? "step" : null }, each),
      ),
    );
    note.textContent = now.note ?? "";
    if (now.seconds_left !== undefined) {
      status = {
        ...status,
        timings: { ...status.timings, run_seconds: ranFor() },
        estimate: { seconds_left: now.seconds_left },
      };
      seen = performance.now();
    }
    showFraction(Math.max(fraction, now.fraction));
    tick();
  }

  /**
   * Show the completed fraction of the job; before its start, the bar is indeterminate.
   * @param {number} now
   */
  function showFraction(now) {
    fraction = now;
    if (now > 0) bar.value = now;
    else bar.removeAttribute("value");
    amount.textContent = now > 0 ? percent(now) : "";
    setTitle(`${now > 0 ? percent(now) : "…"} ${first.name}`);
  }

  const since = () => (performance.now() - seen) / 1000;
  const ranFor = () => status.timings.run_seconds && status.timings.run_seconds + since();

  function tick() {
    const [ran, seconds] = [ranFor(), status.estimate && status.estimate.seconds_left - since()];
    elapsed.textContent = ran === undefined ? "" : `${clock(ran)} elapsed`;
    if (seconds === undefined) left.textContent = "";
    else left.textContent = seconds > 0 ? `${roughly(seconds)} left` : "longer than expected";
  }

  function restarted() {
    passed = [];
    summary.textContent = "Starting";
    steps.replaceChildren();
    note.textContent = "";
    showFraction(0);
  }

  restarted();
  update(first);
  return {
    children,
    update,
    progress,
    tick,
    restarted,
    /** @param {boolean} connected */
    connection: (connected) => (notice.hidden = connected),
    /** Enable the cancel button again after a failed cancellation. */
    release() {
      button.disabled = false;
      button.textContent = "Cancel job";
    },
  };
}
