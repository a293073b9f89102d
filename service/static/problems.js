/** Display of errors. */

import { Problem } from "./api.js";
import { byId, el } from "./dom.js";
import { capitalised } from "./format.js";

/**
 * Create a box with a problem, which screen readers announce at once.
 * @param {{title: string, detail: string}} problem
 */
export function problemBox({ title, detail }) {
  return el("div", { class: "problem", role: "alert" }, el("strong", {}, title), el("p", {}, sentence(detail)));
}

/**
 * Convert a detail of the service, which starts with a small letter, to a sentence.
 * @param {string} text
 */
export function sentence(text) {
  return capitalised(/[.!?…]$/.test(text) ? text : `${text}.`);
}

/**
 * Return title and detail of any error; other errors than problems are errors of the page.
 * @param {unknown} error
 */
export function explain(error) {
  if (error instanceof Problem) return error.document;
  console.error(error);
  return { title: "This page has failed", detail: "Reload it; if that does not help, please report it." };
}

/**
 * Show an error of the whole page at its top.
 * @param {unknown} error null to hide it
 * @param {() => void} [retry]
 */
export function showProblem(error, retry) {
  const box = byId("problem");
  box.hidden = error === null;
  if (error === null) return box.replaceChildren();
  const { title, detail } = explain(error);
  const again = retry ? el("button", { class: "quiet", type: "button", onclick: retry }, "Try again") : null;
  box.replaceChildren(el("strong", {}, title), el("p", {}, sentence(detail)), again ?? "");
}
