/**
 * Spark, for the tests of files in viewers: `draw` shows a file to cameras and returns the pixels. With its own settings
 * if the address ends in `?defaults`, else with those of the original rasteriser.
 */

import * as THREE from "three";
import { SparkRenderer, SplatFileType, SplatMesh } from "@sparkjsdev/spark";
import { CLASSIC, WIDE_RANGES } from "/web_decoder/preview/classic.js";
import { setPinhole } from "/web_decoder/preview/camera.js";
import { bytesOf, canvas, textOf } from "./viewer_page.mjs";

const TYPES = {
  sog: SplatFileType.PCSOGSZIP,
  ply: SplatFileType.PLY,
  "compressed.ply": SplatFileType.PLY,
  spz: SplatFileType.SPZ,
  splat: SplatFileType.SPLAT,
};

const own = location.search === "?defaults";
const renderer = new THREE.WebGLRenderer({ canvas, antialias: false, preserveDrawingBuffer: true });
renderer.setPixelRatio(1);
const spark = new SparkRenderer({ renderer, ...(own ? {} : CLASSIC) });
const camera = new THREE.PerspectiveCamera();

window.draw = async ({ file, ending, cameras, background }) => {
  const ranges = own ? {} : { splatEncoding: WIDE_RANGES };
  const mesh = new SplatMesh({ fileBytes: bytesOf(file), fileType: TYPES[ending], ...ranges });
  await mesh.initialized;
  if (ending !== "spz") mesh.quaternion.set(1, 0, 0, 0); // y down, as all other files have it
  const scene = new THREE.Scene();
  scene.add(spark, mesh);
  renderer.setClearColor(background, 1);
  const images = [];
  for (const pinhole of cameras) {
    renderer.setSize(pinhole.width, pinhole.height, false);
    setPinhole(camera, pinhole, [0, 0, 0]);
    scene.updateMatrixWorld();
    camera.updateMatrixWorld();
    for (let again = 0; again < 2; again++) {
      await spark.update({ scene, camera });
      while (spark.sorting || spark.sortDirty) await new Promise((resolve) => setTimeout(resolve, 4));
    }
    renderer.render(scene, camera);
    images.push(textOf(renderer.getContext()));
  }
  scene.remove(spark, mesh);
  const count = mesh.numSplats;
  mesh.dispose();
  return { count, images };
};
