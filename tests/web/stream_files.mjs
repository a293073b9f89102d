/** Parses manifests, plans files, and drives workers, the store of files and the streaming of a scene; JSON out. */

import { readFileSync } from "node:fs";
import { planFiles } from "../../web_decoder/preview/file_plan.js";
import { Pool } from "../../web_decoder/pool.js";
import { FileStore } from "../../web_decoder/preview/file_store.js";
import { isManifest, parseTree } from "../../web_decoder/preview/lod_tree.js";
import { viewOf } from "../../web_decoder/preview/coverage.js";
import { Streaming } from "../../web_decoder/preview/streaming.js";

const job = JSON.parse(readFileSync(0, "utf8"));
const { manifests = [], addresses = [], plans = [], store, flight, pooled = [], rooms = [] } = job;
const turn = () => new Promise((resolve) => setTimeout(resolve, 2));

const trees = manifests.map((text) => {
  try {
    return parseTree(new TextEncoder().encode(text));
  } catch (error) {
    return { error: error.message };
  }
});

const planned = plans.map(({ leaves, wanted, areas, sizes, room, held = [], lost = [] }) =>
  planFiles(
    leaves,
    wanted,
    areas,
    sizes,
    room,
    (file) => held.includes(file),
    (file) => lost.includes(file),
  ),
);

/** Do the steps of a script: files that are wanted, or that arrive or fail; return what has happened after each. */
async function drive({ sizes, room, most, steps }) {
  const log = [];
  const pending = new Map();
  const files = new FileStore({
    ...{ sizes, room, most, pause: 0 },
    load: (file, signal) =>
      new Promise((resolve, reject) => {
        log.push(`load ${file}`);
        pending.set(file, { resolve, reject });
        signal.addEventListener("abort", () => log.push(`cancel ${file}`));
      }),
    changed: () => log.push("changed"),
    failed: (file, error) => log.push(`lost ${file}: ${error.message}`),
  });
  const states = [];
  for (const { want, arrive, fail } of steps) {
    if (want) files.want(want);
    if (arrive !== undefined) pending.get(arrive).resolve({ count: sizes[arrive] });
    if (fail !== undefined) pending.get(fail).reject(new Error("broken"));
    await turn();
    const held = sizes.map((_, file) => file).filter(files.has);
    states.push({ log: log.splice(0), held, idle: files.idle });
  }
  return states;
}

/** Fly through a scene whose files arrive one by one; return what is drawn of each file after each of them. */
async function fly({ manifest, budget, cameras, environmentRows = 0, short = [] }) {
  const tree = parseTree(new TextEncoder().encode(manifest));
  const drawn = new Map();
  const states = [];
  const pending = [];
  const prepared = [];
  const streaming = new Streaming(tree, {
    budget,
    load: (file, signal) =>
      new Promise((resolve, reject) => {
        pending.push({ file, resolve });
        signal.addEventListener("abort", () => reject(signal.reason));
      }),
    prepare: async (file, loaded) => {
      prepared.push(file);
      return loaded;
    },
    draw: (parts) => {
      for (const [file, part] of parts)
        if (part) drawn.set(file, part.ranges);
        else drawn.delete(file);
    },
    changed: () => {},
    failed: (file, error) => states.push({ problem: [file, error.message] }),
  });
  const keep = (camera) =>
    states.push({
      ...{ camera, begun: streaming.begun, complete: streaming.complete, drawn: [...drawn] },
      ...{ lacking: streaming.lacking, surrounding: streaming.surrounding, prepared: [...prepared] },
    });
  for (const [number, { matrix, eye, focal, pixels }] of cameras.entries()) {
    const view = viewOf(matrix, eye, focal, pixels);
    streaming.look(view);
    keep(number);
    for (;;) {
      await turn();
      const next = pending.shift();
      if (!next && streaming.complete) break;
      if (!next) continue; // a second attempt comes later
      const rows = next.file === tree.environment ? environmentRows : tree.rows[next.file];
      next.resolve({ count: rows - (short.includes(next.file) ? 1 : 0) });
      await turn();
      streaming.look(view);
      keep(number);
    }
  }
  return states;
}

/** Decode images in a worker that answers or cannot be loaded; return how many listeners it had, and has at the end. */
async function pool(loads) {
  let [now, most] = [0, 0];
  globalThis.Worker = class extends EventTarget {
    addEventListener(...own) {
      super.addEventListener(...own);
      most = Math.max(most, ++now);
    }
    removeEventListener(...own) {
      super.removeEventListener(...own);
      now--;
    }
    postMessage({ task, port }) {
      if (loads) setTimeout(() => port.postMessage({ plane: { file: task.file } }));
      else setTimeout(() => this.dispatchEvent(new Event("error")));
    }
    terminate() {}
  };
  const workers = new Pool(1);
  const tasks = ["a", "b", "c"].map((file) => ({ file, bytes: new Uint8Array(9), pixels: 1, width: 128, height: 128 }));
  const ends = await Promise.allSettled(tasks.map((task) => workers.decode(task)));
  workers.close();
  return { ends: ends.map(({ value, reason }) => value?.file ?? reason.message.slice(0, 2)), most, now };
}

const pools = [];
for (const loads of pooled) pools.push(await pool(loads)); // one stub after the other
const done = {
  pools,
  trees,
  planned,
  rooms: rooms.map((text) => new Streaming(parseTree(new TextEncoder().encode(text)), { budget: 1 }).room),
  streamed: addresses.map(isManifest),
  states: store && (await drive(store)),
  flown: flight && (await fly(flight)),
};
process.stdout.write(JSON.stringify(done));
