/** How many Gaussians are kept: all, a share, as many as the goal needs, or the budget of an earlier job. */

import { byId, selectOption } from "./dom.js";
import { budgetLabel, budgetOf } from "./labels.js";
import { capitalised } from "./format.js";

const AUTO = JSON.stringify({ auto_count: true });
const LIMITED = "With a time limit, all are kept, or as many as the goal needs.";

/**
 * Connect the choice of the form; the values of its options are budgets as JSON.
 * @param {boolean} training whether the server can train
 */
export function keepField(training) {
  const keep = /** @type {HTMLSelectElement} */ (byId("keep"));
  const usual = training
    ? "The remaining Gaussians are trained to preserve the images: a smaller file after a few minutes of training."
    : "This server has no torch: choose Fast, which merges neighbours instead of training, at a greater loss of quality.";
  return {
    /** @returns {import("./api.js").Budget | null} */
    chosen: () => (keep.value ? JSON.parse(keep.value) : null),
    /** @param {boolean} goal whether there is one @param {boolean} limited whether time is limited */
    refresh(goal, limited) {
      for (const option of keep.options)
        option.disabled = option.value === AUTO ? !goal : option.value !== "" && limited;
      if (keep.selectedOptions[0].disabled) keep.value = "";
      byId("keep-note").textContent = limited ? LIMITED : usual;
    },
    /** Set the budget of an earlier job. @param {import("./api.js").Budget} compact */
    prefer(compact) {
      const budget = budgetOf(compact);
      selectOption(keep, budget ? JSON.stringify(budget) : "", capitalised(budgetLabel(compact)));
    },
  };
}
