/**
 * The PlayCanvas engine, for the tests of files in viewers: `draw` shows a file to cameras and returns the pixels. With
 * its own settings if the address ends in `?defaults`, else with floats for colours and SH.
 */

import * as pc from "playcanvas";
import { bytesOf, canvas, textOf } from "./viewer_page.mjs";

const app = new pc.Application(canvas, {
  graphicsDeviceOptions: { antialias: false, alpha: false, preserveDrawingBuffer: true },
});
app.graphicsDevice.maxPixelRatio = 1;
app.setCanvasFillMode(pc.FILLMODE_NONE);
app.setCanvasResolution(pc.RESOLUTION_FIXED, 64, 64);
if (location.search !== "?defaults") app.scene.gsplat.dataFormat = pc.GSPLATDATA_LARGE;
app.start();

/** Wait for a frame with all Gaussians loaded, and sorted for a camera that is new. */
function rendered() {
  return new Promise((resolve) => {
    const ready = (_camera, _layer, done, loading) => {
      if (!done || loading) return;
      app.systems.gsplat.off("frame:ready", ready);
      app.once("frameend", resolve);
    };
    app.systems.gsplat.on("frame:ready", ready);
  });
}

/** Return a camera exactly as a pinhole of OpenCV's kind. */
function cameraOf({ viewmat, K, width, height }, background) {
  const [near, far] = [0.01, 1000];
  const camera = new pc.Entity();
  const clearColor = new pc.Color().fromString(background);
  camera.addComponent("camera", { toneMapping: pc.TONEMAP_NONE, nearClip: near, farClip: far, clearColor });
  const turn = new pc.Mat4().setScale(1, -1, -1);
  const view = new pc.Mat4().set(viewmat.flat()).transpose();
  const world = new pc.Mat4().mul2(turn, view).invert();
  camera.setPosition(world.getTranslation());
  camera.setRotation(new pc.Quat().setFromMat4(world));
  const projection = new pc.Mat4()
    .set([
      ...[(2 * K[0][0]) / width, 0, 1 - (2 * K[0][2]) / width, 0],
      ...[0, (2 * K[1][1]) / height, (2 * K[1][2]) / height - 1, 0],
      ...[0, 0, -(far + near) / (far - near), (-2 * far * near) / (far - near)],
      ...[0, 0, -1, 0],
    ])
    .transpose();
  camera.camera.calculateProjection = (matrix) => matrix.copy(projection);
  return camera;
}

/** @param {pc.Asset} asset */
async function loaded(asset) {
  app.assets.add(asset);
  await new Promise((resolve, reject) => {
    asset.on("load", resolve);
    asset.on("error", (error) => reject(new Error(error)));
    app.assets.load(asset);
  });
}

/** Return the pixels that each camera sees. */
async function imagesOf(cameras, background) {
  const images = [];
  for (const pinhole of cameras) {
    app.setCanvasResolution(pc.RESOLUTION_FIXED, pinhole.width, pinhole.height);
    const camera = cameraOf(pinhole, background);
    app.root.addChild(camera);
    await rendered();
    images.push(textOf(app.graphicsDevice.gl));
    camera.destroy();
  }
  return images;
}

let files = 0;
window.draw = async ({ file, ending, cameras, background }) => {
  const filename = `scene-${files++}.${ending}`;
  const bytes = bytesOf(file);
  const asset = new pc.Asset(
    filename,
    ending === "glb" ? "container" : "gsplat",
    { url: filename, filename, contents: ending === "glb" ? bytes.buffer : new Response(bytes) },
    { reorder: false },
  );
  await loaded(asset);
  let entity = new pc.Entity();
  if (ending === "glb") {
    entity = asset.resource.instantiateRenderEntity();
    entity.setEulerAngles(0, 0, 180); // from glTF's axes to those of the other files
  } else {
    entity.addComponent("gsplat", { asset });
  }
  app.root.addChild(entity);
  const images = await imagesOf(cameras, background);
  const { numSplats, gsplats } = asset.resource;
  const count = gsplats ? gsplats[0].resource.numSplats : numSplats;
  entity.destroy();
  asset.unload();
  app.assets.remove(asset);
  return { count, images };
};

/** Draw one level of a streamed scene. */
window.drawLevel = async ({ url, level, cameras, background }) => {
  const asset = new pc.Asset("streamed", "gsplat", { url });
  await loaded(asset);
  const entity = new pc.Entity();
  entity.addComponent("gsplat", { asset, lodRangeMin: level, lodRangeMax: level });
  app.root.addChild(entity);
  const images = await imagesOf(cameras, background);
  entity.destroy();
  asset.unload();
  app.assets.remove(asset);
  return images;
};

/** Show a streamed scene, coarse levels first; return the bytes that were read before the first image with content. */
window.firstImage = async ({ url, camera: pinhole }) => {
  app.scene.gsplat.lodUnderfillLimit = 10; // a coarse level is drawn until the wanted one is there
  performance.setResourceTimingBufferSize(10000);
  performance.clearResourceTimings();
  app.setCanvasResolution(pc.RESOLUTION_FIXED, pinhole.width, pinhole.height);
  const camera = cameraOf(pinhole, "#000000");
  app.root.addChild(camera);
  const asset = new pc.Asset("streamed", "gsplat", { url });
  await loaded(asset);
  const entity = new pc.Entity();
  entity.addComponent("gsplat", { asset });
  app.root.addChild(entity);
  let image;
  do {
    await new Promise((resolve) => app.once("frameend", resolve));
    image = textOf(app.graphicsDevice.gl);
  } while (bytesOf(image).every((value, at) => at % 4 === 3 || value === 0));
  const folder = url.slice(0, url.lastIndexOf("/") + 1);
  const read = performance.getEntriesByType("resource").filter(({ name }) => name.startsWith(folder));
  return { image, files: read.map(({ name, encodedBodySize }) => [name.slice(folder.length), encodedBodySize]) };
};
