/** Camera poses. Scenes are in COLMAP's frame, with y down and z forward; three.js has y up and z backward. */

import { Matrix4, Vector3 } from "three";
import { viewOf } from "./coverage.js";

/**
 * @typedef {{viewmat: number[][], K: number[][], width: number, height: number}} Pinhole `viewmat`: world to camera, as
 *   in OpenCV; `K`: pixels, from the upper left corner of the image
 */

/** From COLMAP's frame to that of three.js, and back. */
const FLIP = new Matrix4().makeScale(1, -1, -1);

/**
 * Move a camera to a view of the scene; return what it then turns about.
 * @param {import("three").PerspectiveCamera} camera
 * @param {import("./view.js").View} view
 * @param {number[]} centre of the scene, which is the origin of the viewer
 */
export function openAt(camera, { eye, target, up, fov }, centre) {
  const [position, middle] = [eye, target].map((point) =>
    new Vector3(...point).sub(new Vector3(...centre)).applyMatrix4(FLIP),
  );
  camera.up.set(up[0], -up[1], -up[2]);
  camera.position.copy(position);
  const distance = position.distanceTo(middle);
  [camera.near, camera.far] = [distance / 1000, distance * 1e5];
  camera.lookAt(middle);
  setAngle(camera, fov);
  return middle;
}

/**
 * Set the angle of view along the shorter side of the image, without what buttons cover.
 * @param {import("three").PerspectiveCamera} camera
 * @param {number} fov degrees
 */
export function setAngle(camera, fov) {
  const { fullHeight: height, offsetY } = camera.view ?? { fullHeight: 1, offsetY: 0 };
  const slope = Math.tan((fov * Math.PI) / 360) / Math.min(1 - (2 * offsetY) / height, camera.aspect);
  camera.fov = (360 / Math.PI) * Math.atan(slope);
  camera.updateProjectionMatrix();
}

/**
 * Set the exact pose and intrinsics of a camera.
 * @param {import("three").PerspectiveCamera} camera
 * @param {Pinhole} pinhole
 * @param {number[]} centre of the scene, which is the origin of the viewer
 */
export function setPinhole(camera, { viewmat, K, width, height }, [x, y, z]) {
  const [near, far] = [0.01, 1e5];
  const [fx, , cx, , fy, cy] = K.flat();
  const view = rowMajor(viewmat.flat())
    .multiply(new Matrix4().makeTranslation(x, y, z))
    .premultiply(FLIP)
    .multiply(FLIP);
  view.invert().decompose(camera.position, camera.quaternion, new Vector3());
  [camera.near, camera.far] = [near, far];
  camera.projectionMatrix = rowMajor([
    ...[(2 * fx) / width, 0, 1 - (2 * cx) / width, 0],
    ...[0, (2 * fy) / height, (2 * cy) / height - 1, 0],
    ...[0, 0, -(far + near) / (far - near), (-2 * far * near) / (far - near)],
    ...[0, 0, -1, 0],
  ]);
  camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
}

/**
 * Return what a camera sees of a scene.
 * @param {import("three").PerspectiveCamera} camera
 * @param {number[]} centre of the scene, which is the origin of the viewer
 * @param {number} width pixels
 * @param {number} height
 */
export function sightOf(camera, [x, y, z], width, height) {
  camera.updateMatrixWorld();
  const toViewer = new Matrix4().makeTranslation(-x, -y, -z).premultiply(FLIP);
  const eye = camera.position.clone().applyMatrix4(toViewer.clone().invert());
  const matrix = toViewer.premultiply(camera.matrixWorldInverse).premultiply(camera.projectionMatrix);
  return viewOf(matrix.elements, eye.toArray(), (camera.projectionMatrix.elements[5] * height) / 2, width * height);
}

/** @param {number[]} values */
const rowMajor = (values) => new Matrix4().fromArray(values).transpose();
