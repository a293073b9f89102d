/** The form with the scene and the options of a job. */

import { announce, byId, el } from "./dom.js";
import { bytes, count } from "./format.js";
import { formatField } from "./container_formats.js";
import { goalField } from "./goal.js";
import { UnsuitableFile, inspect } from "./ply.js";
import { presetList } from "./presets.js";

/**
 * @typedef {{preset: string, evaluate: boolean, format?: string, encode?: import("./goal.js").Goals,
 *   compact?: {ratio?: number | null, auto_count?: boolean | null}, finetune?: {enabled?: boolean | null}}} Options
 * @typedef {{file: File, options: Options}} Submission
 */

/**
 * Connect the controls of the form.
 * @param {import("./api.js").Limits} limits
 * @param {import("./api.js").Presets} presets
 * @param {(submission: Submission) => void} submit
 */
export function composer(limits, presets, submit) {
  const [form, input] = [byId("compose"), byId("file")];
  const list = presetList(presets);
  const [goal, format] = [goalField(presets, list.chosen), formatField()];
  /** @type {File | null} */
  let chosen = null;
  let inspections = 0; // only the result of the latest is shown

  byId("file-limits").textContent =
    `Up to ${bytes(limits.max_upload_bytes)} and ${count(limits.max_gaussians)} Gaussians.`;

  byId("keep-note").textContent = limits.training
    ? "The remaining Gaussians are trained to preserve the images: a smaller file after a few minutes of training."
    : "This server has no torch: choose Fast, which prunes without training, at a greater loss of quality.";

  byId("finetune").disabled = !limits.training;
  byId("finetune-note").textContent = limits.training
    ? "Trains the quantised scene with renderings: better quality at equal size, after one or two minutes."
    : "This server has no torch, which training needs.";

  /** @param {File} file */
  async function choose(file) {
    const inspection = ++inspections;
    showError("");
    try {
      const facts = await inspect(file, limits);
      if (inspection !== inspections) return;
      chosen = file;
      show(file, facts);
      list.estimate(facts.gaussians);
    } catch (error) {
      if (inspection !== inspections) return;
      if (!(error instanceof UnsuitableFile)) throw error;
      chosen = null;
      clear();
      list.estimate(null);
      showError(error.message);
    }
  }

  input.addEventListener("change", () => {
    if (input.files[0]) choose(input.files[0]);
    input.value = ""; // so that a file can be chosen again after a correction
  });
  form.addEventListener("submit", (/** @type {SubmitEvent} */ event) => {
    event.preventDefault();
    const [preset, evaluate, encode] = [list.chosen(), byId("evaluate").checked, goal.chosen()];
    const [compact, finetune] = [budget(byId("keep").value), byId("finetune").checked && { enabled: true }];
    const optional = { ...(encode && { encode }), ...(compact && { compact }), ...(finetune && { finetune }) };
    if (chosen) return submit({ file: chosen, options: { preset, evaluate, format: format.chosen(), ...optional } });
    showError("Choose a scene first.");
    input.focus();
  });

  return {
    choose,
    showError,
    /** @param {boolean} visible */
    show: (visible) => (form.hidden = !visible),
    focus: () => byId("compose-title").focus({ preventScroll: true }),
    /** Set the options of an earlier job. @param {Options} options */
    prefer(options) {
      list.choose(options.preset);
      goal.prefer(options.encode ?? {});
      format.prefer(options.format);
      byId("evaluate").checked = options.evaluate;
      byId("finetune").checked = limits.training && (options.finetune?.enabled ?? false);
      const [keep, ratio] = [/** @type {HTMLSelectElement} */ (byId("keep")), options.compact?.ratio ?? null];
      if (ratio !== null && ![...keep.options].some(({ value }) => Number(value) === ratio))
        keep.add(new Option(`Keep ${Math.round(100 * ratio)} %`, String(ratio)));
      const known = options.compact?.auto_count
        ? "auto"
        : [...keep.options].find(({ value }) => Number(value) === ratio)?.value;
      keep.value = known ?? "";
    },
  };
}

/** @param {string} kept share of Gaussians, "auto", or empty for all */
const budget = (kept) => (kept === "auto" ? { auto_count: true } : kept ? { ratio: Number(kept) } : null);

/** @param {string} text */
function showError(text) {
  byId("file-error").textContent = text;
  byId("drop").classList.toggle("refused", text !== "");
}

/**
 * @param {File} file
 * @param {import("./ply.js").PlyFacts} facts
 */
function show(file, facts) {
  const kind = facts.packed ? "compressed .ply" : facts.shDegree === null ? null : `SH degree ${facts.shDegree}`;
  const gaussians = facts.gaussians === null ? null : `${count(facts.gaussians)} Gaussians`;
  const text = [bytes(file.size), gaussians, kind].filter(Boolean).join(" · ");
  byId("file-title").replaceChildren(file.name);
  byId("file-facts").textContent = text;
  setChosen(true);
  announce(`${file.name} chosen: ${text}.`);
}

function clear() {
  byId("file-title").replaceChildren(el("u", {}, "Choose a scene"), " or drop it anywhere on this page");
  setChosen(false);
}

/** @param {boolean} chosen whether a file is chosen */
function setChosen(chosen) {
  byId("drop").classList.toggle("held", chosen);
  byId("file-facts").hidden = !chosen;
  byId("file-limits").hidden = chosen;
  byId("drop").querySelector(".drop-change").hidden = !chosen;
}

/**
 * Accept files dropped anywhere on the page, with an overlay during dragging.
 * @param {{accepts: () => boolean, choose: (file: File) => void}} page
 */
export function dropAnywhere({ accepts, choose }) {
  const setOverlay = /** @param {boolean} visible */ (visible) => document.body.classList.toggle("dragging", visible);
  const files = /** @param {DragEvent} event */ (event) => event.dataTransfer?.types.includes("Files");
  window.addEventListener("dragover", (event) => {
    if (!files(event)) return;
    event.preventDefault(); // always: otherwise the browser would open the file
    if (event.dataTransfer && !accepts()) event.dataTransfer.dropEffect = "none";
    setOverlay(accepts());
  });
  window.addEventListener("dragleave", (event) => {
    if (!event.relatedTarget) setOverlay(false); // the pointer has left the window, not just an element
  });
  window.addEventListener("drop", (event) => {
    if (!files(event)) return;
    event.preventDefault();
    setOverlay(false);
    const file = event.dataTransfer?.files[0];
    if (file && accepts()) choose(file);
  });
}
