/** Showing what has gone wrong. */

import { Problem } from "./api.js";
import { byId, el } from "./dom.js";

/**
 * A problem document for people; screen readers say it at once.
 * @param {{title: string, detail: string}} problem
 */
export function problemBox({ title, detail }) {
  return el("div", { class: "problem", role: "alert" }, el("strong", {}, title), el("p", {}, sentence(detail)));
}

/**
 * The service's details begin small, as they may be part of a longer line; here they stand alone.
 * @param {string} text
 */
export function sentence(text) {
  const whole = text.charAt(0).toUpperCase() + text.slice(1);
  return /[.!?…]$/.test(whole) ? whole : `${whole}.`;
}

/**
 * What to say of an error from anywhere; a fault of this page is told as such.
 * @param {unknown} error
 */
export function explain(error) {
  if (error instanceof Problem) return error.document;
  console.error(error);
  return { title: "This page has failed", detail: "Reload it; if that does not help, please report it." };
}

/**
 * Trouble of the page as a whole, above everything else.
 * @param {unknown} error null when it is over
 * @param {() => void} [retry]
 */
export function trouble(error, retry) {
  const place = byId("trouble");
  place.hidden = error === null;
  if (error === null) return place.replaceChildren();
  const { title, detail } = explain(error);
  const again = retry ? el("button", { class: "quiet", type: "button", onclick: retry }, "Try again") : null;
  place.replaceChildren(el("strong", {}, title), el("p", {}, sentence(detail)), again ?? "");
}
