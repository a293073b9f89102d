/** Radio buttons of the presets, with estimated size, time and quality. */

import { byId, el } from "./dom.js";
import { bytes, decibels, roughly } from "./format.js";

/** @typedef {import("./api.js").Preset} Preset */

const MILLION = 1e6;
const CORES = 2;
const START_SECONDS = 1; // start of a job's process

/** @param {Preset} preset @param {number} gaussians */
const seconds = (preset, gaussians) => START_SECONDS + (preset.cpu_seconds_per_million * gaussians) / MILLION / CORES;

/**
 * Create the radio buttons.
 * @param {import("./api.js").Presets} presets
 */
export function presetList(presets) {
  // "paper" is for comparisons, so it comes last
  const sorted = [...presets.presets].sort((a, b) => Number(a.name === "paper") - Number(b.name === "paper"));
  const rows = sorted.map((preset) => row(preset, preset.name === presets.default));
  byId("preset-list").replaceChildren(...rows.map(({ element }) => element));
  const radios = () => /** @type {HTMLInputElement[]} */ ([...byId("preset-list").querySelectorAll("input")]);
  /** @param {number | null} gaussians of the chosen scene; null if none is chosen */
  function estimate(gaussians) {
    rows.forEach(({ update }) => update(gaussians ?? MILLION));
    byId("preset-note").textContent =
      `Estimates for ${gaussians === null ? "a million Gaussians" : "this scene"} on a small two-core server; quality ` +
      `is the PSNR change of renderings against photographs. Measured on ${presets.measured_on}.`;
  }
  estimate(null);
  const chosen = () => radios().find((radio) => radio.checked)?.value ?? presets.default;
  return {
    estimate,
    chosen,
    /** Whether the chosen preset has rate–distortion planning. */
    plans: () => sorted.find(({ name }) => name === chosen())?.settings.encode.rate_distortion ?? false,
    /** @param {string} name */
    choose: (name) => radios().forEach((radio) => (radio.checked = radio.value === name)),
  };
}

/**
 * @param {Preset} preset
 * @param {boolean} checked
 */
function row(preset, checked) {
  const id = `preset-${preset.name}`;
  const [size, spent] = [el("dd"), el("dd")];
  const figures = el(
    "dl",
    { class: "figures" },
    el("div", {}, el("dt", {}, "Est. size"), size),
    el("div", {}, el("dt", {}, "Est. time"), spent),
    el("div", {}, el("dt", {}, "Quality"), el("dd", {}, decibels(preset.psnr_change))),
  );
  const radio = el("input", {
    type: "radio",
    name: "preset",
    value: preset.name,
    "aria-labelledby": `${id}-title`,
    "aria-describedby": `${id}-text ${id}-figures`,
  });
  radio.checked = checked;
  figures.id = `${id}-figures`;
  const element = el(
    "label",
    { class: "preset" },
    radio,
    el(
      "span",
      {},
      el("strong", { id: `${id}-title` }, preset.title),
      el("span", { class: "small muted", id: `${id}-text` }, preset.description),
    ),
    figures,
  );
  return {
    element,
    /** @param {number} gaussians */
    update(gaussians) {
      size.textContent = bytes(preset.bytes_per_gaussian * gaussians);
      spent.textContent = roughly(seconds(preset, gaussians)).replace("about ", "");
    },
  };
}
