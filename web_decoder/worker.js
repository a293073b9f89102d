/** A worker of the pool: decodes images. */

import { decodePlane } from "./plane.js";

addEventListener("message", ({ data: { task, port } }) => {
  try {
    const plane = decodePlane(task);
    port.postMessage({ plane }, [plane.rgba.buffer]);
  } catch (error) {
    port.postMessage({ error: error instanceof Error ? error.message : String(error) });
  }
});
