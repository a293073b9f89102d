/** The formats of a container: their names, endings and uses, and the choice between them. */

import { byId } from "./dom.js";

/** @typedef {{title: string, ending: string, note: string}} Format */

/** Formats by the service's names of them, the default first. @type {Record<string, Format>} */
const FORMATS = {
  sogxt: {
    title: "SOG-XT",
    ending: ".zip",
    note: "The container of kissgs, for its viewer and its decoder.",
  },
  sog: {
    title: "SOG",
    ending: ".sog",
    note: "Opens in other viewers, such as SuperSplat, PlayCanvas and Spark.",
  },
};
const [DEFAULT] = Object.keys(FORMATS);

/** Return the format of a job. @param {{options: {format?: string}}} job */
export const formatOf = ({ options: { format = DEFAULT } }) => FORMATS[format];

/** @param {Format} format */
export const formatLabel = ({ title, ending }) => `${title} (${ending})`;

/** Connect the choice of the form. */
export function formatField() {
  const choice = /** @type {HTMLSelectElement} */ (byId("format"));
  for (const [name, format] of Object.entries(FORMATS)) choice.add(new Option(formatLabel(format), name));
  const explain = () => (byId("format-note").textContent = FORMATS[choice.value].note);
  choice.addEventListener("change", explain);
  explain();
  return {
    chosen: () => choice.value,
    /** @param {string} [format] */
    prefer(format = DEFAULT) {
      choice.value = format;
      explain();
    },
  };
}
