/** The marker of one Gaussian: the wires of its ellipsoid at three sigma, and a ring where that is too small to see. */

import {
  CanvasTexture,
  Group,
  LineBasicMaterial,
  LineSegments,
  SphereGeometry,
  Sprite,
  SpriteMaterial,
  WireframeGeometry,
} from "three";

const COLOUR = "#ffb020"; // seen on black as on white, and rare in scenes
const SIGMAS = 3;
const RING = 0.06; // of the height of the picture, more or less

/** Drawn last and whatever is in front of it. */
const ABOVE = { depthTest: false, depthWrite: false, transparent: true };

export function marker() {
  const wires = new LineSegments(
    new WireframeGeometry(new SphereGeometry(1, 16, 10)),
    new LineBasicMaterial({ color: COLOUR, opacity: 0.85, ...ABOVE }),
  );
  const ring = new Sprite(new SpriteMaterial({ map: ringTexture(), sizeAttenuation: false, ...ABOVE }));
  ring.scale.setScalar(RING);
  const object = new Group();
  object.visible = false;
  object.quaternion.set(1, 0, 0, 0); // as the scene
  object.add(wires, ring);
  for (const part of object.children) part.renderOrder = 1;

  return {
    object,
    /**
     * @param {import("./scene.js").Gaussian | null} gaussian null hides it
     * @param {number[]} centre of the scene
     */
    show(gaussian, centre) {
      object.visible = gaussian !== null;
      if (!gaussian) return;
      const [x, y, z] = gaussian.mean.map((value, axis) => value - centre[axis]);
      wires.position.set(x, y, z);
      ring.position.set(x, y, z);
      const [qw, qx, qy, qz] = gaussian.rotation;
      wires.quaternion.set(qx, qy, qz, qw);
      const [sx, sy, sz] = gaussian.deviations.map((deviation) => SIGMAS * deviation);
      wires.scale.set(sx, sy, sz);
    },
  };
}

function ringTexture() {
  const canvas = document.createElement("canvas");
  canvas.width = canvas.height = 64;
  const context = /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d"));
  for (const [colour, width] of /** @type {[string, number][]} */ ([
    ["rgb(0 0 0 / 55%)", 8],
    [COLOUR, 4],
  ])) {
    context.strokeStyle = colour;
    context.lineWidth = width;
    context.beginPath();
    context.arc(32, 32, 26, 0, 2 * Math.PI);
    context.stroke();
  }
  const texture = new CanvasTexture(canvas);
  texture.colorSpace = "srgb";
  return texture;
}
