/** The form: which scene, and how to compress it. */

import { announce, byId, el } from "./dom.js";
import { bytes, count } from "./format.js";
import { goalField } from "./goal.js";
import { Unsuitable, inspect } from "./ply.js";
import { presetList } from "./presets.js";

/**
 * @typedef {{preset: string, evaluate: boolean, encode?: import("./goal.js").Goals,
 *   compact?: {ratio?: number | null, auto_count?: boolean}, finetune?: {enabled?: boolean}}} Options
 * @typedef {{file: File, options: Options}} Order
 */

/**
 * Bring the form to life.
 * @param {import("./api.js").Limits} limits
 * @param {import("./api.js").Presets} presets
 * @param {(order: Order) => void} submit
 */
export function composer(limits, presets, submit) {
  const [form, input] = [byId("compose"), byId("file")];
  const list = presetList(presets);
  const goal = goalField(presets, list.chosen);
  /** @type {File | null} */
  let chosen = null;
  let looks = 0; // at files: only the latest look may speak

  byId("file-limits").textContent =
    `Up to ${bytes(limits.max_upload_bytes)} and ${count(limits.max_gaussians)} Gaussians.`;

  byId("keep-note").textContent = limits.training
    ? "Those that stay learn to do the work of the others: a smaller file, after some minutes of training."
    : "This server has no torch: choose Fast to have fewer. Nothing is trained then, and pictures become rougher.";

  byId("finetune").disabled = !limits.training;
  byId("finetune-note").textContent = limits.training
    ? "Fits what was rounded to pictures of the scene: better at the same size, after a minute or two."
    : "This server has no torch to train with.";

  /** @param {File} file */
  async function take(file) {
    const look = ++looks;
    say("");
    try {
      const facts = await inspect(file, limits);
      if (look !== looks) return;
      chosen = file;
      show(file, facts);
      list.estimate(facts.gaussians);
    } catch (error) {
      if (look !== looks) return;
      if (!(error instanceof Unsuitable)) throw error;
      chosen = null;
      clear();
      list.estimate(null);
      say(error.message);
    }
  }

  input.addEventListener("change", () => {
    if (input.files[0]) take(input.files[0]);
    input.value = ""; // so that the same file, mended, can be chosen again
  });
  form.addEventListener("submit", (/** @type {SubmitEvent} */ event) => {
    event.preventDefault();
    const [preset, evaluate, encode] = [list.chosen(), byId("evaluate").checked, goal.chosen()];
    const [compact, finetune] = [budget(byId("keep").value), byId("finetune").checked && { enabled: true }];
    const asked = { ...(encode && { encode }), ...(compact && { compact }), ...(finetune && { finetune }) };
    if (chosen) return submit({ file: chosen, options: { preset, evaluate, ...asked } });
    say("Choose a .ply first.");
    input.focus();
  });

  return {
    take,
    ask: say,
    /** @param {boolean} visible */
    show: (visible) => (form.hidden = !visible),
    focus: () => byId("compose-title").focus({ preventScroll: true }),
    /** As they were the last time, for another try. @param {Options} options */
    prefer(options) {
      list.choose(options.preset);
      goal.prefer(options.encode ?? {});
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

/** @param {string} kept how many Gaussians: a share, "auto", or nothing for all */
const budget = (kept) => (kept === "auto" ? { auto_count: true } : kept ? { ratio: Number(kept) } : null);

/** @param {string} text */
function say(text) {
  byId("file-error").textContent = text;
  byId("drop").classList.toggle("refused", text !== "");
}

/**
 * @param {File} file
 * @param {import("./ply.js").PlyFacts} facts
 */
function show(file, facts) {
  const kind = facts.packed ? "compressed .ply" : facts.shDegree === null ? null : `SH degree ${facts.shDegree}`;
  const text = [bytes(file.size), `${count(facts.gaussians)} Gaussians`, kind].filter(Boolean).join(" · ");
  byId("file-title").replaceChildren(file.name);
  byId("file-facts").textContent = text;
  hold(true);
  announce(`${file.name} chosen: ${text}.`);
}

function clear() {
  byId("file-title").replaceChildren(el("u", {}, "Choose a .ply"), " or drop it anywhere on this page");
  hold(false);
}

/** @param {boolean} held whether a file is chosen */
function hold(held) {
  byId("drop").classList.toggle("held", held);
  byId("file-facts").hidden = !held;
  byId("file-limits").hidden = held;
  byId("drop").querySelector(".drop-change").hidden = !held;
}

/**
 * Files dropped anywhere on the page, with a veil over it while one is above.
 * @param {{willing: () => boolean, take: (file: File) => void}} page
 */
export function dropAnywhere({ willing, take }) {
  const veil = /** @param {boolean} down */ (down) => document.body.classList.toggle("dragging", down);
  const files = /** @param {DragEvent} event */ (event) => event.dataTransfer?.types.includes("Files");
  window.addEventListener("dragover", (event) => {
    if (!files(event)) return;
    event.preventDefault(); // also where it is not wanted: the browser would leave the page and show the file
    if (event.dataTransfer && !willing()) event.dataTransfer.dropEffect = "none";
    veil(willing());
  });
  window.addEventListener("dragleave", (event) => {
    if (!event.relatedTarget) veil(false); // it has left the window, not just an element
  });
  window.addEventListener("drop", (event) => {
    if (!files(event)) return;
    event.preventDefault();
    veil(false);
    const file = event.dataTransfer?.files[0];
    if (file && willing()) take(file);
  });
}
