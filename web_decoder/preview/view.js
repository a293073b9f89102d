/** The view that a scene opens with: the recorded one, else one that frames what is dense, see docs/reference/format.md. */

import { quantiles } from "./extent.js";

/**
 * @typedef {object} View in the scene's frame
 * @property {number[]} eye
 * @property {number[]} target what the camera turns about, in the middle of the image
 * @property {number[]} up unit vector
 * @property {number} fov angle of view from top to bottom, and from side to side where that is narrower, degrees
 */

/** Up in scenes that do not say it: y points down. */
const UP = [0, -1, 0];
const FIELD_OF_VIEW = 50;
const SAMPLES = 2500;
/** Largest sine of the angle between up and the line of sight: steeper views have no upright image. */
const STEEPEST = 0.9999;

/** Quantiles that are framed, with a margin, on each side of the image and in depth. */
const [SIDE, MARGIN] = [0.01, 1.15];
/** Distance beyond which floaters and skies are not framed, in units of the one of three quarters of the opacity. */
const REACH = 3;
/** Directions that are tried, of how much rise for a step ahead. */
const [DIRECTIONS, RISE] = [16, 0.25];
/** Side of the grid that tells what is visible. */
const GRID = 48;

/** @type {(one: number[], other: number[]) => number} */
const dot = (one, other) => one.reduce((sum, value, axis) => sum + value * other[axis], 0);
/** @type {(one: number[], other: number[]) => number[]} */
const minus = (one, other) => one.map((value, axis) => value - other[axis]);
/** @type {(from: number[], direction: number[], length: number) => number[]} */
const along = (from, direction, length) => from.map((value, axis) => value + length * direction[axis]);
/** @type {(vector: number[]) => number[]} */
const unit = (vector) => vector.map((value) => value / Math.hypot(...vector));
/** @type {(one: number[], other: number[]) => number[]} */
const cross = ([a, b, c], [x, y, z]) => [b * z - c * y, c * x - a * z, a * y - b * x];

/**
 * Return the view that metadata records, or null if it has none, or one that is impossible.
 * @param {any} view
 * @returns {View | null}
 */
export function checkedView(view) {
  const { eye, target, up, fov } = view ?? {};
  const isPoint = (/** @type {any} */ values) =>
    Array.isArray(values) &&
    values.length === 3 &&
    values.every((value) => Number.isFinite(value) && Math.abs(value) < 1e15);
  if (![eye, target, up].every(isPoint) || !(Number.isFinite(fov) && fov >= 1 && fov <= 150)) return null;
  const sight = minus(target, eye);
  const size = Math.hypot(...eye, ...target);
  if (!(Math.hypot(...sight) > 1e-9 * size) || !(Math.hypot(...up) > 1e-6)) return null;
  return Math.abs(dot(unit(sight), unit(up))) < STEEPEST ? { eye, target, up: unit(up), fov } : null;
}

/**
 * Return a view of a whole extent, from the front and slightly from above.
 * @param {import("./extent.js").Extent} extent
 * @returns {View}
 */
export function viewOfExtent({ centre, radius }) {
  const distance = radius / Math.sin((FIELD_OF_VIEW * Math.PI) / 360);
  return { eye: along(centre, unit([0, -RISE, -1]), distance), target: centre, up: UP, fov: FIELD_OF_VIEW };
}

/**
 * Return a view of a scene without its floaters, from the side and slightly from above where most of it is visible.
 * @param {number} count
 * @param {(index: number) => ArrayLike<number>} mean position of a Gaussian
 * @param {(index: number) => number} weight opacity: not times area, since skies and floaters are large
 * @returns {View}
 */
export function viewOfDense(count, mean, weight) {
  const step = Math.max(1, Math.floor(count / SAMPLES));
  /** @type {Points} */
  const all = { points: [], weights: [] };
  for (let i = 0; i < count; i += step) {
    const point = Array.from(mean(i));
    if (!point.every(Number.isFinite) || !(weight(i) > 0)) continue;
    all.points.push(point);
    all.weights.push(weight(i));
  }
  const middle = medianOf(all);
  const reach = REACH * quantiles(distancesFrom(middle, all), all.weights, [0.75])[0];
  const { eye, target } = bestFrame(all, middle, reach);
  return { eye, target, up: UP, fov: FIELD_OF_VIEW };
}

/**
 * @typedef {{points: number[][], weights: number[]}} Points
 * @typedef {{eye: number[], target: number[], axes: number[][]}} Frame axes: right, down and back of the camera
 */

/** @type {(points: Points) => number[]} */
const medianOf = ({ points, weights }) =>
  [0, 1, 2].map(
    (axis) =>
      quantiles(
        points.map((point) => point[axis]),
        weights,
        [0.5],
      )[0],
  );

/** @type {(centre: number[], points: Points) => number[]} */
const distancesFrom = (centre, { points }) => points.map((point) => Math.hypot(...minus(point, centre)));

/**
 * Return the camera, of those around a centre that frame what is within a radius, that sees most of it.
 * @param {Points} all
 * @param {number[]} centre
 * @param {number} radius
 * @returns {Frame}
 */
function bestFrame(all, centre, radius) {
  const inside = distancesFrom(centre, all).map((distance) => distance <= radius);
  const weights = all.weights.filter((_, i) => inside[i]);
  const offsets = all.points.filter((_, i) => inside[i]).map((point) => minus(point, centre));
  const frames = Array.from({ length: DIRECTIONS }, (_, n) => {
    const turn = ((n % 2 ? 1 : -1) * Math.ceil(n / 2) * 2 * Math.PI) / DIRECTIONS; // from the front to both sides
    const back = unit([-Math.sin(turn), -RISE, -Math.cos(turn)]);
    const right = unit(cross(UP, back));
    return framed(offsets, weights, centre, [right, cross(right, back), back]);
  });
  const seen = frames.map((frame) => visibleFrom(frame, all, centre, radius));
  return frames[seen.indexOf(Math.max(...seen))];
}

/**
 * Return the camera that frames points in a square image.
 * @param {number[][]} offsets of the points from a centre
 * @param {number[]} weights
 * @param {number[]} centre
 * @param {number[][]} axes
 * @returns {Frame}
 */
function framed(offsets, weights, centre, axes) {
  let target = centre;
  const halves = axes.map((axis) => {
    const [low, high] = quantiles(
      offsets.map((offset) => dot(offset, axis)),
      weights,
      [SIDE, 1 - SIDE],
    );
    target = along(target, axis, (low + high) / 2);
    return (high - low) / 2;
  });
  const size = Math.max(halves[0], halves[1], halves[2] / 4) || 1;
  const distance = (MARGIN * size) / Math.tan((FIELD_OF_VIEW * Math.PI) / 360) + halves[2];
  return { eye: along(target, axes[2], distance), target, axes };
}

/**
 * Return how many points within a radius a camera sees: those in front of all others at their place in a coarse image.
 * @param {Frame} frame
 * @param {Points} all
 * @param {number[]} centre
 * @param {number} radius
 */
function visibleFrom({ eye, axes: [right, down, back] }, all, centre, radius) {
  const scale = GRID / (2 * Math.tan((FIELD_OF_VIEW * Math.PI) / 360));
  const places = all.points.map((point) => {
    const offset = minus(point, eye);
    const depth = -dot(offset, back);
    const [x, y] = [right, down].map((axis) => Math.floor(GRID / 2 + (scale * dot(offset, axis)) / depth));
    return { depth, cell: depth > 0 && Math.min(x, y) >= 0 && Math.max(x, y) < GRID ? GRID * y + x : -1 };
  });
  const first = new Float64Array(GRID * GRID).fill(Infinity);
  for (const { depth, cell } of places) if (cell >= 0) first[cell] = Math.min(first[cell], depth);
  const distances = distancesFrom(centre, all);
  return places.filter(({ depth, cell }, i) => cell >= 0 && distances[i] <= radius && depth <= 1.02 * first[cell])
    .length;
}
