/** Views of scenes and records, as JSON: those of recorded views, and of scenes without one. */

import { readFileSync } from "node:fs";
import { viewInFile } from "../../web_decoder/preview/file_types.js";
import { checkedView, viewOfDense } from "../../web_decoder/preview/view.js";

const { records, headers, scenes } = JSON.parse(readFileSync(0, "utf8"));
const found = {
  records: records.map(checkedView),
  headers: headers.map((text) => viewInFile("ply", new TextEncoder().encode(text))),
  scenes: scenes.map((points) =>
    viewOfDense(
      points.length,
      (i) => points[i],
      () => 1,
    ),
  ),
};
process.stdout.write(JSON.stringify(found));
