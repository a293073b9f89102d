/** Making and finding elements. Data only ever becomes text: nothing here parses HTML. */

/**
 * The element with an id, which is on the page or the page is broken.
 * @param {string} id
 * @returns {any} any, because every caller knows which kind it is
 */
export function byId(id) {
  const found = document.getElementById(id);
  if (!found) throw new Error(`the page has no #${id}`);
  return found;
}

/**
 * A new element.
 * @param {string} name
 * @param {Record<string, any>} [attributes] functions listen (`onclick`), booleans switch, null and undefined are left out
 * @param {...(Node | string | null | undefined)} children strings become text
 * @returns {any}
 */
export function el(name, attributes = {}, ...children) {
  const made = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (typeof value === "function") made.addEventListener(key.slice(2), value);
    else if (typeof value === "boolean") made.toggleAttribute(key, value);
    else if (value !== null && value !== undefined) made.setAttribute(key, String(value));
  }
  made.append(...children.filter((child) => child !== null && child !== undefined));
  return made;
}

/**
 * Name and value pairs, as they stand side by side in a `<dl>`.
 * @param {[string, string | Node, string?][]} pairs name, value, and a remark in small print
 */
export function facts(pairs) {
  const items = pairs.map(([name, value, remark]) =>
    el("div", {}, el("dt", {}, name), el("dd", {}, value, remark ? el("small", {}, remark) : null)),
  );
  return el("dl", { class: "facts" }, ...items);
}

/**
 * A `<time>` element: for people as text, for machines as it was given.
 * @param {string} iso
 * @param {string} text
 */
export const time = (iso, text) => el("time", { datetime: iso, title: new Date(iso).toLocaleString() }, text);

/** @type {number | undefined} */
let pending;

/**
 * Tell people who listen instead of look. Of several in quick succession only the last is said: the replayed history
 * of a job would otherwise be read out in full.
 * @param {string} text
 */
export function announce(text) {
  clearTimeout(pending);
  pending = window.setTimeout(() => (byId("live").textContent = text), 300);
}

/**
 * Say in the tab what goes on.
 * @param {string} [text]
 */
export function entitle(text) {
  document.title = text ? `${text} · kissgs` : "kissgs";
}
