/** Moving the camera: mouse and touch by three's OrbitControls, keys here. */

import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { Spherical, Vector3 } from "three";

const TURN = 1.4; // radians per second
const FLY = 0.7; // of the scene's radius per second
const ZOOM = 2.2; // times nearer per second
const FIRST_STEP = 1 / 20; // seconds: what a tap on a key is worth

/** Directions of the camera's own frame. @type {Record<string, [number, number, number]>} */
const FLIGHTS = { w: [0, 0, -1], s: [0, 0, 1], a: [-1, 0, 0], d: [1, 0, 0], q: [0, -1, 0], e: [0, 1, 0] };
/** Angles around and over the scene. @type {Record<string, [number, number]>} */
const TURNS = { arrowleft: [-1, 0], arrowright: [1, 0], arrowup: [0, -1], arrowdown: [0, 1] };
/** @type {Record<string, number>} */
const ZOOMS = { "+": 1, "=": 1, "-": -1, _: -1 };

/** @param {import("./viewer.js").Viewer} viewer */
export function navigation(viewer) {
  const { camera, canvas } = viewer;
  const controls = new OrbitControls(camera, canvas);
  /** @type {Set<string>} */
  const held = new Set();
  let [moved, last, frame] = [false, 0, 0];
  controls.addEventListener("start", () => (moved = true));
  controls.addEventListener("change", () => viewer.invalidate());
  canvas.addEventListener("wheel", () => (moved = true), { passive: true });

  /** @param {number} seconds */
  function step(seconds) {
    const radius = viewer.extent.radius;
    for (const key of held) {
      if (key in FLIGHTS) fly(new Vector3(...FLIGHTS[key]).multiplyScalar(FLY * radius * seconds));
      else if (key in TURNS) turn(TURNS[key].map((direction) => direction * TURN * seconds));
      else zoom(ZOOM ** (-ZOOMS[key] * seconds));
    }
    controls.update();
    viewer.invalidate();
  }

  /** @param {Vector3} way */
  function fly(way) {
    way.applyQuaternion(camera.quaternion);
    camera.position.add(way);
    controls.target.add(way);
  }

  /** @param {number[]} angles */
  function turn([around, over]) {
    const place = new Spherical().setFromVector3(camera.position.clone().sub(controls.target));
    place.theta += around;
    place.phi += over;
    camera.position.setFromSpherical(place.makeSafe()).add(controls.target);
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
    /** Whether somebody has moved the camera since it was put where it sees everything. */
    get moved() {
      return moved;
    },
    home() {
      release();
      moved = false;
      viewer.lookAtAll();
      controls.target.set(0, 0, 0);
      controls.minDistance = viewer.extent.radius / 200;
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
