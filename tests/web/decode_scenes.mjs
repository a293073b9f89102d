/** Performs the jobs on standard input, one after the other; writes a line of JSON for each. */

import { readFileSync } from "node:fs";
import { perform } from "./scene_jobs.mjs";

process.on("unhandledRejection", (error) => {
  console.error("unhandled", error);
  process.exit(3);
});
for (const job of JSON.parse(readFileSync(0, "utf8"))) console.log(JSON.stringify(await perform(job)));
