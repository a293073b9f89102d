/** Camera movement: mouse and touch by OrbitControls of three.js, keys here. */

import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { Quaternion, Spherical, Vector3 } from "three";

const TURN_SPEED = 1.4; // radians per second
const FLY_SPEED = 0.4; // distances of the first view per second
const ZOOM_SPEED = 2.2; // factor of distance per second
const FIRST_STEP = 1 / 20; // seconds of movement by a tap on a key

/** Directions in the camera's frame. @type {Record<string, [number, number, number]>} */
const FLIGHTS = { w: [0, 0, -1], s: [0, 0, 1], a: [-1, 0, 0], d: [1, 0, 0], q: [0, -1, 0], e: [0, 1, 0] };
/** Angles around and over the scene. @type {Record<string, [number, number]>} */
const TURNS = { arrowleft: [-1, 0], arrowright: [1, 0], arrowup: [0, -1], arrowdown: [0, 1] };
/** @type {Record<string, number>} */
const ZOOMS = { "+": 1, "=": 1, "-": -1, _: -1 };

/** @param {import("./viewer.js").Viewer} viewer */
export function navigation(viewer) {
  const { camera, canvas } = viewer;
  let controls = new OrbitControls(camera, canvas);
  let distance = 1; // of the first view, which tells the size of what is seen
  /** @type {Set<string>} */
  const held = new Set();
  let [moved, last, frame] = [false, 0, 0];
  canvas.addEventListener("wheel", () => (moved = true), { passive: true });

  /** @param {number} seconds */
  function step(seconds) {
    for (const key of held) {
      if (key in FLIGHTS) fly(new Vector3(...FLIGHTS[key]).multiplyScalar(FLY_SPEED * distance * seconds));
      else if (key in TURNS) turn(TURNS[key].map((direction) => direction * TURN_SPEED * seconds));
      else zoom(ZOOM_SPEED ** (-ZOOMS[key] * seconds));
    }
    controls.update();
    viewer.invalidate();
  }

  /** @param {Vector3} offset */
  function fly(offset) {
    offset.applyQuaternion(camera.quaternion);
    camera.position.add(offset);
    controls.target.add(offset);
  }

  /** @param {number[]} angles */
  function turn([around, over]) {
    const upright = new Quaternion().setFromUnitVectors(camera.up, new Vector3(0, 1, 0));
    const offset = camera.position.clone().sub(controls.target).applyQuaternion(upright);
    const position = new Spherical().setFromVector3(offset);
    position.theta += around;
    position.phi += over;
    offset.setFromSpherical(position.makeSafe()).applyQuaternion(upright.invert());
    camera.position.copy(offset.add(controls.target));
  }

  /** @param {number} factor */
  function zoom(factor) {
    camera.position.sub(controls.target).multiplyScalar(factor).add(controls.target);
  }

  /** @param {number} now */
  function whileHeld(now) {
    frame = 0;
    if (!held.size) return;
    step(Math.min(0.1, (now - last) / 1000));
    last = now;
    frame = requestAnimationFrame(whileHeld);
  }

  const release = () => held.clear();
  window.addEventListener("blur", release);
  window.addEventListener("keyup", (event) => held.delete(event.key.toLowerCase()));

  return {
    /** Whether the user has moved the camera since the last home(). */
    get moved() {
      return moved;
    },
    home() {
      release();
      moved = false;
      const target = viewer.home();
      controls.dispose();
      controls = new OrbitControls(camera, canvas); // which keeps the direction of up that the camera has now
      controls.addEventListener("start", () => (moved = true));
      controls.addEventListener("change", () => viewer.invalidate());
      controls.target.copy(target);
      distance = camera.position.distanceTo(target);
      controls.minDistance = distance / 500;
      controls.update();
    },
    /**
     * @param {KeyboardEvent} event
     * @returns {boolean} whether the key moves the camera
     */
    press(event) {
      const key = event.key.toLowerCase();
      if (!(key in FLIGHTS || key in TURNS || key in ZOOMS)) return false;
      moved = true;
      if (!held.has(key)) {
        held.add(key);
        step(FIRST_STEP);
      }
      last = performance.now();
      if (!frame) frame = requestAnimationFrame(whileHeld);
      return true;
    },
  };
}
