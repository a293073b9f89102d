/** What keys do, and the buttons that do the same. */

import { byId } from "./dom.js";
import { Trouble, trouble } from "./trouble.js";

export const help = () => byId("keys").showModal();

export function switchPanels() {
  byId("panels").setAttribute("aria-pressed", document.body.classList.toggle("bare"));
}

export function switchFullScreen() {
  const refused = () => trouble(new Trouble("This browser does not give its full screen to this page."));
  if (document.fullscreenElement) document.exitFullscreen();
  else if (document.fullscreenEnabled) document.documentElement.requestFullscreen().catch(refused);
  else refused();
}

/**
 * Keys count while the picture has the focus, or nothing has: elsewhere they are somebody else's.
 * @param {{picture: HTMLElement, home: () => void, move: (event: KeyboardEvent) => boolean}} view
 */
export function listen({ picture, home, move }) {
  /** @type {Record<string, () => void>} */
  const actions = { r: home, home, f: switchFullScreen, h: switchPanels, "?": help };
  window.addEventListener("keydown", (event) => {
    const ours = event.target === document.body || event.target === picture;
    if (!ours || event.ctrlKey || event.metaKey || event.altKey || picture.hidden) return;
    const action = actions[event.key.toLowerCase()];
    if (!action && !move(event)) return;
    event.preventDefault();
    action?.();
  });
}
