/** How many Gaussians this device draws at once. */

/** Gaussians that computers and phones draw at several images per second. */
const [COMPUTER, PHONE] = [1_500_000, 500_000];

/** Most that any device may be asked for: Spark's arrays of more take gigabytes. */
const MOST = 10_000_000;

/**
 * Return the largest number of Gaussians to draw: what the page's address says after “gaussians=”; else that of a phone,
 * if fingers are what the device is made for or it has little memory, or that of a computer.
 * @param {string} query of the page's address
 */
export function budgetOf(query) {
  const asked = Number(new URLSearchParams(query).get("gaussians"));
  if (asked >= 1) return Math.min(MOST, Math.floor(asked));
  const memory = /** @type {{deviceMemory?: number}} */ (navigator).deviceMemory ?? 8; // gigabytes, at most 8; not in all browsers
  return matchMedia("(pointer: coarse)").matches || memory <= 2 ? PHONE : COMPUTER;
}
