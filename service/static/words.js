/** What the service's own names mean to people. What is not in here is shown as it is. */

import { count } from "./format.js";

/** @typedef {import("./api.js").Status} Status */

/** @type {Record<string, string>} */
const STATES = {
  queued: "waiting",
  running: "running",
  succeeded: "done",
  failed: "failed",
  cancelled: "cancelled",
  expired: "expired",
};

/** In their order: a job passes through them from first to last. @type {Record<string, string>} */
const STAGES = {
  read: "Reading the scene",
  kernels: "Preparing",
  cameras: "Placing cameras",
  score: "Scoring Gaussians",
  judge: "Judging what it has come to",
  targets: "Taking pictures to learn from",
  sparsify: "Training while Gaussians go",
  refine: "Training those that stay",
  sensitivity: "Seeing what matters",
  rate_distortion: "Weighing bits against errors",
  order: "Putting Gaussians in order",
  forms: "Choosing forms",
  codebook: "Building the codebook",
  "sort codebook": "Sorting the codebook",
  rounding: "Rounding by price",
  refit: "Refitting colours",
  finetune: "Fine-tuning",
  images: "Compressing images",
  write: "Writing the container",
  evaluate: "Measuring quality",
};

const ALWAYS = ["read", "kernels", "order", "forms", "images"];
const WEIGHED = ["cameras", "sensitivity", "rate_distortion", "rounding"];
const COMPACTED = ["cameras", "score"];
const WITH_COLOURS_BY_ANGLE = ["codebook", "sort codebook"];

/** @type {[RegExp, string][]} */
const PLANES = [
  [/^means_bytes_0\b/, "Positions, low bytes"],
  [/^means_bytes_1\b/, "Positions, high bytes"],
  [/^quaternions\b/, "Rotations"],
  [/^scales\b/, "Sizes"],
  [/^f_dc\b/, "Colours"],
  [/^opacities\b/, "Opacity"],
  [/^f_rest_centroids\b/, "SH codebook"],
  [/^f_rest_labels\b/, "SH labels"],
  [/^active_mask\b/, "Mask"],
  [/\.(json|ya?ml)$/, "Metadata"],
];

/** @type {Record<string, string>} */
const CLEANED = {
  non_finite: "removed: not a number, or infinite",
  far_away: "removed: too far away to be placed",
  infinite_opacities: "infinite opacities made finite",
  saturated_opacities: "opacities limited to what pictures can show",
  zero_quats: "rotations of zero length replaced",
  unnormalised_quats: "rotations brought to unit length",
  clamped_scales: "extreme sizes limited",
  clamped_sh: "extreme colours limited",
};

/** @param {string} state */
export const stateWord = (state) => STATES[state] ?? state;

/** @param {string} stage */
export const stageWord = (stage) => STAGES[stage] ?? stage;

/**
 * The stages that a job will pass through, as far as that is known before.
 * @param {Status} status
 */
export function plannedStages(status) {
  const planned = new Set(ALWAYS);
  if (status.options.encode.rate_distortion) WEIGHED.forEach((stage) => planned.add(stage));
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
  if (status.sh_degree > 0) WITH_COLOURS_BY_ANGLE.forEach((stage) => planned.add(stage));
  if (status.options.evaluate) planned.add("evaluate");
  return Object.keys(STAGES).filter((stage) => planned.has(stage));
}

/**
 * Bytes of each plane of a container, largest first; files of one meaning are added up.
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
 * What was wrong with an upload and has been mended, in words; empty if nothing was.
 * @param {Status} status
 */
export function mended(status) {
  const counts = Object.entries(status.cleaned ?? {});
  const lines = counts.filter(([, n]) => n > 0).map(([name, n]) => `${count(n)} ${CLEANED[name] ?? name}`);
  if (status.compacted) lines.unshift(`${count(status.compacted)} left out by compaction: others do their work`);
  if (status.invisible) lines.unshift(`${count(status.invisible)} left out: no renderer would draw them`);
  return lines;
}
