/** What is wanted of the container: what the preset gives, a size, or a loss of quality. */

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
    note: "The best container of that size, found by making a few.",
  },
  max_psnr_drop: {
    unit: "dB",
    factor: 1,
    usual: 0.1,
    step: 0.05,
    most: 20,
    note: "The smallest container whose pictures lose no more: told as if the scene were 30 dB from photographs.",
  },
};

/**
 * Bring the field to life.
 * @param {import("./api.js").Presets} presets
 * @param {() => string} preset the chosen one's name
 */
export function goalField(presets, preset) {
  const [goal, amount] = [/** @type {HTMLSelectElement} */ (byId("goal")), byId("amount")];
  const weighs = () => presets.presets.find(({ name }) => name === preset())?.settings.encode.rate_distortion ?? false;
  const named = () => GOALS[goal.value];

  function refresh() {
    goal.disabled = !weighs();
    if (goal.disabled) goal.value = "";
    const chosen = named();
    byId("goal-amount").hidden = amount.disabled = !chosen;
    byId("goal-note").textContent = chosen?.note ?? (goal.disabled ? "This preset seeks none." : "");
    const [auto, keep] = [byId("keep-auto"), /** @type {HTMLSelectElement} */ (byId("keep"))];
    auto.disabled = !chosen;
    if (auto.disabled && keep.value === "auto") keep.value = "";
  }

  /** @param {number} value in the unit of the field */
  function fill(value) {
    const { unit, step, most } = named();
    Object.assign(amount, { value: String(value), step: "any", min: String(step / 100), max: String(most) });
    byId("unit").textContent = unit;
  }

  goal.addEventListener("change", () => {
    if (named()) fill(named().usual);
    refresh();
  });
  byId("preset-list").addEventListener("change", refresh);
  refresh();
  return {
    /** @returns {Goals | null} */
    chosen() {
      if (!named()) return null;
      const value = Number((Number(amount.value) * named().factor).toPrecision(12));
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
