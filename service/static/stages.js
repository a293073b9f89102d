/** The stages of a job: their labels, and which are expected. */

import { budgetOf, goalsOf } from "./labels.js";

/**
 * @typedef {import("./api.js").Status} Status
 * @typedef {import("./api.js").JobOptions} JobOptions
 */

/** Labels of the service's names. @type {Record<string, string>} */
const STAGES = {
  read: "Reading the scene",
  kernels: "Preparing",
  cameras: "Placing cameras",
  merge: "Merging Gaussians",
  score: "Scoring Gaussians",
  targets: "Rendering training targets",
  sparsify: "Training with sparsification",
  refine: "Refining the remaining Gaussians",
  sensitivity: "Measuring sensitivity",
  rate_distortion: "Rate–distortion planning",
  order: "Ordering Gaussians",
  forms: "Choosing rotation forms",
  codebook: "Building the codebook",
  "sort codebook": "Sorting the codebook",
  rounding: "RDO quantisation",
  reorder: "Refining the order",
  refit: "Refitting base colours",
  finetune: "Fine-tuning",
  images: "Compressing images",
  write: "Writing the container",
  evaluate: "Measuring quality",
};

/** @param {string} stage unknown ones are shown unchanged */
export const stageLabel = (stage) => STAGES[stage] ?? stage;

/**
 * Return the expected stages of a job, in the order in which they begin.
 * @param {Pick<Status, "options" | "gaussians" | "sh_degree">} job
 * @param {boolean} training whether the server can train
 */
export function plannedStages({ options, gaussians, sh_degree }, training) {
  const { compact, encode, finetune, time_limit } = options;
  const goals = Object.keys(goalsOf(encode));
  const tunes = finetune.enabled ?? (training && Boolean(time_limit)); // null: if there is time
  return [
    ...new Set([
      "read",
      ...compactionStages(compact, gaussians),
      ...when(compact.auto_count, "cameras"),
      ...encodingStages(encode, sh_degree > 0, tunes && !goals.length),
      ...when(compact.auto_count, "evaluate", "score"),
      ...when(
        goals.some((name) => name !== "target_size"),
        "evaluate",
      ),
      ...when(tunes && goals.length, "targets", "finetune"),
      ...when(options.evaluate, "evaluate"),
    ]),
  ];
}

/**
 * @param {JobOptions["compact"]} compact
 * @param {number} gaussians number in the upload
 */
function compactionStages(compact, gaussians) {
  const { method, count, max_psnr_drop: drop, sparsify_steps: sparsify, refine_steps: refine } = compact;
  if (!budgetOf(compact) || compact.auto_count || (count && count >= gaussians)) return [];
  if (method === "merge") return [...when(drop, "cameras"), "kernels", "merge", ...when(drop, "evaluate")];
  return [
    "cameras",
    ...when(sparsify + refine > 0, "targets"),
    "kernels",
    "score",
    ...when(sparsify > 0, "sparsify"),
    ...when(refine > 0, "refine"),
    ...when(drop, "evaluate"),
  ];
}

/**
 * @param {JobOptions["encode"]} encode
 * @param {boolean} sh whether there are SH coefficients above degree 0
 * @param {boolean} tunes whether fine-tuning follows
 */
function encodingStages({ rate_distortion: plans, order }, sh, tunes) {
  const targets = when(tunes, "cameras", "targets");
  return [
    ...(plans ? ["kernels", "cameras", "sensitivity", ...targets, "rate_distortion"] : [...targets, "kernels"]),
    "order",
    "forms",
    ...when(sh, "codebook", "sort codebook"),
    ...when(plans, "rounding"),
    ...when(order === "refined", "reorder"),
    ...when(tunes, "finetune"),
    "images",
  ];
}

/** @param {unknown} condition @param {...string} stages */
const when = (condition, ...stages) => (condition ? stages : []);
