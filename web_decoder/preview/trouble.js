/** Showing what has gone wrong: one sentence, and the rest of the page goes on. */

import { SogxtError } from "../sogxt.js";
import { byId, el } from "./dom.js";

/** Something that this page can name; its message is the sentence. */
export class Trouble extends Error {}

/** @param {unknown} error null when it is over */
export function trouble(error) {
  const place = byId("trouble");
  place.hidden = error === null;
  if (error === null) return place.replaceChildren();
  const close = el(
    "button",
    { type: "button", class: "close", "aria-label": "Dismiss", onclick: () => trouble(null) },
    "×",
  );
  place.replaceChildren(el("p", {}, sentenceOf(error)), close);
}

/** @param {unknown} error */
function sentenceOf(error) {
  if (error instanceof Trouble || error instanceof SogxtError) return sentence(error.message);
  const reason = error instanceof Error ? error.message : String(error);
  return `This page has failed, which is a fault of its own: ${reason || "no reason was given"}.`;
}

/**
 * The decoder's messages begin small, as they may be part of a longer line; here they stand alone.
 * @param {string} text
 */
function sentence(text) {
  const begun = /^[a-z]+\b(?![._])/.test(text) ? text.charAt(0).toUpperCase() + text.slice(1) : text; // not names of files
  return /[.!?…]$/.test(begun) ? begun : `${begun}.`;
}

/** @param {unknown} error */
export const aborted = (error) => error instanceof DOMException && error.name === "AbortError";
