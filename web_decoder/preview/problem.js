/** Display of error messages of one sentence; the rest of the page goes on. */

import { SogxtError } from "../sogxt.js";
import { byId, el } from "./dom.js";

/** An error with a message for users, a sentence. */
export class UserError extends Error {}

/** The error whose message is shown. @type {unknown} */
let shown = null;

/** @param {unknown} error null to hide the message */
export function showProblem(error) {
  shown = error;
  const place = byId("problem");
  place.hidden = error === null;
  if (error === null) return place.replaceChildren();
  const close = el(
    "button",
    { type: "button", class: "close", "aria-label": "Dismiss", onclick: () => showProblem(null) },
    "×",
  );
  place.replaceChildren(el("p", {}, sentenceOf(error)), close);
}

/** Hide the message of an error, unless another one is shown by now. @param {unknown} error */
export function withdrawProblem(error) {
  if (error === shown) showProblem(null);
}

/** Return the message for users. @param {unknown} error */
export function sentenceOf(error) {
  if (error instanceof UserError || error instanceof SogxtError) return sentence(error.message);
  const reason = error instanceof Error ? error.message : String(error);
  return `This page failed because of a bug in it: ${reason || "no reason was given"}.`;
}

/**
 * Make a sentence of a message of the decoder, which begins with a small letter and has no full stop.
 * @param {string} text
 */
function sentence(text) {
  const capitalised = /^[a-z]+\b(?![._])/.test(text) ? text.charAt(0).toUpperCase() + text.slice(1) : text; // except file names
  return /[.!?…]$/.test(capitalised) ? capitalised : `${capitalised}.`;
}

/** @param {unknown} error */
export const aborted = (error) => error instanceof DOMException && error.name === "AbortError";
