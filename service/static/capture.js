/** The capture of a scene: an archive with photographs and their cameras, or that of an earlier job; or none. */

import { announce, byId, el } from "./dom.js";
import { bytes } from "./format.js";

const ARCHIVE = /\.(zip|tar|tgz|tar\.(gz|bz2|xz))$/i;

/** Whether a file is that of a capture and not of a scene, by its name. @param {File} file */
export const isArchive = (file) => ARCHIVE.test(file.name);

/**
 * Connect the controls of the capture.
 * @param {import("./api.js").Limits} limits
 * @param {() => void} changed
 */
export function captureField(limits, changed) {
  const [input, target, remove, error] = ["capture", "capture-drop", "capture-remove", "capture-error"].map(byId);
  const title = byId("capture-title");
  const [invitation, note] = [title.textContent, byId("capture-note").textContent];
  /** @type {File | string | null} a file, or the reference of an earlier job's */
  let held = null;

  byId("capture-note").textContent = `${note} Up to ${bytes(limits.max_capture_bytes)}.`;
  input.addEventListener("change", () => {
    if (input.files[0]) choose(input.files[0]);
    input.value = "";
  });
  remove.addEventListener("click", () => {
    hold(null, "");
    input.focus();
  });

  /** @param {File | string | null} capture @param {string} name @param {string} [problem] */
  function hold(capture, name, problem = "") {
    held = capture;
    title.replaceChildren(capture ? name : el("u", {}, invitation));
    byId("capture-note").hidden = capture !== null;
    remove.hidden = capture === null;
    target.classList.toggle("held", capture !== null);
    target.classList.toggle("refused", problem !== "");
    error.textContent = problem;
    if (capture) announce(`${name} chosen.`);
    changed();
  }

  /** @param {File} file */
  function choose(file) {
    const most = limits.max_capture_bytes;
    if (!isArchive(file)) hold(null, "", `${file.name} is not an archive: pack the photographs as .zip or .tar.`);
    else if (file.size > most)
      hold(null, "", `${file.name} has ${bytes(file.size)}; the limit of this service is ${bytes(most)}.`);
    else hold(file, `${file.name}, ${bytes(file.size)}`);
  }

  return {
    choose,
    /** @returns {File | string | null} */
    chosen: () => held,
    clear: () => hold(null, ""),
    /** Name the capture of an earlier job. @param {string | null} [reference] */
    prefer: (reference = null) => hold(reference, "The photographs of the earlier job"),
  };
}
