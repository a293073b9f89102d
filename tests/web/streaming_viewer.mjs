/** Draws streamed scenes as the preview page does, step by step, at cameras that a test gives. */

import { StreamedFiles } from "/web_decoder/preview/streamed_files.js";
import { Streaming } from "/web_decoder/preview/streaming.js";
import { Viewer } from "/web_decoder/preview/viewer.js";
import { contentOf } from "/web_decoder/preview/streamed_meshes.js";
import { extentOfBoxes } from "/web_decoder/preview/extent.js";
import { parseTree } from "/web_decoder/preview/lod_tree.js";

const viewer = new Viewer(document.body.appendChild(document.createElement("canvas")));
const textOf = (bytes) => {
  let text = "";
  for (let at = 0; at < bytes.length; at += 32768) text += String.fromCharCode(...bytes.subarray(at, at + 32768));
  return btoa(text);
};
let scene = null;

/** Open a scene, and load nothing but its manifest. */
async function open(url, budget) {
  const files = new StreamedFiles(url, () => {});
  const tree = parseTree(await files.manifest(new AbortController().signal));
  const [drawn, problems] = [new Map(), []];
  let changed = () => {};
  const streaming = new Streaming(tree, {
    budget,
    load: (file, signal) => files.load(file, tree.files[file], signal),
    prepare: (file, scene, signal) => contentOf(scene, signal),
    draw: (parts) => {
      for (const [file, part] of parts)
        if (part) drawn.set(tree.files[file], part.ranges);
        else drawn.delete(tree.files[file]);
      viewer.setParts(parts);
    },
    changed: () => changed(),
    failed: (file, error) => problems.push([tree.files[file], error.message]),
  });
  viewer.setExtent(
    extentOfBoxes(
      tree.leaves,
      tree.leaves.map(() => 1),
    ),
  );
  const next = () => new Promise((resolve) => (changed = resolve));
  return { files, streaming, drawn, problems, next };
}

/** Draw for a camera: with `coarse`, as soon as anything can be drawn, else when nothing more is to be loaded. */
window.draw = async ({ url, budget, camera, coarse = false }) => {
  if (url) {
    scene?.streaming.close();
    scene?.files.close();
    scene = await open(url, budget);
  }
  const { files, streaming, drawn, problems, next } = scene;
  viewer.setCamera(camera);
  let bytes = files.received;
  for (;;) {
    const arrived = next();
    if (!streaming.begun) bytes = null;
    if (streaming.begun) bytes ??= files.received;
    streaming.look(viewer.sight);
    if (coarse ? streaming.begun : streaming.complete) break;
    await arrived;
  }
  await viewer.render();
  const image = viewer.readPixels();
  const flipped = new Uint8Array(image.data.length); // bottom row first, as all viewers of these tests
  const row = 4 * image.width;
  for (let y = 0; y < image.height; y++)
    flipped.set(image.data.subarray(row * y, row * (y + 1)), row * (image.height - 1 - y));
  const ranges = [...drawn].map(([file, own]) => [file, own.map(([offset, n]) => [offset, Math.min(n, 1e9)])]);
  return { image: textOf(flipped), bytes, received: files.received, ranges, problems, levels: streaming.drawn };
};
