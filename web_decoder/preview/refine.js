/** Refinement of a rendering as images arrive. */

import { STAGES } from "./scene.js";

/** @typedef {import("./scene.js").Scene} Scene */

/**
 * Return a function that shows the latest stage of a scene; stages that arrive while one waits to be drawn are merged.
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
    if (!waiting) view.ready.then(() => setTimeout(show, 0, scene)); // otherwise the waiting rendering will include it
  };
}
