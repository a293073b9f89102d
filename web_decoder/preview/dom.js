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
 * Tell people who listen instead of look.
 * @param {string} text
 */
export function announce(text) {
  byId("live").textContent = text;
}

/**
 * Files dropped anywhere on the page, with a veil over it while one is above.
 * @param {(files: File[]) => void} take
 */
export function dropAnywhere(take) {
  const veil = (/** @type {boolean} */ down) => document.body.classList.toggle("dragging", down);
  const carriesFiles = (/** @type {DragEvent} */ event) => event.dataTransfer?.types.includes("Files");
  window.addEventListener("dragover", (event) => {
    if (!carriesFiles(event)) return;
    event.preventDefault(); // the browser would leave the page and show the file
    veil(true);
  });
  window.addEventListener("dragleave", (event) => {
    if (!event.relatedTarget) veil(false); // it has left the window, not just an element
  });
  window.addEventListener("drop", (event) => {
    if (!carriesFiles(event)) return;
    event.preventDefault();
    veil(false);
    take([...(event.dataTransfer?.files ?? [])]);
  });
}
