/** The one choice of a job: balanced, or how small, how good or how long, each with what to expect of the scene. */

import { byId, el } from "./dom.js";
import { bytes, decibels, duration, roughly } from "./format.js";
import { expect } from "./expected.js";
import { optionLabels } from "./labels.js";

/**
 * @typedef {{preset?: string, encode?: import("./api.js").Goals, time_limit?: number | null, format?: string,
 *   compact?: import("./api.js").Budget, finetune?: {enabled: boolean | null}}} Choice options that differ from the preset
 */

/** @type {[string, import("./api.js").Goals][]} */
const QUALITIES = [
  ["looks the same", { quality: "same" }],
  ["high quality", { quality: "high" }],
  ["good quality", { quality: "good" }],
  ["at most 0.1 dB PSNR loss", { max_psnr_drop: 0.1 }],
  ["at most 0.3 dB PSNR loss", { max_psnr_drop: 0.3 }],
  ["at most 0.5 dB PSNR loss", { max_psnr_drop: 0.5 }],
];
const TIMES = [30, 60, 120, 300, 600, 1800]; // seconds
const MEGABYTE = 1e6;
const [TRAINED_SHARE, ENCODED_SHARE] = [0.3, 0.7]; // of the bytes of Balanced, the size that is proposed

/**
 * Connect the choice of the form.
 * @param {import("./api.js").Limits} limits
 * @param {import("./api.js").Presets} presets
 */
export function choiceField(limits, presets) {
  const named = Object.fromEntries(presets.presets.map((preset) => [preset.name, preset]));
  const quality = select(
    "Quality",
    QUALITIES.map(([text, goal]) => new Option(text, JSON.stringify(goal))),
  );
  const times = TIMES.filter((seconds) => seconds < limits.job_seconds);
  const time = select("Time", [
    new Option("as fast as possible", ""),
    ...times.map((seconds) => new Option(`in ${duration(seconds)}`, String(seconds))),
  ]);
  const size = el("input", {
    type: "number",
    inputmode: "decimal",
    min: 0.001,
    step: "any",
    required: true,
    "aria-label": "Megabytes",
  });
  /** @type {Choice | null} options of an earlier job */
  let earlier = null;
  let sized = false; // by the user
  const rows = [
    row("balanced", "Balanced", ["small and good, soon"], () => ({})),
    row("small", "Small", ["at most ", size, " MB"], () => ({
      encode: { target_size: Math.floor(Number((Number(size.value) * MEGABYTE).toPrecision(12))) },
    })),
    row("good", "Good", [quality], () => ({ encode: JSON.parse(quality.value) })),
    row("quick", "Quick", [time], () => (time.value ? { time_limit: Number(time.value) } : { preset: "fast" })),
    row("earlier", "As before", [], () => earlier ?? {}),
  ];
  const [balanced, small, , , before] = rows;
  balanced.radio.checked = true;
  before.element.hidden = before.figures.hidden = true;
  byId("choices").replaceChildren(...rows.map(({ element }) => element));
  size.addEventListener("input", () => (sized = true));
  const chosen = () => rows.find(({ radio }) => radio.checked)?.options() ?? {};

  return {
    /** @returns {Choice} */
    chosen,
    isEarlier: () => before.radio.checked,
    /** Show what to expect of a scene. @param {import("./expected.js").Scene} scene */
    refresh(scene) {
      const usual = expect({}, { ...scene, reduced: false }, named);
      if (!small.radio.checked && !size.checkValidity()) sized = false; // else it would prevent the submission
      const share = scene.trains ? TRAINED_SHARE : ENCODED_SHARE;
      if (!sized && usual) {
        const proposed = Number(((share * usual.bytes) / MEGABYTE).toPrecision(2));
        size.value = String(Math.max(proposed, Number(size.min))); // less would prevent the submission
      }
      for (const each of rows) if (each !== before) each.show(expect(each.options(), scene, named));
    },
    /** Choose the options of an earlier job. @param {import("./api.js").JobOptions} options */
    prefer(options) {
      earlier = options;
      before.element.hidden = false;
      before.radio.checked = true;
      before.note.textContent = optionLabels(options).join(", ");
    },
  };
}

/** @param {string} label @param {HTMLOptionElement[]} options @returns {HTMLSelectElement} */
const select = (label, options) => el("select", { "aria-label": label }, ...options);

/**
 * @param {string} name
 * @param {string} title
 * @param {(string | HTMLElement)[]} content text and controls; a control that is used chooses the row
 * @param {() => Choice} options
 */
function row(name, title, content, options) {
  const radio = el("input", {
    type: "radio",
    name: "choice",
    id: `choice-${name}`,
    "aria-describedby": `figures-${name}`,
  });
  const note = el("span", { class: "choice-note" }, ...content);
  const values = ["Size", "Quality", "Time"].map((label) => /** @type {const} */ ([el("dt", {}, label), el("dd")]));
  const figures = el(
    "dl",
    { class: "figures", id: `figures-${name}` },
    ...values.map((pair) => el("div", {}, ...pair)),
  );
  const choose = () => {
    radio.checked = true;
    radio.dispatchEvent(new Event("change", { bubbles: true }));
  };
  note.addEventListener("click", choose);
  note.addEventListener("input", choose); // by the keyboard; the focus alone chooses nothing
  return {
    radio,
    note,
    options,
    figures,
    element: el("div", { class: "choice" }, radio, el("label", { for: radio.id }, title), note, figures),
    /** @param {import("./expected.js").Expectation | null} found */
    show(found) {
      const time = found?.seconds === null ? "minutes" : found && roughly(found.seconds).replace("about ", "");
      const texts = found && [bytes(found.bytes), `${found.below ? "< " : ""}${decibels(found.change)}`, time];
      values.forEach(([, value], at) => (value.textContent = texts?.[at] ?? "–"));
    },
  };
}
