/** What to expect of a job: its bytes, loss and time, from what was measured on one scene, fox. */

/**
 * @typedef {{gaussians: number, degree: number, captured: boolean, trains: boolean, tuned: boolean, reduced: boolean}}
 *   Scene what is known of a scene; `trains`: whether goals are served by training, on its photographs or else on
 *   renderings; `tuned`: whether fine-tuning is wanted in any case; `reduced`: whether fewer Gaussians are
 * @typedef {[number, number]} Figure bytes per Gaussian, and the change of PSNR in decibels
 * @typedef {{bytes: number, change: number, below?: boolean, seconds: number | null}} Expectation `below`: whether the
 *   loss is larger than that; seconds are null for minutes of training
 */

/** Bytes per Gaussian by SH degree, relative to degree 3: those of fox with fewer bands. */
const BY_DEGREE = { fast: [0.7, 0.87, 0.92, 1], balanced: [0.83, 0.93, 1, 1] };

/** The same of formats with fixed steps, and their change of PSNR. @type {Record<string, [number[], number]>} */
const FIXED = {
  spz: [[17.2, 19.8, 22.8, 27], -0.45],
  "compressed.ply": [[16.3, 25.3, 40.3, 61.3], -0.14],
};

/** Results of goals and, without a name, of sizes, by what serves them; ascending. @type {Record<string, [string, ...Figure][]>} */
const GOALS = {
  encoder: [
    ["", 6.35, -1.39],
    ["0.5", 7.24, -0.94],
    ["good", 7.24, -0.93],
    ["0.3", 8.78, -0.57],
    ["high", 9.4, -0.45],
    ["", 11.88, -0.28],
    ["0.1", 14.1, -0.18],
    ["same", 14.5, -0.16],
  ],
  renderings: [
    ["", 6.0, -0.59],
    ["0.3", 7.6, -0.35],
  ],
  photographs: [
    ["0.5", 1.75, -0.48],
    ["good", 1.96, -0.47],
    ["0.3", 2.2, -0.29],
    ["high", 2.56, -0.2],
    ["0.1", 2.84, -0.07],
    ["same", 3.5, 0.01],
    ["", 3.71, 0.04],
  ],
};

/** Containers of limited times with photographs: the time in encodings, and the figure. @type {[number, ...Figure][]} */
const LIMITED = [
  [13, 3.09, -0.04],
  [3.2, 3.59, -0.14],
];
/** @type {Figure} of the preset with photographs */
const CAPTURED = [8.44, -0.22];

const MILLION = 1e6;
const CORES = 2;
const START_SECONDS = 1; // start of a job's process
const ENCODINGS = 5; // of a search without training, usually

/**
 * Return what to expect of a scene in a format with fixed steps; null of others.
 * @param {string} format
 * @param {Scene} scene
 */
export function expectFixed(format, { gaussians, degree }) {
  if (!FIXED[format]) return null;
  const [each, change] = FIXED[format];
  return { bytes: gaussians * each[degree], change };
}

/**
 * Return what to expect of a choice; null where nothing was measured.
 * @param {import("./choice.js").Choice} choice
 * @param {Scene} scene
 * @param {Record<string, import("./api.js").Preset>} presets by name
 * @returns {Expectation | null}
 */
export function expect({ preset, encode, time_limit: limit }, scene, presets) {
  const { gaussians, degree, captured, trains, tuned, reduced } = scene;
  if (reduced) return null;
  const seconds = (/** @type {"fast" | "balanced"} */ name) =>
    START_SECONDS + (presets[name].cpu_seconds_per_million * gaussians) / MILLION / CORES;
  const encoding = seconds("balanced");
  const name = preset === "fast" || (limit && !encode && limit < encoding) ? "fast" : "balanced";
  const [{ bytes_per_gaussian: each, psnr_change: change }, scale] = [
    presets[name],
    gaussians * BY_DEGREE[name][degree],
  ];
  if (encode) {
    const found = GOALS[!trains ? "encoder" : captured ? "photographs" : "renderings"];
    const time = trains ? null : ENCODINGS * encoding;
    if (encode.target_size) return { ...ofSize(found, encode.target_size / scale, scale), seconds: time };
    const goal = found.find(([goal]) => goal === String(encode.quality ?? encode.max_psnr_drop));
    return goal ? { bytes: goal[1] * scale, change: goal[2], seconds: time } : null;
  }
  const within = limit && captured && trains && LIMITED.find(([encodings]) => limit >= encodings * encoding);
  const [size, loss] = within ? within.slice(1) : captured && name !== "fast" ? CAPTURED : [each, change];
  return { bytes: size * scale, change: loss, seconds: limit ?? (tuned ? null : seconds(name)) };
}

/**
 * Return the figures of a size between those that were measured.
 * @param {[string, ...Figure][]} measured ascending
 * @param {number} each bytes per Gaussian
 * @param {number} scale factor for bytes
 */
function ofSize(measured, each, scale) {
  const at = measured.findIndex(([, size]) => size >= each);
  const [, most, finest] = measured[measured.length - 1];
  if (at < 0) return { bytes: most * scale, change: finest };
  const [, size, change] = measured[at];
  if (at === 0) return { bytes: each * scale, change, below: each < size };
  const [, smaller, worse] = measured[at - 1];
  return { bytes: each * scale, change: worse + ((each - smaller) / (size - smaller)) * (change - worse) };
}
