/** Actions of keys, and of the buttons that do the same. */

import { byId } from "./dom.js";
import { UserError, showProblem } from "./problem.js";

export const help = () => byId("keys").showModal();

export function switchPanels() {
  byId("panels").setAttribute("aria-pressed", document.body.classList.toggle("bare"));
}

export function switchFullScreen() {
  const refused = () => showProblem(new UserError("This browser does not give its full screen to this page."));
  if (document.fullscreenElement) document.exitFullscreen();
  else if (document.fullscreenEnabled) document.documentElement.requestFullscreen().catch(refused);
  else refused();
}

/**
 * Handle keys while the viewport or nothing has the focus; elsewhere they belong to other elements.
 * @param {{viewport: HTMLElement, home: () => void, move: (event: KeyboardEvent) => boolean}} view
 */
export function listen({ viewport, home, move }) {
  /** @type {Record<string, () => void>} */
  const actions = { r: home, home, f: switchFullScreen, h: switchPanels, "?": help };
  window.addEventListener("keydown", (event) => {
    const ours = event.target === document.body || event.target === viewport;
    if (!ours || event.ctrlKey || event.metaKey || event.altKey || viewport.hidden) return;
    const action = actions[event.key.toLowerCase()];
    if (!action && !move(event)) return;
    event.preventDefault();
    action?.();
  });
}
