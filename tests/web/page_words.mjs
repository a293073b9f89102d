/** Returns the descriptions that the web page of the service has of jobs, and its names of stages, as JSON. */

import { readFileSync } from "node:fs";
import { jobLabel } from "../../service/static/labels.js";
import { stageLabel } from "../../service/static/stages.js";

const { jobs, stages } = JSON.parse(readFileSync(0, "utf8"));
process.stdout.write(JSON.stringify({ labels: jobs.map(jobLabel), stages: stages.map(stageLabel) }));
