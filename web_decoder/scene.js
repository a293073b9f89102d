/** Conversion of decoded images to the arrays of a scene, see docs/reference/format.md of kissgs. */

import { COEFFICIENTS, MAX_SIGNED_LOG, META, parseMeta, positionOf, YAML } from "./container.js";
import { crc32 } from "./zip.js";

/** @import { Attribute, Plane, Scene } from "./types.js" */
/** Values of the lowest and the highest level that occur in an image. @typedef {number[]} Range */

/** @type {(why: string) => never} */
const fail = (why) => {
  throw new Error(why);
};

export const MASK = "active_mask.webp";
const [KISSGS, CHECKSUM] = ["kissgs", "kissgs_crc32"];
/** The block "kissgs" of a container of another encoder. */
const OTHER_ENCODER = { version: "-", sh_degree: 0 };
const [HIGH, LOW, QUATS] = ["means_bytes_1.webp", "means_bytes_0.webp", "quaternions.webp"];
const [LABELS, CENTROIDS] = ["f_rest_labels.webp", "f_rest_centroids.webp"];
/** What each image gives, in the order of decoding: those of a coarse rendering first. @type {Record<string, Attribute[]>} */
const CONTENTS = {
  [MASK]: ["cells"],
  [HIGH]: ["high means"],
  "f_dc.webp": ["sh0"],
  "opacities.webp": ["opacities"],
  "scales.webp": ["scales"],
  [QUATS]: ["quats"],
  [LOW]: ["low means"],
  [LABELS]: ["labels"],
  [CENTROIDS]: ["centroids"],
};
export const PLANES = Object.keys(CONTENTS);
/** Number of images of a coarse rendering: mask, high bytes of positions, colours. */
const COARSE_PLANES = 3;
/** Images of a single field with 8-bit levels: the field and its number of channels. */
const SINGLE_FIELD = /** @type {Record<string, ["sh0" | "opacities" | "scales" | "quats", number]>} */ ({
  "f_dc.webp": ["sh0", 3],
  "opacities.webp": ["opacities", 1],
  "scales.webp": ["scales", 3],
  [QUATS]: ["quats", 4],
});
const [TILE_ROWS, TILE_COLUMNS] = [3, 5];
const VARIANT = JSON.stringify(["sog-xt", 3, "direct", "uv-codebook", 15, TILE_ROWS, TILE_COLUMNS]);
const WORLD = [0, 0, 0];
const MAX_GRID_SIDE = 13376;
const MAX_CODEBOOK_SIDE = 256;

/** @type {(json: Uint8Array) => any} */
function parse(json) {
  const meta = parseMeta(json);
  if (meta === null) fail(`${META} is not readable JSON`);
  return { ...meta, quats: { ...meta.quats }, shN: { ...meta.shN } };
}

/** Return the range of each channel; a single number is that of all channels. @type {(field: any, ends: string[], channels: number) => Range[]} */
function rangesOf(field, ends, channels) {
  const lists = ends.map((end) => [field?.[end]].flat());
  return Array.from({ length: channels }, (_, i) => {
    const range = lists.map((list) => list[list.length === channels ? i : 0]);
    if (!range.every((end) => Number.isFinite(end) && Number.isFinite(Math.fround(end)))) {
      fail(`${META}: ${ends.join(" and ")} are not ${channels} finite numbers`);
    }
    return range.map(Math.fround);
  });
}

/** Return the lowest and the highest level of an image's first channels. @type {(levels: Uint8Array | Uint16Array, channels: number) => Range} */
function observedLevels(levels, channels) {
  const seen = new Uint8Array(1 << (8 * levels.BYTES_PER_ELEMENT));
  for (let i = 0; i < levels.length; i += 4) for (let c = 0; c < channels; c++) seen[levels[i + c]] = 1;
  return [seen.indexOf(1), seen.lastIndexOf(1)];
}

/**
 * Return the values of all levels, channel by channel.
 * @param {Range} observed
 * @param {Range[]} ranges
 * @param {number} [levels]
 * @param {(value: number) => number} [finish]
 */
const valuesOf = ([lowest, highest], ranges, levels = 256, finish = (value) => value) =>
  new Float32Array(levels * ranges.length).map((_, i) => {
    const [low, high] = ranges[(i / levels) | 0];
    const level = Math.min(Math.max(i % levels, lowest), highest) - lowest;
    return finish(low + (level / Math.max(highest - lowest, 1)) * (high - low));
  });

/**
 * Whether a YAML file beside meta.json states the same, as in kissgs/sogxt/metadata.py: numbers by the word before
 * them, and the word after "model".
 * @param {Uint8Array} yaml
 * @param {Record<string, number[]>} numbers by word; those of the first two must be there
 * @param {Record<string, Range[]>} ranges by field
 */
function agrees(yaml, numbers, ranges) {
  /** @type {Record<string, number[]>} */
  const stated = Object.assign(Object.create(null), { model: [0] });
  let [field, before, key] = ["", "", ""];
  for (const word of new TextDecoder().decode(yaml).match(/[^ \t\r\n,:"'[\]{}]+/g) ?? []) {
    if (word.length <= 100 && /^[-+]?((0|[1-9]\d*)(\.\d*)?|\.\d+)(e[-+]?\d+)?$/i.test(word)) {
      (stated[key] ??= []).push(Number(word));
    } else if (word !== "-") {
      if (before === "input_fields") field = word;
      key = /^m(in|ax)_values$/.test(word) ? `${field} ${word}` : word;
      stated[key] = [];
      if (before === "model") stated[before] = [Number(/^antialiased$/i.test(word))];
      before = word;
    }
  }
  if (!stated.origin?.length) stated.origin = WORLD;
  const same = (/** @type {number[]} */ found, /** @type {number[]} */ wanted) =>
    found?.length === wanted.length && wanted.every((value, i) => value === found[i]);
  return (
    Object.entries(numbers).every(([word, wanted], i) => same(stated[word] ?? (i < 2 ? [] : wanted), wanted)) &&
    Object.entries(ranges).every(([name, channels]) =>
      ["min_values", "max_values"].every((end, i) =>
        same(
          (stated[`${name} ${end}`] ?? []).map(Math.fround),
          channels.map((range) => range[i]),
        ),
      ),
    )
  );
}

/** A scene that is assembled from decoded images, which may arrive in any order. */
export class Assembly {
  files = PLANES;
  coarse = COARSE_PLANES;
  /** @type {Record<string, Range[]>} */
  ranges = {};
  /** Pixels of position images until both have arrived. @type {Record<string, Uint8Array>} */
  bytes = {};

  /**
   * @param {Uint8Array} json
   * @param {number} maxGaussians
   * @param {Uint8Array} [yaml] a YAML file beside it, which must state the same
   */
  constructor(json, maxGaussians, yaml) {
    const meta = parse(json);
    const { count, gridSide, means, mask, quats, shN, format = "sog-xt", version = 3 } = meta;
    const { layout = "uv-codebook", coeffs = 15, tileRows = TILE_ROWS, tileCols = TILE_COLUMNS } = shN;
    const { centroidSide: codebookSide } = shN;
    const { encoding = "direct" } = quats;
    const variant = JSON.stringify([format, version, encoding, layout, coeffs, tileRows, tileCols]);
    if (variant !== VARIANT) fail(`${META}: unsupported variant of the format: ${variant}`);
    const files = JSON.stringify(mask?.files);
    if (!/^\["([^"]*\.)?webp"/.test(files)) fail(`${META}: mask.files are not WebP: ${files}`);
    // Other encoders omit the block "kissgs"; if it is present, it must be complete.
    const {
      version: encoder,
      sh_degree,
      crc32: checksums = {},
      origin = WORLD,
    } = (KISSGS in meta ? meta[KISSGS] : OTHER_ENCODER) ?? {};
    if (!/^"[\w.+-]{1,40}"$/.test(JSON.stringify(encoder)))
      fail(`${META}: ${KISSGS}.version is impossible: ${encoder}`);
    if (!(
      Array.isArray(origin) &&
      origin.length === 3 &&
      origin.every((x) => Number.isFinite(x) && Math.abs(x) <= 1e15)
    ))
      fail(`${META}: ${KISSGS}.origin is not three numbers up to 1e15`);
    const isObject = Object.getPrototypeOf(checksums ?? 0) === Object.prototype;
    for (const [name, value, min, max] of [
      ["count", count, 0, gridSide ** 2],
      ["gridSide", gridSide, 1, MAX_GRID_SIDE],
      ["shN.centroidSide", codebookSide, 1, MAX_CODEBOOK_SIDE],
      [`${KISSGS}.sh_degree`, sh_degree, 0, 3],
      ...Object.entries(isObject ? checksums : { crc32: NaN }).map((entry) => [...entry, 0, 2 ** 32 - 1]),
    ]) {
      if (!(Number.isInteger(value) && value >= min && value <= max)) fail(`${META}: ${name} is impossible: ${value}`);
    }
    // By the size rule, padding is less than half of any grid except the smallest ones.
    if (Math.max(count, (gridSide ** 2 - 64) / 2) > maxGaussians) {
      fail(`larger than ${maxGaussians} Gaussians need, the most allowed (maxGaussians)`);
    }
    for (const [file, [field, channels]] of Object.entries(SINGLE_FIELD)) {
      this.ranges[file] = rangesOf(meta[field], ["mins", "maxs"], channels);
    }
    this.ranges[HIGH] = rangesOf(means, ["mins", "maxs"], 1);
    if (this.ranges[HIGH][0].some((end) => Math.abs(end) > MAX_SIGNED_LOG)) fail(`${META}: means beyond float32`);
    const rest = (this.ranges[CENTROIDS] = rangesOf(shN, ["centroidsMins", "centroidsMaxs"], 45));
    const used = Math.max(...rest.map((range, i) => (range.some(Boolean) ? 1 + (i % 15) : 0)));
    const inferred = COEFFICIENTS.findIndex((coefficients) => coefficients >= used);
    const degree = Math.max(inferred, sh_degree);
    const sizes = [count, gridSide, codebookSide, degree];
    const numbers = new Float64Array([...sizes, ...Object.values(this.ranges).flat(2)]);
    const checksum = crc32(new Uint8Array(numbers.buffer));
    if (CHECKSUM in meta && checksum !== meta[CHECKSUM]) {
      fail(`${META} is damaged: its numbers do not give its ${CHECKSUM}`);
    }
    const words = {
      ...{ grid_side: [gridSide], f_rest_centroids_side: [codebookSide], count: [count], sh_degree: [degree] },
      ...{ [CHECKSUM]: [checksum], origin, model: [Number(/^"antialiased"$/i.test(JSON.stringify(meta.model)))] },
    };
    const fields = Object.entries(this.ranges).map(([file, range]) => [
      file === HIGH ? "means" : file.slice(0, -5),
      range,
    ]);
    if (yaml && !agrees(yaml, words, Object.fromEntries(fields))) {
      fail(`${YAML} and ${META} do not state the same: one is damaged, or of another scene`);
    }
    /** @type {Scene} */
    this.scene = {
      ...{
        count,
        degree,
        gridSide,
        codebookSide,
        meta,
        contents: CONTENTS,
        planes: {},
        sizes: { [META]: json.length },
      },
      ...{ means: new Float32Array(), quats: new Float32Array(), scales: new Float32Array(), sh0: new Float32Array() },
      ...{ opacities: new Float32Array(), centroids: new Float32Array() },
      ...{ labels: new Uint16Array(), cells: new Uint32Array() },
    };
  }

  /** @param {string} file */
  expect(file) {
    const { gridSide, codebookSide, meta } = this.scene;
    const [width, height] =
      file === CENTROIDS ? [TILE_COLUMNS * codebookSide, TILE_ROWS * codebookSide] : [gridSide, gridSide];
    return { pixels: width * height, width, height, checksum: meta.kissgs?.crc32?.[file] };
  }

  /**
   * Put a decoded image into the scene; the mask must be the first.
   * @param {string} file
   * @param {Plane} plane
   */
  put(file, { rgba }) {
    if (file === MASK) this.putMask(rgba);
    else if (file === LABELS) this.putLabels(rgba);
    else if (file === CENTROIDS) this.putCentroids(rgba);
    else if (file in SINGLE_FIELD) this.putField(file, rgba);
    else this.putPositions(file, rgba);
  }

  /** @param {Uint8Array} rgba */
  putMask(rgba) {
    const { scene } = this;
    const cells = new Uint32Array(scene.gridSide ** 2);
    let count = 0;
    for (let cell = 0; cell < cells.length; cell++) if (rgba[4 * cell]) cells[count++] = cell;
    if (count !== scene.count) fail(`${MASK} marks ${count} Gaussians; ${META} declares ${scene.count}`);
    scene.cells = cells.slice(0, count);
    scene.means = new Float32Array(3 * count);
    for (const [field, channels] of Object.values(SINGLE_FIELD)) scene[field] = new Float32Array(channels * count);
    for (let i = 0; i < count; i++) scene.quats[4 * i] = 1;
    scene.labels = new Uint16Array(count);
  }

  /** @type {(file: string, rgba: Uint8Array) => void} */
  putField(file, rgba) {
    const [field, channels] = SINGLE_FIELD[file];
    const { cells, [field]: out } = this.scene;
    const values = valuesOf(observedLevels(rgba, channels), this.ranges[file]);
    for (let i = 0, at = 0; i < cells.length; i++) {
      for (let c = 0; c < channels; c++) out[at++] = values[(c << 8) | rgba[4 * cells[i] + c]];
    }
  }

  /** @type {(file: string, rgba: Uint8Array) => void} */
  putPositions(file, rgba) {
    this.bytes[file] = rgba;
    const { [HIGH]: high, [LOW]: low } = this.bytes;
    if (!high) return;
    if (low) this.bytes = {};
    const { cells, means } = this.scene;
    const levels = new Uint16Array(high.length);
    for (let i = 0; i < levels.length; i++) levels[i] = (high[i] << 8) | (low ? low[i] : 128);
    const values = valuesOf(observedLevels(levels, 3), this.ranges[HIGH], 1 << 16, positionOf);
    for (let i = 0, at = 0; i < cells.length; i++) {
      for (let c = 0; c < 3; c++) means[at++] = values[levels[4 * cells[i] + c]];
    }
  }

  /** @param {Uint8Array} rgba */
  putLabels(rgba) {
    const { cells, labels, codebookSide } = this.scene;
    for (let i = 0; i < rgba.length; i += 4) {
      if (rgba[i + 1] * codebookSide + rgba[i] >= codebookSide ** 2) fail(`${LABELS} points outside the codebook`);
    }
    for (let i = 0; i < labels.length; i++) labels[i] = rgba[4 * cells[i] + 1] * codebookSide + rgba[4 * cells[i]];
  }

  /** @param {Uint8Array} rgba */
  putCentroids(rgba) {
    const { codebookSide: side, degree } = this.scene;
    const coefficients = COEFFICIENTS[degree];
    const centroids = (this.scene.centroids = new Float32Array(side * side * coefficients * 3));
    const values = valuesOf(observedLevels(rgba, 3), this.ranges[CENTROIDS]);
    for (let entry = 0, at = 0; entry < side * side; entry++) {
      const corner = ((entry / side) | 0) * side * TILE_COLUMNS + (entry % side);
      for (let k = 0; k < coefficients; k++) {
        const pixel = corner + side * (((k / TILE_COLUMNS) | 0) * side * TILE_COLUMNS + (k % TILE_COLUMNS));
        for (let c = 0; c < 3; c++) centroids[at++] = values[((15 * c + k) << 8) | rgba[4 * pixel + c]];
      }
    }
  }
}
