/**
 * Changes every byte of the `meta.json` on standard input in several ways; writes how many were refused, how many mean
 * the same to the decoder, and those that mean something else.
 */

import { readFileSync } from "node:fs";
import { Assembly } from "../../web_decoder/scene.js";

/** All that decoding takes from the metadata. */
function meaning(text) {
  const { scene, ranges } = new Assembly(text, 2e7);
  const { count, degree, gridSide, codebookSide } = scene;
  return JSON.stringify([count, degree, gridSide, codebookSide, ranges]);
}

const text = new Uint8Array(readFileSync(0));
const right = meaning(text);
const ways = [0, 1, 2, 3, 4, 5, 6, 7].map((bit) => (byte) => byte ^ (1 << bit));
ways.push(
  (byte) => byte ^ 255,
  () => 0,
  () => 32,
  (_, at) => 48 + (at % 10),
);
const found = { refused: 0, same: 0, other: [] };
for (const way of ways) {
  text.forEach((byte, at) => {
    const changed = text.slice();
    changed[at] = way(byte, at);
    let said;
    try {
      said = meaning(changed);
    } catch (error) {
      if (!(error instanceof Error) || !error.message.startsWith("meta.json")) throw error;
      found.refused++;
      return;
    }
    if (said === right) found.same++;
    else found.other.push(new TextDecoder().decode(changed));
  });
}
console.log(JSON.stringify(found));
