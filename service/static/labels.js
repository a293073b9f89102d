/** Labels for the service's names of states, goals, files and corrections; unknown names are shown unchanged. */

import { bytes, count, duration } from "./format.js";
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

/** Labels of goals of the encoder. @type {Record<string, (value: any) => string>} */
const GOALS = {
  quality: (/** @type {string} */ quality) => (quality === "same" ? "looks the same" : `${quality} quality`),
  target_size: (size) => `at most ${bytes(size)}`,
  max_psnr_drop: (drop) => `at most ${drop} dB PSNR loss`,
  max_ssim_drop: (drop) => `at most ${drop} SSIM loss`,
  psnr: (psnr) => `at least ${psnr} dB PSNR`,
};

/** Labels of budgets of Gaussians, other than the share of all of them. @type {Record<string, (value: any) => string>} */
const BUDGETS = {
  ratio: (/** @type {number} */ ratio) => `keep ${Number((100 * ratio).toPrecision(3))} %`,
  count: (/** @type {number} */ number) => `keep ${count(number)}`,
  max_psnr_drop: (/** @type {number} */ drop) => `keep as few as lose at most ${drop} dB PSNR`,
  auto_count: () => "keep as many as the goal needs",
};

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

/** @param {import("./api.js").Goals} encode */
export const goalLabels = (encode) =>
  Object.entries(given(encode, Object.keys(GOALS))).map(([name, value]) => GOALS[name](value));

/** Describe how many Gaussians are kept; nothing if all are. @param {import("./api.js").Budget} compact */
function budgetLabel(compact) {
  const [entry] = Object.entries(given(compact, Object.keys(BUDGETS)));
  return entry && !(entry[0] === "ratio" && entry[1] >= 1) ? BUDGETS[entry[0]](entry[1]) : "";
}

/**
 * @param {Record<string, any>} settings
 * @param {string[]} names
 */
const given = (settings, names) =>
  Object.fromEntries(names.map((name) => [name, settings[name]]).filter(([, value]) => value));

/** Describe what a job was given. @param {Status} status */
export function jobLabel({ gaussians, options }) {
  return [`${count(gaussians)} Gaussians`, ...optionLabels(options)].join(" · ");
}

/** @param {import("./api.js").JobOptions} options */
export function optionLabels({ preset, format, encode, compact, finetune, time_limit: limit }) {
  const wishes = [
    ...goalLabels(encode),
    budgetLabel(compact),
    finetune.enabled ? "fine-tuning" : "",
    limit ? `at most ${duration(limit)}` : "",
  ];
  return [`${preset} preset`, formatOf({ options: { format } }).title, ...wishes.filter(Boolean)];
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
