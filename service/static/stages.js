/** Everyday names of the stages of a job. */

/** Names of those that the service reports. @type {Record<string, string>} */
const STAGES = {
  read: "Reading",
  kernels: "Preparing",
  cameras: "Choosing cameras",
  sensitivity: "Measuring what matters",
  score: "Measuring what matters",
  targets: "Drawing",
  sparsify: "Training",
  refine: "Training",
  finetune: "Training",
  refit: "Training",
  merge: "Merging",
  rate_distortion: "Sorting",
  order: "Sorting",
  forms: "Sorting",
  codebook: "Sorting",
  "sort codebook": "Sorting",
  rounding: "Sorting",
  reorder: "Sorting",
  images: "Compressing images",
  evaluate: "Checking",
  write: "Writing",
};

/** @param {string} stage unknown ones are shown unchanged */
export const stageLabel = (stage) => STAGES[stage] ?? stage;
