/** Chooses levels of detail by jobs, and returns indices and areas as JSON. */

import { readFileSync } from "node:fs";
import { chooseLevels } from "../../web_decoder/preview/choice.js";
import { areaOf, isOutside, viewOf } from "../../web_decoder/preview/coverage.js";

const { choices = [], views = [] } = JSON.parse(readFileSync(0, "utf8"));

const chosen = choices.map(({ leaves, areas, budget, files = null, current }) =>
  chooseLevels(leaves, areas, budget, {
    ...(files && { available: ({ file }) => files.includes(file) }),
    ...(current && { current }),
  }),
);
const seen = views.map(({ matrix, eye, focal, pixels, boxes }) => {
  const view = viewOf(matrix, eye, focal, pixels);
  return boxes.map((box) => ({ area: areaOf(view, box), outside: isOutside(view, box) }));
});
process.stdout.write(JSON.stringify({ chosen, seen }));
