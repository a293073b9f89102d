/** The form with the scene and the options of a job. */

import { announce, byId, el } from "./dom.js";
import { bytes, count } from "./format.js";
import { captureField, isArchive } from "./capture.js";
import { formatField } from "./container_formats.js";
import { goalField } from "./goal.js";
import { keepField } from "./keep.js";
import { UnsuitableFile, endingsOf, inspect } from "./ply.js";
import { presetList } from "./presets.js";
import { timeField } from "./time_limit.js";

/**
 * @typedef {{preset: string, evaluate: boolean, format: string, origin?: string, time_limit?: number, encode?: import("./api.js").Goals,
 *   compact?: import("./api.js").Budget, finetune?: {enabled: boolean}, capture?: string}} Options options that differ from the preset
 * @typedef {{file: File, capture: File | null, options: Options}} Submission
 */

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
      fields.estimate(facts.gaussians);
    } catch (error) {
      if (inspection !== inspections) return;
      if (!(error instanceof UnsuitableFile)) throw error;
      chosen = null;
      clear();
      fields.estimate(null);
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
  const [list, goal, format] = [presetList(presets), goalField(), formatField()];
  const [time, keep] = [timeField(limits), keepField(limits.training)];
  const [finetune, evaluate, origin] = [byId("finetune"), byId("evaluate"), byId("origin")];

  const capture = captureField(limits, refresh);
  let trains = false;
  const decided = { finetune: false, keep: false }; // by the user, or by an earlier job

  finetune.disabled = !limits.training;
  finetune.addEventListener("change", () => (decided.finetune = true));
  byId("keep").addEventListener("change", () => (decided.keep = true));

  /** Enable the choices that can be combined, and explain them. */
  function refresh() {
    const captured = capture.chosen() !== null;
    goal.refresh(list.plans(), captured);
    const [preset, plans, aims] = [list.chosen(), list.plans(), goal.chosen() !== null];
    if (trains !== (limits.training && captured && aims)) {
      trains = !trains; // on photographs, which serves the goal best
      if (!decided.finetune) finetune.checked = trains;
      if (!decided.keep) keep.prefer(trains ? { auto_count: true } : {});
    }
    keep.refresh(aims, time.chosen() !== null);
    time.refresh({ preset, plans, captured, goal: aims, tunes: finetune.checked, kept: keep.chosen() });
    const targets = captured ? "its photographs" : "renderings";
    byId("finetune-note").textContent = limits.training
      ? `Trains the quantised scene with ${targets}: better quality at equal size, after one or two minutes.`
      : "This server has no torch, which training needs.";
  }

  byId("compose").addEventListener("change", refresh);
  refresh();
  return {
    capture,
    estimate: list.estimate,
    /** @returns {Options} */
    chosen() {
      const [encode, compact, limit] = [goal.chosen(), keep.chosen(), time.chosen()];
      const reference = capture.chosen();
      return {
        preset: list.chosen(),
        evaluate: evaluate.checked,
        format: format.chosen(),
        ...(origin.checked && { origin: "auto" }),
        ...(limit && { time_limit: limit }),
        ...(typeof reference === "string" && { capture: reference }),
        ...(encode && { encode }),
        ...(compact ? { compact } : encode && { compact: { auto_count: false } }), // else a goal would choose
        ...((finetune.checked || encode) && { finetune: { enabled: finetune.checked } }), // a goal alone would train
      };
    },
    /** Set the options of an earlier job. @param {import("./api.js").JobOptions} earlier */
    prefer(earlier) {
      decided.finetune = decided.keep = true;
      list.choose(earlier.preset);
      goal.prefer(earlier.encode);
      capture.prefer(earlier.capture);
      time.prefer(earlier.time_limit);
      keep.prefer(earlier.compact);
      format.prefer(earlier.format);
      evaluate.checked = earlier.evaluate;
      origin.checked = earlier.origin === "auto";
      finetune.checked = limits.training && (earlier.finetune.enabled ?? false);
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
