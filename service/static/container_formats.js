/** The formats of a result: their names, endings and uses, and the choice between them. */

import { byId } from "./dom.js";
import { bytes, decibels } from "./format.js";

/** @typedef {{title: string, ending: string, opens: string}} Format `opens`: what opens it */

/** Formats by the service's names of them, the default first. @type {Record<string, Format>} */
const FORMATS = {
  sogxt: { title: "SOG-XT", ending: ".zip", opens: "this viewer, Python" },
  sog: { title: "SOG", ending: ".sog", opens: "SuperSplat, PlayCanvas, Spark, Babylon.js" },
  spz: { title: "SPZ", ending: ".spz", opens: "Niantic's viewers, three.js, Spark" },
  "compressed.ply": { title: "compressed PLY", ending: ".compressed.ply", opens: "editors such as SuperSplat" },
};
const [DEFAULT] = Object.keys(FORMATS);

/** Return the format of a job. @param {{options: {format?: string}}} job */
export const formatOf = ({ options: { format = DEFAULT } }) => FORMATS[format];

/** @param {Format} format */
export const formatLabel = ({ title, ending }) => `${title} (${ending})`;

/** Connect the choice of the form. */
export function formatField() {
  const choice = /** @type {HTMLSelectElement} */ (byId("format"));
  for (const [name, { opens, ending }] of Object.entries(FORMATS)) choice.add(new Option(`${ending}: ${opens}`, name));
  return {
    chosen: () => choice.value,
    /** @param {string} [format] */
    prefer: (format = DEFAULT) => (choice.value = format),
    /** Say what to expect of fixed steps, if the format has them. @param {{bytes: number, change: number} | null} fixed */
    explain: (fixed) =>
      (byId("format-note").textContent = fixed
        ? `It holds the scene as it is, in fixed steps: expect ${bytes(fixed.bytes)} and ${decibels(fixed.change)}.`
        : ""),
  };
}
