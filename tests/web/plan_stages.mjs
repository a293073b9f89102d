/** Returns the stages that the web page of the service expects of jobs, and their descriptions, as JSON. */

import { readFileSync } from "node:fs";
import { jobLabel } from "../../service/static/labels.js";
import { plannedStages } from "../../service/static/stages.js";

const jobs = JSON.parse(readFileSync(0, "utf8"));
const answers = jobs.map(({ job, training }) => ({ stages: plannedStages(job, training), label: jobLabel(job) }));
process.stdout.write(JSON.stringify(answers));
