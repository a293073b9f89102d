/** The goal of a compression: none, a quality, a maximum size or PSNR loss, or the goals of an earlier job. */

import { byId } from "./dom.js";
import { goalLabels, goalsOf } from "./labels.js";
import { capitalised } from "./format.js";

/** @typedef {import("./api.js").Goals} Goals */

/** @type {Record<string, {unit: string, factor: number, usual: number, step: number, most: number, note: string}>} */
const GOALS = {
  target_size: {
    unit: "MB",
    factor: 1e6,
    usual: 3,
    step: 0.1,
    most: 1e5,
    note: "The best container of at most this size, found by a search.",
  },
  max_psnr_drop: {
    unit: "dB",
    factor: 1,
    usual: 0.1,
    step: 0.05,
    most: 20,
    note: "The smallest container whose renderings lose at most this, assuming that the scene has 30 dB against photographs.",
  },
};
const PHOTOGRAPHED = "The smallest container that loses at most this against held-out photographs.";

/** Connect the controls of the goal. */
export function goalField() {
  const [goal, amount] = [/** @type {HTMLSelectElement} */ (byId("goal")), byId("amount")];
  const earlier = new Option("As in the earlier job"); // only in the list if the other controls cannot express its goals
  const selected = () => GOALS[goal.value];

  /** @param {boolean} supported whether the preset supports goals @param {boolean} captured by photographs */
  function refresh(supported, captured) {
    goal.disabled = !supported;
    if (goal.disabled) goal.value = "";
    byId("goal-amount").hidden = amount.disabled = !selected();
    byId("goal-note").textContent = supported ? note(captured) : "This preset does not support goals.";
  }

  /** @param {boolean} captured */
  function note(captured) {
    if (captured && goal.value === "max_psnr_drop") return PHOTOGRAPHED;
    if (selected() || !goal.value) return selected()?.note ?? "";
    return `${capitalised(goalLabels(JSON.parse(goal.value)).join(", "))}: the smallest container that meets this.`;
  }

  /** @param {number} value in the displayed unit */
  function fill(value) {
    const { unit, step, most } = selected();
    Object.assign(amount, { value: String(value), step: "any", min: String(step / 100), max: String(most) });
    byId("unit").textContent = unit;
  }

  goal.addEventListener("change", () => selected() && fill(selected().usual));
  return {
    refresh,
    /** @returns {Goals | null} */
    chosen() {
      if (!selected()) return goal.value ? JSON.parse(goal.value) : null;
      const value = Number((Number(amount.value) * selected().factor).toPrecision(12));
      return { [goal.value]: goal.value === "target_size" ? Math.floor(value) : value };
    },
    /**
     * Set the goals of an earlier job.
     * @param {Goals} encode
     */
    prefer(encode) {
      const goals = goalsOf(encode);
      earlier.remove();
      const [name = "", ...others] = Object.keys(goals);
      if (name && (others.length > 0 || !GOALS[name])) {
        earlier.value = JSON.stringify(goals);
        goal.value = earlier.value; // of an option of the list, such as a quality
        if (!goal.value) goal.add(earlier);
        goal.value = earlier.value;
      } else {
        goal.value = name;
        if (name) fill(goals[name] / GOALS[name].factor);
      }
    },
  };
}
