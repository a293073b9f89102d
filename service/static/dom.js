/** Creation and look-up of elements. Data is inserted as text only: nothing here parses HTML. */

/**
 * Return the element with an id; throw an error if there is none.
 * @param {string} id
 * @returns {any} any, because callers know the type
 */
export function byId(id) {
  const found = document.getElementById(id);
  if (!found) throw new Error(`the page has no #${id}`);
  return found;
}

/**
 * Create an element.
 * @param {string} name
 * @param {Record<string, any>} [attributes] functions become listeners (`onclick`), booleans toggle, null and undefined are ignored
 * @param {...(Node | string | null | undefined)} children strings become text
 * @returns {any}
 */
export function el(name, attributes = {}, ...children) {
  const element = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (typeof value === "function") element.addEventListener(key.slice(2), value);
    else if (typeof value === "boolean") element.toggleAttribute(key, value);
    else if (value !== null && value !== undefined) element.setAttribute(key, String(value));
  }
  element.append(...children.filter((child) => child !== null && child !== undefined));
  return element;
}

/**
 * Create a `<dl>` of name and value pairs.
 * @param {[string, string | Node, string?][]} pairs name, value, optional remark in small print
 */
export function facts(pairs) {
  const items = pairs.map(([name, value, remark]) =>
    el("div", {}, el("dt", {}, name), el("dd", {}, value, remark ? el("small", {}, remark) : null)),
  );
  return el("dl", { class: "facts" }, ...items);
}

/**
 * Create a `<time>` element with a readable text.
 * @param {string} iso
 * @param {string} text
 */
export const time = (iso, text) => el("time", { datetime: iso, title: new Date(iso).toLocaleString() }, text);

/** @type {number | undefined} */
let pending;

/**
 * Announce a text to screen readers. Of several in quick succession only the last is announced, so that the past
 * events of a job are not read out.
 * @param {string} text
 */
export function announce(text) {
  clearTimeout(pending);
  pending = window.setTimeout(() => (byId("live").textContent = text), 300);
}

/**
 * Set the title of the page.
 * @param {string} [text]
 */
export function setTitle(text) {
  document.title = text ? `${text} · kissgs` : "kissgs";
}
