/** Creating and finding elements. Data becomes text only; nothing here parses HTML. */

/**
 * Return the element with an id; throw if the page has none.
 * @param {string} id
 * @returns {any} any, because each caller knows its type
 */
export function byId(id) {
  const found = document.getElementById(id);
  if (!found) throw new Error(`the page has no #${id}`);
  return found;
}

/**
 * Return a new element.
 * @param {string} name
 * @param {Record<string, any>} [attributes] functions become listeners (`onclick`), booleans toggle, null and undefined are omitted
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
 * Announce a text to screen readers.
 * @param {string} text
 */
export function announce(text) {
  byId("live").textContent = text;
}

/**
 * Accept files that are dropped anywhere on the page, with an overlay while they are dragged over it.
 * @param {(files: File[]) => void} take
 */
export function dropAnywhere(take) {
  const showOverlay = (/** @type {boolean} */ down) => document.body.classList.toggle("dragging", down);
  const carriesFiles = (/** @type {DragEvent} */ event) => event.dataTransfer?.types.includes("Files");
  window.addEventListener("dragover", (event) => {
    if (!carriesFiles(event)) return;
    event.preventDefault(); // the browser would leave the page and show the file
    showOverlay(true);
  });
  window.addEventListener("dragleave", (event) => {
    if (!event.relatedTarget) showOverlay(false); // it has left the window, not just an element
  });
  window.addEventListener("drop", (event) => {
    if (!carriesFiles(event)) return;
    event.preventDefault();
    showOverlay(false);
    take([...(event.dataTransfer?.files ?? [])]);
  });
}
