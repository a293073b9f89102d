/** Measures scenes as one container and as the coarsest level of a streamed scene; extents as JSON. */

import { readFileSync } from "node:fs";
import { extentOfCoarsest, extentOfScene } from "../../web_decoder/preview/extent.js";

const scenes = JSON.parse(readFileSync(0, "utf8"));

const extents = scenes.map(({ points, opacities = points.map(() => 3), leaves, lost = [] }) => {
  const scene = { count: points.length, means: Float32Array.from(points.flat()), opacities };
  const files = [0, 1].filter((file) => !lost.includes(file)).map((file) => [file, scene]);
  const whole = [{ levels: [{ level: 0, file: 0, offset: 0, count: points.length, error: 0 }] }];
  return { whole: extentOfScene(scene), coarsest: extentOfCoarsest(leaves ?? whole, new Map(files)) };
});
process.stdout.write(JSON.stringify(extents));
