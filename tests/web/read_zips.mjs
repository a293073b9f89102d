/** Computes CRC-32 and reads zips and WebP files at several offsets of larger buffers, by a job on standard input. */

import { createHash } from "node:crypto";
import { readFileSync } from "node:fs";
import { decodeWebP } from "../../web_decoder/webp.js";
import { crc32, openZip } from "../../web_decoder/zip.js";

const { blob = "", views = [], zips = [], webp } = JSON.parse(readFileSync(0, "utf8"));
const bytes = Uint8Array.from(Buffer.from(blob, "base64"));
const sha = (data) => createHash("sha256").update(data).digest("hex");
const moved = (data, by) => {
  const larger = new Uint8Array(data.length + 20).fill(255);
  larger.set(data, by);
  return larger.subarray(by, by + data.length);
};

const files = [];
for (const zip of zips) {
  for (const by of [0, 1, 2, 3]) {
    const found = {};
    for (const [name, read] of openZip(moved(Buffer.from(zip, "base64"), by))) found[name] = sha(await read(1e6));
    files.push(found);
  }
}
console.log(
  JSON.stringify({
    crcs: views.map(([at, length]) => crc32(bytes.subarray(at, at + length))),
    buffers: views.map(([at, length]) => crc32(Buffer.from(bytes.buffer, at, length))),
    files,
    images: webp && Array.from({ length: 9 }, (_, by) => sha(decodeWebP(moved(Buffer.from(webp, "base64"), by)).rgba)),
  }),
);
