/** The marker of one Gaussian: a wireframe of its ellipsoid at three sigma, and a ring in case that is too small. */

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

const COLOUR = "#ffb020"; // visible on black and white, and rare in scenes
const SIGMAS = 3;
const RING = 0.06; // share of the height of the image, about

/** Drawn last, in front of everything. */
const ON_TOP = { depthTest: false, depthWrite: false, transparent: true };

export function marker() {
  const wires = new LineSegments(
    new WireframeGeometry(new SphereGeometry(1, 16, 10)),
    new LineBasicMaterial({ color: COLOUR, opacity: 0.85, ...ON_TOP }),
  );
  const ring = new Sprite(new SpriteMaterial({ map: ringTexture(), sizeAttenuation: false, ...ON_TOP }));
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
