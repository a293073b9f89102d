/** Performs a job in a worker of a page. */

import { perform } from "./scene_jobs.mjs";

addEventListener("message", async ({ data }) => postMessage(await perform(data)));
postMessage("ready");
