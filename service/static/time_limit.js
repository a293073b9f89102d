/** The choice of a time limit. */

import { byId, selectOption } from "./dom.js";
import { duration } from "./format.js";

const CHOICES = [30, 60, 120, 300, 600, 1800]; // seconds

const BUDGET = "Possible only if all Gaussians are kept, or as many as the goal needs.";
const UNCOUNTED = "It does not limit the search for the number of Gaussians.";
const MEETS = "The search ends in this time, but not before the goal is met.";
const TUNES = "Fine-tuning takes as many steps as fit in.";
const FITS = "If the preset takes longer, Fast is used.";
const FILLS = `Time that is left is used for fine-tuning. ${FITS}`;
const PHOTOGRAPHS = "The smallest container found in this time that loses at most 0.1 dB against the photographs.";
const UNUSED = "No effect on Fast without fine-tuning.";

/**
 * @typedef {object} Chosen
 * @property {string} preset
 * @property {boolean} plans whether the preset has rate–distortion planning
 * @property {boolean} captured whether there are photographs
 * @property {boolean} goal whether there is a goal
 * @property {boolean} tunes whether fine-tuning is requested
 * @property {import("./api.js").Budget | null} kept
 */

/**
 * Connect the choice of the form.
 * @param {import("./api.js").Limits} limits
 */
export function timeField(limits) {
  const field = /** @type {HTMLSelectElement} */ (byId("time"));
  for (const seconds of CHOICES)
    if (seconds < limits.job_seconds) field.add(new Option(duration(seconds), String(seconds)));

  /** Return what the time is used for. @param {Chosen} chosen */
  function use({ preset, plans, captured, goal, tunes, kept }) {
    if (kept && !tunes) return UNCOUNTED;
    if (goal) return MEETS;
    if (captured && plans && limits.training) return PHOTOGRAPHS;
    if (tunes) return TUNES;
    if (preset === "fast") return UNUSED;
    return plans && limits.training ? FILLS : FITS;
  }

  return {
    /** @returns {number | null} seconds */
    chosen: () => (field.value ? Number(field.value) : null),
    /** @param {Chosen} chosen */
    refresh(chosen) {
      field.disabled = chosen.kept !== null && !chosen.kept.auto_count;
      if (field.disabled) field.value = "";
      byId("time-note").textContent = field.disabled ? BUDGET : field.value ? use(chosen) : "";
    },
    /** Set the limit of an earlier job. @param {number | null} [seconds] */
    prefer: (seconds = null) => selectOption(field, String(seconds ?? ""), duration(seconds ?? 0)),
  };
}
