/** Decodes WebP files that are concatenated in one file, by a job on standard input; writes a line of JSON for each. */

import { createHash } from "node:crypto";
import { readFileSync } from "node:fs";

const { sizes, decoder = "../../web_decoder/webp.js", maxPixels, pixels } = JSON.parse(readFileSync(0, "utf8"));
const { decodeWebP, WebPError } = await import(decoder);
const blob = readFileSync(process.argv[2]);
const lines = [];
let at = 0;
for (const size of sizes) {
  let line;
  try {
    const { width, height, rgba } = decodeWebP(blob.subarray(at, at + size), { maxPixels });
    if (!(rgba instanceof Uint8Array) || rgba.length !== 4 * width * height) throw new Error("pixels of another size");
    line = { width, height, sha256: createHash("sha256").update(rgba).digest("hex") };
    if (pixels) line.rgba = Buffer.from(rgba).toString("base64");
  } catch (error) {
    line = { name: error instanceof WebPError ? error.name : `not a WebPError: ${error.stack}`, error: error.message };
  }
  lines.push(JSON.stringify(line));
  at += size;
}
process.stdout.write(lines.join("\n") + "\n");
