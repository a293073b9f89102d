/** The goal of a compression: none, a maximum size, or a maximum PSNR loss. */

import { byId } from "./dom.js";

/** @typedef {{target_size?: number | null, max_psnr_drop?: number | null}} Goals */

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

/**
 * Connect the controls of the goal.
 * @param {import("./api.js").Presets} presets
 * @param {() => string} preset returns the name of the chosen preset
 */
export function goalField(presets, preset) {
  const [goal, amount] = [/** @type {HTMLSelectElement} */ (byId("goal")), byId("amount")];
  const hasGoals = () =>
    presets.presets.find(({ name }) => name === preset())?.settings.encode.rate_distortion ?? false;
  const selected = () => GOALS[goal.value];

  function refresh() {
    goal.disabled = !hasGoals();
    if (goal.disabled) goal.value = "";
    const chosen = selected();
    byId("goal-amount").hidden = amount.disabled = !chosen;
    byId("goal-note").textContent = chosen?.note ?? (goal.disabled ? "This preset does not support goals." : "");
    const [auto, keep] = [byId("keep-auto"), /** @type {HTMLSelectElement} */ (byId("keep"))];
    auto.disabled = !chosen;
    if (auto.disabled && keep.value === "auto") keep.value = "";
  }

  /** @param {number} value in the displayed unit */
  function fill(value) {
    const { unit, step, most } = selected();
    Object.assign(amount, { value: String(value), step: "any", min: String(step / 100), max: String(most) });
    byId("unit").textContent = unit;
  }

  goal.addEventListener("change", () => {
    if (selected()) fill(selected().usual);
    refresh();
  });
  byId("preset-list").addEventListener("change", refresh);
  refresh();
  return {
    /** @returns {Goals | null} */
    chosen() {
      if (!selected()) return null;
      const value = Number((Number(amount.value) * selected().factor).toPrecision(12));
      return { [goal.value]: goal.value === "target_size" ? Math.floor(value) : value };
    },
    /** @param {Goals} goals */
    prefer(goals) {
      const name = Object.keys(GOALS).find((key) => (goals[/** @type {keyof Goals} */ (key)] ?? null) !== null) ?? "";
      goal.value = name;
      if (name) fill(Number(goals[/** @type {keyof Goals} */ (name)]) / GOALS[name].factor);
      refresh();
    },
  };
}
