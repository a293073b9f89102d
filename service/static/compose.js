/** The form with the scene and the options of a job. */

import { announce, byId, el } from "./dom.js";
import { bytes, count } from "./format.js";
import { captureField, isArchive } from "./capture.js";
import { choiceField } from "./choice.js";
import { expectFixed } from "./expected.js";
import { formatField } from "./container_formats.js";
import { UnsuitableFile, endingsOf, inspect } from "./ply.js";

/**
 * @typedef {import("./choice.js").Choice & {format: string, evaluate: boolean, origin: string | null,
 *   capture: string | null}} Options
 * @typedef {{file: File, capture: File | null, options: Options}} Submission
 */

const MILLION = 1e6;

/**
 * Connect the controls of the form.
 * @param {import("./api.js").Limits} limits
 * @param {import("./api.js").Presets} presets
 * @param {(submission: Submission) => void} submit
 */
export function composer(limits, presets, submit) {
  const [form, input, fields] = [byId("compose"), byId("file"), optionFields(limits, presets)];
  /** @type {File | null} */
  let chosen = null;
  let inspections = 0; // only the result of the latest is shown

  input.accept = endingsOf(limits).join();
  byId("file-limits").textContent =
    `Up to ${bytes(limits.max_upload_bytes)} and ${count(limits.max_gaussians)} Gaussians.`;

  /** @param {File} file */
  async function choose(file) {
    if (isArchive(file)) return fields.capture.choose(file);
    const inspection = ++inspections;
    showError("");
    try {
      const facts = await inspect(file, limits);
      if (inspection !== inspections) return;
      chosen = file;
      show(file, facts);
      fields.describe(facts);
    } catch (error) {
      if (inspection !== inspections) return;
      if (!(error instanceof UnsuitableFile)) throw error;
      chosen = null;
      clear();
      fields.describe(null);
      showError(error.message);
    }
  }

  input.addEventListener("change", () => {
    if (input.files[0]) choose(input.files[0]);
    input.value = ""; // so that a file can be chosen again after a correction
  });
  form.addEventListener("submit", (/** @type {SubmitEvent} */ event) => {
    event.preventDefault();
    const capture = fields.capture.chosen();
    if (chosen)
      return submit({ file: chosen, capture: capture instanceof File ? capture : null, options: fields.chosen() });
    showError("Choose a scene first.");
    input.focus();
  });

  return {
    choose,
    showError,
    /** @param {boolean} visible */
    show: (visible) => (form.hidden = !visible),
    focus: () => byId("compose-title").focus({ preventScroll: true }),
    prefer: fields.prefer,
    /** Forget the photographs of the scene that was sent: the next one has others. */
    sent: fields.capture.clear,
  };
}

/**
 * Connect the controls of the options.
 * @param {import("./api.js").Limits} limits
 * @param {import("./api.js").Presets} presets
 */
function optionFields(limits, presets) {
  const [choice, format] = [choiceField(limits, presets), formatField()];
  const [keep, finetune, evaluate, origin] = ["keep", "finetune", "evaluate", "origin"].map(byId);
  const capture = captureField(limits, refresh);
  /** @type {import("./ply.js").PlyFacts | null} */
  let facts = null;

  /** Return what is known of the scene. @returns {import("./expected.js").Scene} */
  function scene() {
    const captured = capture.chosen() !== null;
    const trains = limits.training && (captured || finetune.checked);
    const [gaussians, degree] = [facts?.gaussians ?? MILLION, facts?.shDegree ?? 3];
    return { gaussians, degree, captured, trains, tuned: finetune.checked, reduced: keep.value !== "" };
  }

  /** Enable the choices that can be combined, and say what to expect of each. */
  function refresh() {
    const fixed = expectFixed(format.chosen(), scene());
    byId("choice").disabled = fixed !== null;
    format.explain(fixed);
    const { preset, time_limit: limit } = choice.chosen();
    const given = fixed !== null || choice.isEarlier();
    finetune.disabled = given || !limits.training;
    if (fixed) finetune.checked = false;
    keep.disabled = given || limit || (!limits.training && preset !== "fast");
    if (keep.disabled) keep.value = "";
    choice.refresh(scene());
    byId("choice-note").textContent = keep.value
      ? "What to expect of fewer Gaussians is not known before."
      : `Expected for ${facts?.gaussians ? "this scene" : "a million Gaussians"} on two cores; other scenes differ. ` +
        `Quality is the change of PSNR to photographs, all measured on ${presets.measured_on}.`;
  }

  if (!limits.training) {
    byId("finetune-note").textContent = "This server has no torch, which training needs; make setup TRAIN=1 adds it.";
  }
  byId("compose").addEventListener("change", refresh);
  refresh();
  return {
    capture,
    /** @param {import("./ply.js").PlyFacts | null} found of the scene; null if none is chosen */
    describe(found) {
      facts = found;
      refresh();
    },
    /** @returns {Options} */
    chosen() {
      const [kind, picked, reference] = [format.chosen(), choice.chosen(), capture.chosen()];
      const shared = {
        format: kind,
        evaluate: evaluate.checked,
        origin: origin.checked ? "auto" : null,
        capture: typeof reference === "string" ? reference : null,
      };
      if (expectFixed(kind, scene())) return shared;
      if (choice.isEarlier()) return { ...picked, ...shared };
      const untrained = picked.encode && !scene().trains; // a goal alone would train
      return {
        preset: presets.default,
        ...picked,
        ...(untrained && { compact: { auto_count: false } }),
        ...((untrained || finetune.checked) && { finetune: { enabled: finetune.checked } }),
        ...(keep.value && { compact: { ratio: Number(keep.value) } }),
        ...shared,
      };
    },
    /** Set the options of an earlier job. @param {import("./api.js").JobOptions} earlier */
    prefer(earlier) {
      choice.prefer(earlier);
      capture.prefer(earlier.capture);
      format.prefer(earlier.format);
      evaluate.checked = earlier.evaluate;
      origin.checked = earlier.origin === "auto";
      refresh();
    },
  };
}

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
    const dropped = [...(event.dataTransfer?.files ?? [])];
    const several = [dropped.find((file) => !isArchive(file)), dropped.find(isArchive)]; // a scene, its photographs
    for (const file of several) if (file && accepts()) choose(file);
  });
}
