/** Conversion of the decoded images of a SOG container to the arrays of a scene, see docs/reference/formats.md of kissgs. */

import { COEFFICIENTS, MAX_SIGNED_LOG, META, parseMeta, positionOf } from "./container.js";
import { decodePng, isPng } from "./png.js";

/** @import { Attribute, Plane, Scene, Task } from "./types.js" */

/** @type {(why: string) => never} */
const fail = (why) => {
  throw new Error(why);
};

/** Pixels that images may have beyond four per Gaussian: encoders may round sides up to powers of two. */
const FREE_PIXELS = 1 << 20;
/** Entries of the SH codebook in a row of its image. */
const ENTRIES_PER_ROW = 64;
const MAX_ENTRIES = 1 << 16;
/** Alpha of a rotation whose largest component is w; 253 to 255 are x, y, z. */
const FIRST_TAG = 252;
/** Logits of the opacities 1e-6 and 1 - 1e-6, the lowest and the highest. */
const [MIN_LOGIT, MAX_LOGIT] = [-13.815509796142578, 13.80231761932373];
/** Number of images of a coarse rendering: high bytes of positions, colours. */
const COARSE_IMAGES = 2;
/** Variants of the renderer that draw 3D Gaussians, as in kissgs/sog/metadata.py. */
const MODELS = ["antialiased", "3dgs", "classic", "default"];
const BYTES = Array.from({ length: 256 }, (_, i) => i);
const COMPONENTS = BYTES.map((level) => (level / 255 - 0.5) * Math.SQRT2);

/** @type {(value: any) => boolean} */
const isNumber = (value) => typeof value === "number" && Math.abs(value) < 3e38;

/** Return a whole number of the metadata. @type {(value: any, where: string, least: number, most: number) => number} */
const whole = (value, where, least, most) =>
  Number.isInteger(value) && value >= least && value <= most
    ? value
    : fail(`${META}: ${where} is not a whole number from ${least} to ${most}`);

/** Return a list of numbers; a single one stands for a list of one. @type {(value: any, where: string, count: number) => number[]} */
function numbers(value, where, count) {
  const list = [value].flat();
  return list.length === count && list.every(isNumber) ? list : fail(`${META}: ${where} are not ${count} numbers`);
}

/** Return the names of a field's images. @type {(meta: any, field: string, count: number) => string[]} */
function filesOf(meta, field, count) {
  const names = meta[field]?.files;
  const valid = (/** @type {any} */ name) =>
    typeof name === "string" &&
    /^[^\0-\x1f/\\:?#][^\0-\x1f\\:?#]{0,254}$/.test(name) &&
    !/(^|\/)\.\.?(\/|$)/.test(name);
  if (!Array.isArray(names) || names.length !== count || !names.every(valid))
    fail(`${META}: ${field}.files does not name ${count} image${count > 1 ? "s" : ""}`);
  return names;
}

/** Return the values of levels that are evenly spaced between two ends. @type {(low: number, high: number) => number[]} */
const spread = (low, high) => BYTES.map((level) => low + (high - low) * (level / 255));

/** Values of all levels, for each channel; version 1 has ranges. @type {(meta: any, field: string, channels: number) => number[][]} */
function rangesOf(meta, field, channels) {
  const [low, high] = ["mins", "maxs"].map((end) => numbers(meta[field]?.[end], `${field}.${end}`, channels));
  return low.map((start, channel) => spread(start, high[channel]));
}

/**
 * Return the values of all levels, NaN where there is none; version 2 has codebooks. Old encoders wrote null for the first
 * value, which the mean step gives.
 * @type {(meta: any, field: string) => number[]}
 */
function codebookOf(meta, field) {
  const book = meta[field]?.codebook;
  if (!Array.isArray(book) || book.length < 1 || book.length > 256)
    fail(`${META}: ${field}.codebook is not a list of up to 256 numbers`);
  if (!book.every((value) => value === null || isNumber(value)))
    fail(`${META}: ${field}.codebook has something else than numbers`);
  const table = BYTES.map((level) => book[level] ?? NaN);
  if (book[0] === null) table[0] = table[1] + (table[1] - table[255]) / 255;
  return table;
}

/** @type {(logit: number) => number} */
const clampLogit = (logit) => Math.min(Math.max(logit, MIN_LOGIT), MAX_LOGIT);
const LOGITS = BYTES.map((level) => clampLogit(Math.log(level / 255) - Math.log1p(-level / 255)));

/**
 * Return what the metadata says, equally for both versions.
 * @param {Uint8Array} json
 */
function layoutOf(json) {
  const meta = parseMeta(json);
  if (Object.getPrototypeOf(meta ?? 0) !== Object.prototype) fail(`${META} is not the metadata of a SOG container`);
  const { version = 1, shN } = meta;
  if (version !== 1 && version !== 2) fail(`${META}: unsupported version ${JSON.stringify(version)}; 1 and 2 are read`);
  const old = version === 1;
  const model = [meta.model, meta.asset?.model].find((name) => name && typeof name === "string");
  if (!old && model && !MODELS.includes(model.toLowerCase()))
    fail(`${META} names the model "${model.slice(0, 40)}", which is not supported`);
  const rest = (shN ?? null) !== null;
  const count = old ? meta.means?.shape?.[0] : meta.count;
  const [low, high] = ["mins", "maxs"].map((end) => numbers(meta.means?.[end], `means.${end}`, 3));
  if ([...low, ...high].some((end) => Math.abs(end) > MAX_SIGNED_LOG)) fail(`${META}: means beyond float32`);
  if (old && (meta.quats?.encoding ?? "quaternion_packed") !== "quaternion_packed")
    fail(`${META}: quats.encoding is not quaternion_packed`);
  const bands = old ? [9, 24, 45].indexOf(shN?.shape?.[1]) + 1 : shN?.bands;
  const same = (/** @type {string} */ field) => Array(3).fill(codebookOf(meta, field));
  const colours = old ? rangesOf(meta, "sh0", 4) : [...same("sh0"), LOGITS];
  return {
    meta,
    count: whole(count, old ? "means.shape[0]" : "count", 0, 2 ** 32),
    degree: rest ? whole(bands, old ? "shN.shape" : "shN.bands", 1, 3) : 0,
    /** Null: as many as the image has. */
    entries: !rest || old ? null : whole(shN.count, "shN.count", 1, MAX_ENTRIES),
    positions: low.map((start, axis) => ({ start, length: high[axis] - start })),
    scales: old ? rangesOf(meta, "scales", 3) : same("scales"),
    colours: colours.slice(0, 3),
    logits: colours[3].map(clampLogit),
    coefficients: rest ? (old ? rangesOf(meta, "shN", 1)[0] : codebookOf(meta, "shN")) : [],
    files: {
      means: filesOf(meta, "means", 2),
      ...{ scales: filesOf(meta, "scales", 1), quats: filesOf(meta, "quats", 1), sh0: filesOf(meta, "sh0", 1) },
      shN: rest ? filesOf(meta, "shN", 2) : [],
    },
  };
}

/** A scene that is assembled from the images of a SOG container; a Gaussian has the pixel of its number. */
export class SogAssembly {
  coarse = COARSE_IMAGES;
  /** Pixels of position images until both have arrived. @type {{high?: Uint8Array, low?: Uint8Array}} */
  bytes = {};

  /**
   * @param {Uint8Array} json
   * @param {number} maxGaussians
   */
  constructor(json, maxGaussians) {
    const layout = (this.layout = layoutOf(json));
    const { count, degree, meta, entries } = layout;
    if (count > maxGaussians) fail(`${count} Gaussians, more than the ${maxGaussians} allowed (maxGaussians)`);
    const { means, sh0, scales, quats, shN } = layout.files;
    const [centroids, labels] = shN;
    this.entries = entries;
    this.largestLabel = 0;
    /** What each image gives, in the order of decoding. @type {[string, Attribute[]][]} */
    const images = [
      [means[1], ["cells", "high means"]],
      [sh0[0], ["sh0", "opacities"]],
      [scales[0], ["scales"]],
      [quats[0], ["quats"]],
      [means[0], ["low means"]],
    ];
    if (degree) images.push([labels, ["labels"]], [centroids, ["centroids"]]);
    this.files = images.map(([file]) => file);
    if (new Set(this.files).size < this.files.length) fail(`${META} names an image twice`);
    const contents = Object.fromEntries(images);
    /** @type {Scene} */
    this.scene = {
      ...{ count, degree, gridSide: 0, codebookSide: 0, meta, contents, planes: {}, sizes: { [META]: json.length } },
      ...{ means: new Float32Array(), quats: new Float32Array(), scales: new Float32Array(), sh0: new Float32Array() },
      ...{ opacities: new Float32Array(), centroids: new Float32Array() },
      ...{ labels: new Uint16Array(), cells: new Uint32Array() },
    };
  }

  /** @param {string} file */
  expect(file) {
    const { contents, count, degree } = this.scene;
    const most = contents[file][0] === "centroids" ? MAX_ENTRIES * COEFFICIENTS[degree] : 4 * count + FREE_PIXELS;
    return { pixels: most };
  }

  /** Decode a PNG, which few containers have, in the caller's thread. @param {Task} task */
  decode({ file, bytes, pixels }) {
    return isPng(bytes) ? decodePng(bytes, pixels).catch((error) => fail(`${file}: ${error.message}`)) : undefined;
  }

  /**
   * Put a decoded image into the scene; that of the positions' high bytes must be the first.
   * @param {string} file
   * @param {Plane} plane
   */
  put(file, plane) {
    const kind = this.scene.contents[file][0];
    if (kind === "centroids") return this.putCentroids(file, plane);
    const { count } = this.scene;
    const pixels = plane.width * plane.height;
    if (pixels < count) fail(`${file}: ${plane.width} x ${plane.height} pixels are too few for ${count} Gaussians`);
    if (kind === "cells") this.begin(plane.width);
    if (kind === "cells" || kind === "low means") this.putPositions(kind === "cells" ? "high" : "low", plane.rgba);
    else if (kind === "labels") this.putLabels(plane.rgba);
    else if (kind === "quats") this.putQuats(file, plane.rgba);
    else this.putLevels(file, plane.rgba, kind === "sh0" ? "sh0" : "scales");
  }

  /** Allocate the arrays. @param {number} width */
  begin(width) {
    const { scene } = this;
    const { count, degree } = scene;
    scene.gridSide = width;
    scene.cells = Uint32Array.from({ length: count }, (_, i) => i);
    for (const field of /** @type {const} */ (["means", "scales", "sh0"])) scene[field] = new Float32Array(3 * count);
    scene.opacities = new Float32Array(count);
    scene.quats = new Float32Array(4 * count);
    for (let i = 0; i < count; i++) scene.quats[4 * i] = 1;
    scene.labels = new Uint16Array(degree ? count : 0);
  }

  /** @type {(part: "high" | "low", rgba: Uint8Array) => void} */
  putPositions(part, rgba) {
    this.bytes[part] = rgba;
    const { high, low } = this.bytes;
    if (!high) return;
    if (low) this.bytes = {};
    const { count, means } = this.scene;
    this.layout.positions.forEach(({ start, length }, axis) => {
      const table = new Float32Array(1 << 16).map((_, level) => positionOf(start + length * (level / 65535)));
      for (let i = 0, at = axis; i < count; i++, at += 3) {
        means[at] = table[(high[4 * i + axis] << 8) | (low ? low[4 * i + axis] : 128)];
      }
    });
  }

  /** @type {(file: string, rgba: Uint8Array, field: "sh0" | "scales") => void} */
  putLevels(file, rgba, field) {
    const { layout, scene } = this;
    const { count, [field]: out, opacities } = scene;
    (field === "sh0" ? layout.colours : layout.scales).forEach((values, channel) => {
      const table = Float32Array.from(values);
      for (let i = 0; i < count; i++) out[3 * i + channel] = table[rgba[4 * i + channel]];
    });
    if (out.some(Number.isNaN)) fail(`${file} uses a level for which its codebook has no number`);
    if (field === "sh0") for (let i = 0; i < count; i++) opacities[i] = layout.logits[rgba[4 * i + 3]];
  }

  /** @type {(file: string, rgba: Uint8Array) => void} */
  putQuats(file, rgba) {
    const { count, quats } = this.scene;
    for (let i = 0; i < count; i++) {
      const missing = rgba[4 * i + 3] - FIRST_TAG;
      if (missing < 0) fail(`${file} has a rotation whose alpha is ${rgba[4 * i + 3]}; ${FIRST_TAG} to 255 are valid`);
      let square = 0;
      for (let slot = 0, channel = 0; slot < 4; slot++) {
        if (slot === missing) continue;
        const component = COMPONENTS[rgba[4 * i + channel++]];
        square += component * component;
        quats[4 * i + slot] = component;
      }
      quats[4 * i + missing] = Math.sqrt(Math.max(0, 1 - square));
    }
  }

  /** @param {Uint8Array} rgba */
  putLabels(rgba) {
    const { count, labels } = this.scene;
    for (let i = 0; i < count; i++) {
      labels[i] = (rgba[4 * i + 1] << 8) | rgba[4 * i];
      this.largestLabel = Math.max(this.largestLabel, labels[i]);
    }
    this.checkLabels();
  }

  /** @type {(file: string, plane: Plane) => void} */
  putCentroids(file, { width, height, rgba }) {
    const { scene, layout } = this;
    const coefficients = COEFFICIENTS[scene.degree];
    this.entries ??= height * ENTRIES_PER_ROW;
    const rows = Math.ceil(this.entries / ENTRIES_PER_ROW);
    const wide = ENTRIES_PER_ROW * coefficients;
    if (width !== wide || height < rows || height > MAX_ENTRIES / ENTRIES_PER_ROW)
      fail(`${file}: ${width} x ${height} pixels; ${this.entries} entries need ${wide} x ${rows}`);
    this.checkLabels();
    const table = Float32Array.from(layout.coefficients);
    const centroids = new Float32Array(3 * coefficients * this.entries); // entry by entry, as the pixels are
    for (let pixel = 0, at = 0; at < centroids.length; pixel++) {
      for (let c = 0; c < 3; c++) centroids[at++] = table[rgba[4 * pixel + c]];
    }
    if (centroids.some(Number.isNaN)) fail(`${file} uses a level for which its codebook has no number`);
    scene.centroids = centroids;
  }

  /** Check the labels, once both they and the number of entries are known. */
  checkLabels() {
    if (this.entries !== null && this.largestLabel >= this.entries)
      fail(`${this.layout.files.shN[1]} points outside the codebook of ${this.entries} entries`);
  }
}
