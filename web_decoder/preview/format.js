/** Formatting of numbers, sizes and times, in English like the page, whatever the browser's language. */

/** @param {Intl.NumberFormatOptions} options */
const formatter = (options) => new Intl.NumberFormat("en", options);

const whole = formatter({ maximumFractionDigits: 0 });
const brief = formatter({ minimumSignificantDigits: 3, maximumSignificantDigits: 3 });
const tiny = formatter({ maximumSignificantDigits: 3, notation: "scientific" });
const shares = formatter({ style: "percent", minimumFractionDigits: 1, maximumFractionDigits: 1 });

const SIZES = /** @type {const} */ (["byte", "kilobyte", "megabyte", "gigabyte"]);
const sizes = SIZES.map((unit) =>
  unit === "byte"
    ? formatter({ style: "unit", unit, unitDisplay: "long", maximumFractionDigits: 0 })
    : formatter({ style: "unit", unit, minimumSignificantDigits: 3, maximumSignificantDigits: 3 }),
);

/** @param {number} value */
export const count = (value) => whole.format(value);

/** @param {number} value formatted with three digits */
export const short = (value) => (value !== 0 && Math.abs(value) < 0.001 ? tiny : brief).format(value).replace("-", "−");

/** @param {number} value from 0 to 1 */
export const share = (value) => (value > 0 && value < 0.0005 ? "< 0.1%" : shares.format(value));

/**
 * Format bytes with three digits and a unit.
 * @param {number} value
 */
export function bytes(value) {
  // 999,600 rounded to three digits would read "1,000 kB": it belongs to the next unit.
  const step = Math.min(SIZES.length - 1, Math.max(0, Math.floor(Math.log10(Math.max(value, 1) * 1.0005) / 3)));
  return sizes[step].format(value / 1000 ** step);
}

/** @param {number} seconds */
export const duration = (seconds) =>
  seconds < 0.95
    ? `${whole.format(1000 * seconds)} ms`
    : `${formatter({ maximumFractionDigits: 1 }).format(seconds)} s`;
