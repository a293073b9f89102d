/** Formatting of numbers, sizes and times, in English like the page, whatever the browser's language. */

const LOCALE = "en";

/** @param {Intl.NumberFormatOptions} options */
const formatter = (options) => new Intl.NumberFormat(LOCALE, options);

const whole = formatter({ maximumFractionDigits: 0 });
const brief = formatter({ minimumSignificantDigits: 3, maximumSignificantDigits: 3 });
const shares = formatter({ style: "percent", maximumFractionDigits: 0 });
const fineShares = formatter({ style: "percent", minimumFractionDigits: 1, maximumFractionDigits: 1 });
const signed = formatter({ minimumFractionDigits: 2, maximumFractionDigits: 2, signDisplay: "exceptZero" });
const dates = new Intl.DateTimeFormat(LOCALE, { dateStyle: "medium", timeStyle: "short" });
const ages = new Intl.RelativeTimeFormat(LOCALE, { numeric: "auto" });

const SIZES = /** @type {const} */ (["byte", "kilobyte", "megabyte", "gigabyte"]);
const sizes = SIZES.map((unit) =>
  unit === "byte"
    ? formatter({ style: "unit", unit, unitDisplay: "long", maximumFractionDigits: 0 })
    : formatter({ style: "unit", unit, minimumSignificantDigits: 3, maximumSignificantDigits: 3 }),
);

/** @param {string} text */
export const capitalised = (text) => text.charAt(0).toUpperCase() + text.slice(1);

/** @param {number} value */
export const count = (value) => whole.format(value);

/** @param {number} value shown with three digits */
export const short = (value) => brief.format(value);

/** @param {number} value from 0 to 1 */
export const percent = (value) => shares.format(value);

/** @param {number} value from 0 to 1 */
export const share = (value) => (value > 0 && value < 0.0005 ? "< 0.1%" : fineShares.format(value));

/** @param {number} value */
export const decibels = (value) => `${signed.format(value).replace("-", "−")} dB`;

/** @param {string} iso */
export const moment = (iso) => dates.format(new Date(iso));

/**
 * Format bytes with the unit that gives a short number.
 * @param {number} value
 */
export function bytes(value) {
  // 999,600 bytes would be rounded to "1,000 kB", so they take the next unit.
  const step = Math.min(SIZES.length - 1, Math.max(0, Math.floor(Math.log10(Math.max(value, 1) * 1.0005) / 3)));
  return sizes[step].format(value / 1000 ** step);
}

/**
 * Format a duration: "0.4 s", "12 s", "3 min 20 s", "2 h 5 min".
 * @param {number} seconds
 */
export function duration(seconds) {
  if (seconds < 9.95) return `${formatter({ maximumFractionDigits: 1 }).format(seconds)} s`;
  const total = Math.round(seconds);
  if (total < 60) return `${total} s`;
  const [hours, minutes, rest] = [Math.floor(total / 3600), Math.floor(total / 60) % 60, total % 60];
  if (hours > 0) return `${hours} h${minutes ? ` ${minutes} min` : ""}`;
  return `${minutes} min${rest ? ` ${rest} s` : ""}`;
}

/**
 * Format elapsed time in whole seconds.
 * @param {number} seconds
 */
export const clock = (seconds) => duration(Math.max(0, Math.floor(seconds)));

/**
 * Format an estimate with few digits: "about 7 s", "about 3 min".
 * @param {number} seconds
 */
export function roughly(seconds) {
  if (seconds < 10) return `about ${Math.max(1, Math.round(seconds))} s`;
  if (seconds < 55) return `about ${5 * Math.round(seconds / 5)} s`;
  if (seconds < 5400) return `about ${Math.max(1, Math.round(seconds / 60))} min`;
  return `about ${short(seconds / 3600)} h`;
}

/**
 * Format a time relative to now.
 * @param {string} iso
 */
export function ago(iso) {
  const seconds = (Date.parse(iso) - Date.now()) / 1000;
  const [size, unit] = /** @type {[number, Intl.RelativeTimeFormatUnit]} */ (
    [
      [86400, "day"],
      [3600, "hour"],
      [60, "minute"],
    ].find(([size]) => Math.abs(seconds) >= Number(size)) ?? [1, "second"]
  );
  if (unit === "second" && Math.abs(seconds) < 30) return "just now"; // clocks may differ by this much
  return ages.format(Math.round(seconds / size), unit);
}
