/**
 * Changes bytes of the `meta.json` on standard input in several ways, each byte in a third of them; writes how many
 * changes are refused, how many do not change the decoded values, and the texts of all others.
 */

import { readFileSync } from "node:fs";
import { Assembly } from "../../web_decoder/scene.js";

/** Return all values that decoding takes from the metadata. */
function valuesOf(text) {
  const { scene, ranges } = new Assembly(text, 2e7);
  const { count, degree, gridSide, codebookSide } = scene;
  return JSON.stringify([count, degree, gridSide, codebookSide, ranges]);
}

const text = new Uint8Array(readFileSync(0));
const expected = valuesOf(text);
const changes = [0, 1, 2, 3, 4, 5, 6, 7].map((bit) => (byte) => byte ^ (1 << bit));
changes.push(
  (byte) => byte ^ 255,
  () => 0,
  () => 32,
  (_, at) => 48 + (at % 10),
);
const found = { refused: 0, same: 0, other: [] };
changes.forEach((change, way) => {
  text.forEach((byte, at) => {
    if ((at + way) % 3) return;
    const changed = text.slice();
    changed[at] = change(byte, at);
    let values;
    try {
      values = valuesOf(changed);
    } catch (error) {
      if (!(error instanceof Error) || !error.message.startsWith("meta.json")) throw error;
      found.refused++;
      return;
    }
    if (values === expected) found.same++;
    else found.other.push(new TextDecoder().decode(changed));
  });
});
console.log(JSON.stringify(found));
