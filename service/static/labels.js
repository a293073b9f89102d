/** Labels for the service's names of states, stages, files and corrections; unknown names are shown unchanged. */

import { count } from "./format.js";
import { formatOf } from "./container_formats.js";

/** @typedef {import("./api.js").Status} Status */

/** @type {Record<string, string>} */
const STATES = {
  queued: "queued",
  running: "running",
  succeeded: "done",
  failed: "failed",
  cancelled: "cancelled",
  expired: "expired",
};

/** Labels of the stages, in the order of a job. @type {Record<string, string>} */
const STAGES = {
  read: "Reading the scene",
  kernels: "Preparing",
  cameras: "Placing cameras",
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
  refit: "Refitting base colours",
  finetune: "Fine-tuning",
  images: "Compressing images",
  write: "Writing the container",
  evaluate: "Measuring quality",
};

const ALWAYS = ["read", "kernels", "order", "forms", "images"];
const RATE_DISTORTION = ["cameras", "sensitivity", "rate_distortion", "rounding"];
const COMPACTED = ["cameras", "score"];
const WITH_SH_REST = ["codebook", "sort codebook"];

/** @type {[RegExp, string][]} */
const PLANES = [
  [/^means_(bytes_0|l)\b/, "Positions, low bytes"],
  [/^means_(bytes_1|u)\b/, "Positions, high bytes"],
  [/^quat(ernion)?s\b/, "Rotations"],
  [/^scales\b/, "Scales"],
  [/^f_dc\b/, "Base colours"],
  [/^sh0\b/, "Colours, opacities"],
  [/^opacities\b/, "Opacities"],
  [/^(f_rest|shN)_centroids\b/, "SH codebook"],
  [/^(f_rest|shN)_labels\b/, "SH labels"],
  [/^active_mask\b/, "Mask"],
  [/\.(json|ya?ml)$/, "Metadata"],
];

/** @type {Record<string, string>} */
const CLEANED = {
  non_finite: "removed: NaN or infinite values",
  far_away: "removed: too far from the origin",
  infinite_opacities: "infinite opacities made finite",
  saturated_opacities: "opacities limited to the range that images can show",
  zero_quats: "rotations of zero length replaced",
  unnormalised_quats: "rotations normalised",
  clamped_scales: "extreme scales limited",
  clamped_sh: "extreme SH coefficients limited",
};

/** @param {string} state */
export const stateLabel = (state) => STATES[state] ?? state;

/** Describe what a job was given. @param {Status} status */
export const jobLabel = (status) =>
  `${count(status.gaussians)} Gaussians · ${status.options.preset} preset · ${formatOf(status).title}`;

/** @param {string} stage */
export const stageLabel = (stage) => STAGES[stage] ?? stage;

/**
 * Return the expected stages of a job.
 * @param {Status} status
 */
export function plannedStages(status) {
  const planned = new Set(ALWAYS);
  if (status.options.encode.rate_distortion) RATE_DISTORTION.forEach((stage) => planned.add(stage));
  const {
    count: wanted,
    ratio,
    max_psnr_drop: drop,
    auto_count,
    sparsify_steps,
    refine_steps,
  } = status.options.compact;
  if (wanted !== null || ratio !== null || drop !== null || auto_count) {
    COMPACTED.forEach((stage) => planned.add(stage));
    if (sparsify_steps + refine_steps > 0) planned.add("targets");
    if (sparsify_steps > 0) planned.add("sparsify");
    if (refine_steps > 0) planned.add("refine");
  }
  if (status.options.finetune.enabled) ["cameras", "targets", "finetune"].forEach((stage) => planned.add(stage));
  if (status.sh_degree > 0) WITH_SH_REST.forEach((stage) => planned.add(stage));
  if (status.options.evaluate) planned.add("evaluate");
  return Object.keys(STAGES).filter((stage) => planned.has(stage));
}

/**
 * Return the bytes of each part of a container, largest first; files with one label are added up.
 * @param {Record<string, number>} files
 * @returns {[string, number][]}
 */
export function planes(files) {
  /** @type {Map<string, number>} */
  const sums = new Map();
  for (const [file, size] of Object.entries(files)) {
    const name = PLANES.find(([pattern]) => pattern.test(file))?.[1] ?? file;
    sums.set(name, (sums.get(name) ?? 0) + size);
  }
  return [...sums].sort(([, a], [, b]) => b - a);
}

/**
 * Describe what cleaning, compaction and pruning have changed; empty if nothing.
 * @param {Status} status
 */
export function cleaningNotes(status) {
  const counts = Object.entries(status.cleaned ?? {});
  const lines = counts.filter(([, n]) => n > 0).map(([name, n]) => `${count(n)} ${CLEANED[name] ?? name}`);
  if (status.compacted) lines.unshift(`${count(status.compacted)} pruned by compaction`);
  if (status.invisible) lines.unshift(`${count(status.invisible)} pruned because they are invisible`);
  return lines;
}
