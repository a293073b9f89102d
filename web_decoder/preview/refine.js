/** From a coarse picture to the whole one, as planes arrive. */

import { STAGES } from "./scene.js";

/** @typedef {import("./scene.js").Scene} Scene */

/**
 * Shows a scene whenever there is more of it, and as much as there is by then: planes may come faster than pictures.
 * @param {{ready: Promise<void>, show: (scene: Scene, state: number, fresh: boolean) => void}} view
 * @param {(scene: Scene) => boolean} current whether the scene is still wanted
 */
export function refiner(view, current) {
  /** @type {number} */
  let done = STAGES.nothing;
  /** @type {number} */
  let wanted = STAGES.nothing;

  /** @param {Scene} scene */
  function show(scene) {
    if (!current(scene)) return;
    view.show(scene, wanted, done === STAGES.nothing);
    done = wanted;
  }

  /** @param {Scene} scene @param {number} state */
  return (scene, state) => {
    if (state <= wanted) return;
    const waiting = wanted > done;
    wanted = state;
    if (!waiting) view.ready.then(() => setTimeout(show, 0, scene)); // else the picture to come will have it
  };
}
