/**
 * Decoder of lossless WebP (VP8L, RFC 9649) in JavaScript: bit-exact in pages, workers and Node.js, unlike canvases.
 *
 * A pixel is one 32-bit number, from the lowest byte: red, green, blue, alpha.
 */

/** Error of a WebP file; the message is a sentence. */
export class WebPError extends Error {
  name = "WebPError";
}

/** @type {(why: string) => never} */
const fail = (why) => {
  throw new WebPError(why);
};

/** Bits of the first lookup in the table of a prefix code; longer codes take a second lookup. */
const ROOT_BITS = 9;
/** Longest code, bits. */
const MAX_LENGTH = 15;

/** Largest size of an image's tables: 6,000 groups of the largest codes. Encoders write some hundred small ones. */
const MAX_ENTRIES = 1 << 24;

const LITERALS = 256;
const LENGTHS = 24;
/** Alphabet sizes of the five codes of a group: green with lengths (and cached colours), red, blue, alpha, distances. */
const ALPHABETS = [LITERALS + LENGTHS, 256, 256, 256, 40];
/** Bit offsets of green, red, blue and alpha in a pixel. */
const SHIFTS = [8, 0, 16, 24];
const ORDER_OF_LENGTHS = [17, 18, 0, 1, 2, 3, 4, 5, 16, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15];
const OPAQUE_BLACK = 0xff000000 | 0;
/** Words of zeros after the bitstream: reading beyond the end of an array is slow, even once. */
const PADDING = 64;
/** Hash multiplier of the colour cache. */
const HASH = 0x1e35a7bd;

/** Offsets of the 120 nearest preceding pixels, nearest first: columns to the left, rows up. */
const NEAR = Array.from({ length: 128 }, (_, i) => ({ left: 8 - (i & 15), up: i >> 4 }))
  .filter(({ left, up }) => up || left > 0)
  .sort((a, b) => a.left ** 2 + a.up ** 2 - b.left ** 2 - b.up ** 2 || b.up - a.up || b.left - a.left);

/** @type {(bytes: Uint8Array, at: number) => number} */
const uint24 = (bytes, at) => bytes[at] | (bytes[at + 1] << 8) | (bytes[at + 2] << 16);

/** @type {(bytes: Uint8Array, at: number) => string} */
const fourCC = (bytes, at) => String.fromCharCode(...bytes.subarray(at, at + 4));

/**
 * Return the VP8L bitstream of a WebP file, and the canvas size that the file declares.
 * @param {Uint8Array} bytes
 */
function findBitstream(bytes) {
  if (bytes.length < 20 || fourCC(bytes, 0) !== "RIFF" || fourCC(bytes, 8) !== "WEBP") fail("not a WebP file");
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.length);
  const end = 8 + view.getUint32(4, true);
  if (end > bytes.length) fail(`cut off: ${bytes.length} of ${end} bytes`);
  let canvas = "";
  for (let at = 12; at + 8 <= end;) {
    const kind = fourCC(bytes, at);
    const size = view.getUint32(at + 4, true);
    const start = at + 8;
    at = start + size + (size & 1);
    if (start + size > end) fail("a chunk is longer than the file");
    if (kind === "VP8 " || kind === "ALPH") fail("lossy WebP, whose pixels are not exact: store it lossless");
    if (kind === "ANIM" || kind === "ANMF") fail("an animation, not a single image");
    if (kind === "VP8X" && size >= 10) canvas = `${uint24(bytes, start + 4) + 1} x ${uint24(bytes, start + 7) + 1}`;
    if (kind === "VP8L") return { stream: bytes.subarray(start, start + size), canvas };
  }
  return fail("a WebP file without an image");
}

/** Reader of bits, lowest first, 16 fetched at a time. Beyond the end it reads zeros, which `check` detects. */
class Bits {
  /** @param {Uint8Array} bytes */
  constructor(bytes) {
    this.words = new Uint16Array((bytes.length >> 1) + PADDING);
    new Uint8Array(this.words.buffer).set(bytes);
    this.length = bytes.length * 8;
    this.next = 0; // index of the next word
    this.held = 0; // fetched bits that are not used yet
    this.count = 0; // number of held bits
    this.endSymbol = 0; // symbol that ended a run of literals
  }

  /** @param {number} count at most 16 */
  read(count) {
    if (this.count < count) {
      this.held |= this.words[this.next++] << this.count;
      this.count += 16;
    }
    const value = this.held & ((1 << count) - 1);
    this.held >>>= count;
    this.count -= count;
    return value;
  }

  /** @type {(entries: ArrayLike<number>, code: Code) => number} */
  symbol(entries, { start, mask }) {
    if (this.count < MAX_LENGTH) {
      this.held |= this.words[this.next++] << this.count;
      this.count += 16;
    }
    let entry = entries[start + (this.held & mask)];
    if ((entry & 15) > ROOT_BITS) {
      entry = entries[start + (entry >> 4) + ((this.held >> ROOT_BITS) & ((1 << ((entry & 15) - ROOT_BITS)) - 1))];
    }
    this.held >>>= entry & 15;
    this.count -= entry & 15;
    return entry >> 4;
  }

  /** Return the length or distance code of a prefix symbol. @param {number} symbol */
  number(symbol) {
    if (symbol < 4) return symbol + 1;
    const extra = (symbol - 2) >> 1;
    const low = this.read(Math.min(extra, 16));
    return ((2 + (symbol & 1)) << extra) + low + (this.read(Math.max(extra - 16, 0)) << 16) + 1;
  }

  check() {
    if (this.next * 16 - this.count > this.length) fail("the image data ends too soon");
  }
}

/** A prefix code: start of its table, mask of the first lookup (0: a single symbol). @typedef {{start: number, mask: number}} Code */

/**
 * Append the lookup table of a canonical code. An entry is symbol × 16 + length of its code; for codes longer than the
 * first lookup, offset of a second table × 16 + length of the longest code in it.
 * @type {(entries: number[], lengths: Uint8Array) => Code}
 */
function addTable(entries, lengths) {
  const symbols = [];
  const codes = []; // bit-reversed: the first bit is the lowest
  /** @type {number[][]} */
  const byLength = Array.from({ length: MAX_LENGTH + 1 }, () => []);
  lengths.forEach((length, symbol) => byLength[length].push(symbol));
  let [code, open] = [0, 1];
  for (let length = 1; length <= MAX_LENGTH; length++) {
    open *= 2;
    for (const symbol of byLength[length]) {
      open--;
      symbols.push(symbol);
      codes.push(code);
      let bit = 1 << (length - 1);
      for (; code & bit; bit >>= 1) code ^= bit;
      code |= bit;
    }
  }
  const single = symbols.length === 1;
  if (open && !single) fail("an incomplete or oversubscribed prefix code");
  const root = single ? 0 : Math.min(lengths[symbols[symbols.length - 1]], ROOT_BITS);
  const start = entries.length;
  for (let i = 0; i < 1 << root; i++) entries.push(0);
  for (let i = symbols.length - 1; i >= 0; i--) {
    const length = single ? 0 : lengths[symbols[i]];
    let [code, step, at, size] = [codes[i], 1 << length, start, 1 << root];
    if (length > root) {
      const prefix = start + (code & (size - 1));
      // Longer codes come first, so the first one determines the size of the second table.
      if (!entries[prefix]) {
        entries[prefix] = ((entries.length - start) << 4) | length;
        for (let i = 1 << (length - root); i; i--) entries.push(0);
      }
      size = 1 << ((entries[prefix] & 15) - root);
      at += entries[prefix] >> 4;
      code >>= root;
      step >>= root;
    }
    for (; code < size; code += step) entries[at + code] = (symbols[i] << 4) | length;
  }
  return { start, mask: (1 << root) - 1 };
}

/** Read the code lengths of an alphabet. @type {(bits: Bits, size: number) => Uint8Array} */
function readLengths(bits, size) {
  const lengths = new Uint8Array(size);
  if (bits.read(1)) {
    const hasTwo = bits.read(1);
    lengths[bits.read(bits.read(1) ? 8 : 1)] = 1; // a symbol outside the alphabet is ignored
    if (hasTwo) lengths[bits.read(8)] = 1;
    return lengths;
  }
  const metaLengths = new Uint8Array(19);
  for (let i = 0, count = 4 + bits.read(4); i < count; i++) metaLengths[ORDER_OF_LENGTHS[i]] = bits.read(3);
  let left = bits.read(1) ? 2 + bits.read(2 + 2 * bits.read(3)) : size;
  if (left > size) fail("more code lengths than symbols");
  /** @type {number[]} */
  const entries = [];
  const code = addTable(entries, metaLengths);
  let last = 8;
  for (let i = 0; i < size && left--;) {
    const length = bits.symbol(entries, code);
    let end = i + 1;
    if (length > 15) end = i + (length < 18 ? 3 + bits.read(length - 14) : 11 + bits.read(7));
    else last = length || last;
    if (end > size) fail("more code lengths than symbols");
    lengths.fill(length < 16 ? length : length === 16 ? last : 0, i, end);
    i = end;
  }
  return lengths;
}

/** @type {(pixel: number) => number} */
const swapRedAndBlue = (pixel) => (pixel & 0xff00ff00) | ((pixel >> 16) & 255) | ((pixel & 255) << 16);

/** @type {(size: number, bits: number) => number} */
const tilesOf = (size, bits) => (size + (1 << bits) - 1) >> bits;

/**
 * Read an entropy-coded image: the main one, or the data of a transform or of the choice of codes.
 * @type {(bits: Bits, width: number, height: number, isMain?: boolean) => Int32Array}
 */
function readImage(bits, width, height, isMain) {
  const cached = bits.read(1);
  const cacheBits = cached && bits.read(4);
  if (cached && (cacheBits < 1 || cacheBits > 11)) fail("a colour cache of invalid size");
  let tileBits = 14;
  let groups = Int32Array.of(0); // group of codes of each tile
  if (isMain && bits.read(1)) {
    tileBits = 2 + bits.read(3);
    groups = readImage(bits, tilesOf(width, tileBits), tilesOf(height, tileBits)).map(
      (pixel) => ((pixel & 255) << 8) | ((pixel >> 8) & 255),
    );
  }
  /** @type {number[]} */
  const tables = [];
  /** @type {Code[]} */
  const codes = [];
  const used = new Set(groups);
  for (let group = 0, last = groups.reduce((a, b) => Math.max(a, b)); group <= last; group++) {
    ALPHABETS.forEach((size, i) => {
      const lengths = readLengths(bits, i || !cacheBits ? size : size + (1 << cacheBits));
      if (used.has(group)) codes[5 * group + i] = addTable(tables, lengths);
    });
    bits.check();
    if (tables.length > MAX_ENTRIES) fail("too many prefix codes");
  }
  const entries = Int32Array.from(tables);
  const pixels = new Int32Array(width * height);
  const cache = new Int32Array(1 << cacheBits);
  /** @type {(from: number, to: number) => void} */
  const addToCache = (from, to) => {
    for (let i = from; cacheBits && i < to; i++) {
      cache[Math.imul(HASH, swapRedAndBlue(pixels[i])) >>> (32 - cacheBits)] = pixels[i];
    }
  };
  const channels = new Int32Array(12);
  let [fixed, group, tileEnd, steps] = [0, 0, 0, 0];
  for (let i = 0; i < pixels.length;) {
    if (i >= tileEnd) {
      bits.check();
      const y = (i / width) | 0;
      const x = i - y * width;
      tileEnd = y * width + Math.min(((x >> tileBits) + 1) << tileBits, width);
      group = 5 * groups[(y >> tileBits) * tilesOf(width, tileBits) + (x >> tileBits)];
      [fixed, steps] = [0, 0];
      for (let channel = 0; channel < 4; channel++) {
        const { start, mask } = codes[group + channel];
        if (mask || !channel) {
          channels[steps++] = start;
          channels[steps++] = mask;
          channels[steps++] = SHIFTS[channel];
        } else fixed |= (entries[start] >> 4) << SHIFTS[channel];
      }
    }
    const start = i;
    i = readLiterals(bits, entries, channels, steps, fixed, pixels, i, tileEnd);
    addToCache(start, i);
    if (i === tileEnd) continue;
    const symbol = bits.endSymbol - LITERALS;
    if (symbol >= LENGTHS) {
      pixels[i] = cache[symbol - LENGTHS];
      addToCache(i, ++i); // an empty slot is transparent black, which is added too
    } else {
      const [from, end] = [i, i + bits.number(symbol)];
      const code = bits.number(bits.symbol(entries, codes[group + 4]));
      const { left, up } = NEAR[Math.min(code, NEAR.length) - 1];
      const back = code > NEAR.length ? code - NEAR.length : Math.max(up * width + left, 1);
      if (back > i || end > pixels.length) fail("a copy from outside the image");
      for (; i < end; i++) pixels[i] = pixels[i - back];
      addToCache(from, end);
    }
  }
  bits.check();
  return pixels;
}

/**
 * Read literal pixels from i until the end or another symbol, which is stored in `bits.endSymbol`. Most of the time is
 * spent here; a separate function that is called often is optimised early.
 * @param {Bits} bits
 * @param {Int32Array} entries
 * @param {Int32Array} channels table, mask and bit offset of each channel that is read
 * @param {number} steps number of used values in `channels`
 * @param {number} fixed channels with a single value
 * @param {Int32Array} pixels
 * @param {number} i
 * @param {number} end
 */
function readLiterals(bits, entries, channels, steps, fixed, pixels, i, end) {
  const { words } = bits;
  let { next, held, count } = bits;
  literals: for (; i < end; i++) {
    let pixel = fixed;
    for (let step = 0; step < steps; step += 3) {
      if (count < MAX_LENGTH) {
        held |= words[next++] << count;
        count += 16;
      }
      const start = channels[step];
      let entry = entries[start + (held & channels[step + 1])];
      let length = entry & 15;
      if (length > ROOT_BITS) {
        entry = entries[start + (entry >> 4) + ((held >> ROOT_BITS) & ((1 << (length - ROOT_BITS)) - 1))];
        length = entry & 15;
      }
      held >>>= length;
      count -= length;
      if (entry >= LITERALS << 4) {
        bits.endSymbol = entry >> 4;
        break literals;
      }
      pixel |= (entry >> 4) << channels[step + 2];
    }
    pixels[i] = pixel;
  }
  bits.next = next;
  bits.held = held;
  bits.count = count;
  return i;
}

/** Return sums of the four channels, modulo 256. @type {(a: number, b: number) => number} */
const add = (a, b) =>
  (((a & 0xff00ff00) + (b & 0xff00ff00)) & 0xff00ff00) | (((a & 0xff00ff) + (b & 0xff00ff)) & 0xff00ff);

/** Return means of the four channels, rounded down. @type {(a: number, b: number) => number} */
const mean = (a, b) => ((((a ^ b) >>> 1) & 0x7f7f7f7f) + (a & b)) | 0;

/** Clamp two channels, each offset by 256, to 0 to 255. @type {(pair: number) => number} */
const clamp = (pair) => {
  const inside = (pair >>> 8) & 0x10001;
  const above = (pair >>> 9) & 0x10001;
  return (pair & ((inside << 8) - inside)) | ((above << 8) - above);
};

/** @type {(a: number, b: number, c: number) => number} */
const addSubtractOfTwo = (a, b, c) => clamp((a & 0xff00ff) + (b & 0xff00ff) - (c & 0xff00ff) + 0x1000100);

/** Return a + b - c, clamped (ClampAddSubtractFull). @type {(a: number, b: number, c: number) => number} */
const addSubtract = (a, b, c) => addSubtractOfTwo(a, b, c) | (addSubtractOfTwo(a >>> 8, b >>> 8, c >>> 8) << 8);

/** @type {(a: number, c: number) => number} */
const addHalfOfTwo = (a, c) => {
  const difference = (a & 0xff00ff) - (c & 0xff00ff) + 0x1000100;
  const half = ((difference + (~(difference >>> 8) & 0x10001)) >>> 1) & 0xff00ff;
  return clamp((a & 0xff00ff) + half + 0x800080);
};

/** Return a + (a - c) / 2, rounded towards zero and clamped (ClampAddSubtractHalf). @type {(a: number, c: number) => number} */
const addHalf = (a, c) => addHalfOfTwo(a, c) | (addHalfOfTwo(a >>> 8, c >>> 8) << 8);

/** Return the one that left + top - corner is nearer to. @type {(top: number, left: number, corner: number) => number} */
const select = (top, left, corner) => {
  let nearer = 0;
  for (let shift = 0; shift < 32; shift += 8) {
    const c = (corner >>> shift) & 255;
    nearer += Math.abs(((left >>> shift) & 255) - c) - Math.abs(((top >>> shift) & 255) - c);
  }
  return nearer <= 0 ? top : left;
};

/**
 * Undo each predictor for pixels i to end of an image of width w; one loop for each mode is faster than a choice per pixel.
 * @type {((p: Int32Array, i: number, end: number, w: number) => void)[]}
 */
const PREDICTORS = [
  (p, i, end) => {
    for (; i < end; i++) p[i] = add(p[i], OPAQUE_BLACK);
  },
  (p, i, end) => {
    for (; i < end; i++) p[i] = add(p[i], p[i - 1]);
  },
  (p, i, end, w) => {
    for (; i < end; i++) p[i] = add(p[i], p[i - w]);
  },
  (p, i, end, w) => {
    for (; i < end; i++) p[i] = add(p[i], p[i - w + 1]);
  },
  (p, i, end, w) => {
    for (; i < end; i++) p[i] = add(p[i], p[i - w - 1]);
  },
  (p, i, end, w) => {
    for (; i < end; i++) p[i] = add(p[i], mean(mean(p[i - 1], p[i - w + 1]), p[i - w]));
  },
  (p, i, end, w) => {
    for (; i < end; i++) p[i] = add(p[i], mean(p[i - 1], p[i - w - 1]));
  },
  (p, i, end, w) => {
    for (; i < end; i++) p[i] = add(p[i], mean(p[i - 1], p[i - w]));
  },
  (p, i, end, w) => {
    for (; i < end; i++) p[i] = add(p[i], mean(p[i - w - 1], p[i - w]));
  },
  (p, i, end, w) => {
    for (; i < end; i++) p[i] = add(p[i], mean(p[i - w], p[i - w + 1]));
  },
  (p, i, end, w) => {
    for (; i < end; i++) p[i] = add(p[i], mean(mean(p[i - 1], p[i - w - 1]), mean(p[i - w], p[i - w + 1])));
  },
  (p, i, end, w) => {
    for (; i < end; i++) p[i] = add(p[i], select(p[i - w], p[i - 1], p[i - w - 1]));
  },
  (p, i, end, w) => {
    for (; i < end; i++) p[i] = add(p[i], addSubtract(p[i - 1], p[i - w], p[i - w - 1]));
  },
  (p, i, end, w) => {
    for (; i < end; i++) p[i] = add(p[i], addHalf(mean(p[i - 1], p[i - w]), p[i - w - 1]));
  },
];

/** Function that undoes a transform. @typedef {(pixels: Int32Array, width: number, height: number) => Int32Array} Undo */

/** @type {(tiles: Int32Array, tileBits: number) => Undo} */
const undoPrediction = (tiles, tileBits) => (pixels, width, height) => {
  pixels[0] = add(pixels[0], OPAQUE_BLACK);
  PREDICTORS[1](pixels, 1, width, width);
  for (let y = 1; y < height; y++) {
    const row = y * width;
    PREDICTORS[2](pixels, row, row + 1, width);
    for (let x = 1; x < width;) {
      const mode = (tiles[(y >> tileBits) * tilesOf(width, tileBits) + (x >> tileBits)] >> 8) & 15;
      const end = Math.min(((x >> tileBits) + 1) << tileBits, width);
      (PREDICTORS[mode] ?? PREDICTORS[0])(pixels, row + x, row + end, width);
      x = end;
    }
  }
  return pixels;
};

/** @type {(tiles: Int32Array, tileBits: number) => Undo} */
const undoCrossColour = (tiles, tileBits) => (pixels, width, height) => {
  for (let y = 0, i = 0; y < height; y++) {
    for (let x = 0; x < width;) {
      const factors = tiles[(y >> tileBits) * tilesOf(width, tileBits) + (x >> tileBits)];
      const redToBlue = (factors << 24) >> 24;
      const greenToBlue = (factors << 16) >> 24;
      const greenToRed = (factors << 8) >> 24;
      for (const end = Math.min(((x >> tileBits) + 1) << tileBits, width); x < end; x++, i++) {
        const green = (pixels[i] << 16) >> 24;
        const red = pixels[i] + ((greenToRed * green) >> 5);
        const blue = (pixels[i] >> 16) + ((greenToBlue * green) >> 5) + ((redToBlue * ((red << 24) >> 24)) >> 5);
        pixels[i] = (pixels[i] & 0xff00ff00) | (red & 255) | ((blue & 255) << 16);
      }
    }
  }
  return pixels;
};

/** @type {Undo} */
const undoSubtraction = (pixels) => {
  for (let i = 0; i < pixels.length; i++) pixels[i] = add(pixels[i], ((pixels[i] >> 8) & 255) * 0x10001);
  return pixels;
};

/** @type {(palette: Int32Array, packing: number) => Undo} */
const undoIndexing = (palette, packing) => (pixels, width, height) => {
  const bits = 8 >> packing;
  const colours = new Int32Array(256); // an index beyond the palette is transparent black
  colours.set(palette);
  const image = new Int32Array(width * height);
  for (let y = 0, i = 0; y < height; y++) {
    for (let x = 0; x < width; x++, i++) {
      const indices = (pixels[y * tilesOf(width, packing) + (x >> packing)] >> 8) & 255;
      image[i] = colours[(indices >> ((x & ((1 << packing) - 1)) * bits)) & ((1 << bits) - 1)];
    }
  }
  return image;
};

/**
 * Decode a lossless WebP file.
 * @param {Uint8Array | ArrayBuffer} bytes
 * @param {{maxPixels?: number}} [limits] checked before memory is allocated: 60 bytes can declare 268 million pixels
 * @returns {{width: number, height: number, rgba: Uint8Array<ArrayBuffer>}} four bytes per pixel, row by row, alpha not premultiplied
 * @throws {WebPError} the file is damaged, lossy, animated or larger than allowed
 */
export function decodeWebP(bytes, { maxPixels = 1 << 26 } = {}) {
  const { stream, canvas } = findBitstream(bytes instanceof Uint8Array ? bytes : new Uint8Array(bytes));
  const bits = new Bits(stream);
  if (bits.read(8) !== 0x2f) fail("its image is not VP8L");
  const [width, height] = [1 + bits.read(14), 1 + bits.read(14)];
  bits.read(1); // a hint whether alpha is used; unreliable
  if (bits.read(3)) fail("an unknown version of VP8L");
  bits.check();
  if (canvas && canvas !== `${width} x ${height}`) fail(`an image of ${width} x ${height} on a canvas of ${canvas}`);
  if (width * height > maxPixels) fail(`${width} x ${height} pixels, more than the ${maxPixels} allowed`);

  /** @type {[Undo, number][]} */
  const steps = [];
  let across = width;
  for (let kinds = 0; bits.read(1);) {
    const kind = bits.read(2);
    if (kinds & (1 << kind)) fail("a transform that occurs twice");
    kinds |= 1 << kind;
    if (kind === 2) steps.push([undoSubtraction, across]);
    else if (kind === 3) {
      const size = 1 + bits.read(8);
      const palette = readImage(bits, size, 1);
      PREDICTORS[1](palette, 1, size, size);
      const packing = size > 16 ? 0 : size > 4 ? 1 : size > 2 ? 2 : 3;
      steps.push([undoIndexing(palette, packing), across]);
      across = tilesOf(across, packing);
    } else {
      const tileBits = 2 + bits.read(3);
      const tiles = readImage(bits, tilesOf(across, tileBits), tilesOf(height, tileBits));
      steps.push([(kind ? undoCrossColour : undoPrediction)(tiles, tileBits), across]);
    }
  }
  let pixels = readImage(bits, across, height, true);
  for (const [undo, span] of steps.reverse()) pixels = undo(pixels, span, height);
  return { width, height, rgba: new Uint8Array(/** @type {ArrayBuffer} */ (pixels.buffer)) };
}
