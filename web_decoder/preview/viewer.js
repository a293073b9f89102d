/** Rendering of a scene on a canvas by Spark, only when something has changed. */

import * as THREE from "three";
import { SparkRenderer, SplatFileType, SplatMesh } from "@sparkjsdev/spark";
import { openAt, setAngle, setPinhole, sightOf } from "./camera.js";
import { CLASSIC, WIDE_RANGES, dilation, drawFromOutside } from "./classic.js";
import { extentOf, extentOfScene, gaussiansOf, gaussiansOfMesh } from "./extent.js";
import { isMarked, pointsUp, viewInFile } from "./file_types.js";
import { marker } from "./marker.js";
import { pack } from "./pack.js";
import { readPixels } from "./pixels.js";
import { isAntialiased, originOf } from "./scene.js";
import { meshOf } from "./streamed_meshes.js";
import { checkedView, viewOfDense, viewOfExtent } from "./view.js";

/**
 * @typedef {import("./scene.js").Scene} Scene
 * @typedef {import("./camera.js").Pinhole} Pinhole
 * @typedef {import("./extent.js").Extent} Extent
 * @typedef {{content: import("./streamed_meshes.js").Content, ranges: [number, number][]}} Part
 */

export class Viewer {
  #renderer;
  #spark;
  #scene = new THREE.Scene();
  #marker = marker();
  /** All meshes: of a scene that is streamed, by file; of others, one. @type {Map<number, SplatMesh>} */
  #meshes = new Map();
  /** @type {Scene | null} */
  #shown = null;
  /** Whether the extent is final, because all images that it depends on have arrived. */
  #placed = false;
  /** @type {Extent} */
  #extent = { centre: [0, 0, 0], radius: 1 };
  /** The view that home() returns to. */
  #view = viewOfExtent(this.#extent);
  /** @type {import("./pack.js").Encoding} */
  #encoding = WIDE_RANGES;
  /** Whether a scene that is drawn in parts has a recorded view. */
  #recorded = false;
  /** Whether a frame has had Gaussians of this scene in it. */
  #filled = false;
  #requested = 0;
  #disposed = false;

  /** Point of the world that the scene's positions are relative to. @type {number[]} */
  origin = [0, 0, 0];

  /**
   * @param {HTMLCanvasElement} canvas
   * @param {{afterFrame?: () => void, lost?: () => void}} [options] `lost`: called if the graphics driver resets
   */
  constructor(canvas, { afterFrame = () => {}, lost = () => {} } = {}) {
    this.canvas = canvas;
    this.camera = new THREE.PerspectiveCamera(50, 1);
    this.afterFrame = afterFrame;
    this.lost = lost;
    this.#renderer = new THREE.WebGLRenderer({ canvas, antialias: false, alpha: false, preserveDrawingBuffer: true });
    this.#renderer.toneMapping = THREE.NoToneMapping;
    this.#spark = new SparkRenderer({ renderer: this.#renderer, onDirty: () => this.invalidate(), ...CLASSIC });
    drawFromOutside(this.#spark);
    this.#scene.add(this.#spark, this.#marker.object);
    this.setBackground("#000000");
    canvas.addEventListener("webglcontextlost", (event) => {
      event.preventDefault();
      if (!this.#disposed) this.lost();
    });
  }

  /** The extent of the scene, whose centre is the origin of the viewer's frame. */
  get extent() {
    return this.#extent;
  }

  /** Whether opacities are compensated for the dilation, as in scenes trained with antialiasing. @param {boolean} value */
  set antialiased(value) {
    Object.assign(this.#spark, dilation(value));
    this.invalidate();
  }

  /** The ranges of Spark's quantisation, so that another viewer can use the same. */
  get encoding() {
    return this.#encoding;
  }

  /**
   * Show a decoded scene, or update it when more of its images have arrived.
   * @param {Scene} scene
   * @param {Partial<import("./scene.js").Parts>} [parts] which parts have arrived; default: all
   * @param {boolean} [held] whether the user has moved the camera, so that the origin must not change
   */
  setScene(scene, { placed = true, sized = true, spherical = true } = {}, held = false) {
    if (scene !== this.#shown) this.#filled = false;
    if (scene !== this.#shown || !this.#placed) {
      const extent = extentOfScene(scene);
      this.#extent = held && scene === this.#shown ? { ...extent, centre: this.#extent.centre } : extent;
      this.#view = checkedView(scene.meta?.kissgs?.view) ?? viewOfDense(...gaussiansOf(scene));
    }
    [this.#shown, this.#placed] = [scene, placed];
    const spacing = this.#extent.radius / Math.cbrt(scene.count);
    const { splats, encoding } = pack(scene, this.#extent.centre, { size: sized ? null : spacing / 2, spherical });
    this.#encoding = encoding;
    this.antialiased = isAntialiased(scene);
    this.origin = originOf(scene);
    this.#replace(new SplatMesh({ packedSplats: splats, splatEncoding: encoding })); // or the mesh would reset it
  }

  /**
   * Show a file that Spark reads.
   * @param {import("./file_types.js").FileType} type
   * @param {Uint8Array} bytes
   * @param {Viewer} [beside] viewer whose frame and view are used
   * @returns {Promise<number>} the number of Gaussians
   */
  async setFile(type, bytes, beside) {
    const splatEncoding = beside?.encoding ?? WIDE_RANGES;
    const fileType = /** @type {SplatFileType} */ (type); // its values are these names
    const [marked, view] = [await isMarked(type, bytes), viewInFile(type, bytes)]; // the mesh may take the bytes away
    const mesh = new SplatMesh({ fileBytes: bytes, fileType, splatEncoding });
    await mesh.initialized;
    [this.#shown, this.#filled] = [null, false];
    this.antialiased = marked;
    if (beside) [this.#extent, this.#view] = [beside.#extent, beside.#view];
    else {
      const gaussians = gaussiansOfMesh(mesh, pointsUp(type));
      this.#extent = extentOf(...gaussians);
      this.#view = view ?? viewOfDense(...gaussians);
    }
    const [x, y, z] = this.#extent.centre.map((value, axis) => value + (beside?.origin[axis] ?? 0));
    mesh.position.set(-x, y, z);
    this.#replace(mesh, pointsUp(type));
    return mesh.numSplats;
  }

  /**
   * Begin a scene that will be drawn in parts, and has none yet.
   * @param {Extent} extent
   * @param {import("./view.js").View | null} [view] the recorded one
   */
  setExtent(extent, view = null) {
    [this.#shown, this.#filled] = [null, false];
    this.#extent = extent;
    this.#view = view ?? viewOfExtent(extent);
    this.#recorded = view !== null;
    this.setParts(new Map([...this.#meshes.keys()].map((key) => [key, null])));
  }

  /**
   * Place what is drawn in parts anew.
   * @param {Extent} extent
   * @param {boolean} held whether the user has moved the camera, so that the origin must not change
   */
  refineExtent({ centre, radius }, held) {
    const former = this.#extent.centre;
    this.#extent = { centre: held ? former : centre, radius };
    if (!this.#recorded) this.#view = viewOfExtent({ centre, radius });
    const [x, y, z] = former.map((value, axis) => value - this.#extent.centre[axis]);
    for (const mesh of this.#meshes.values()) mesh.position.add(new THREE.Vector3(x, -y, -z));
    this.invalidate();
  }

  /**
   * Show other parts of the scene, or none instead of what they were; Spark sorts the Gaussians of all parts together.
   * @param {Map<number, Part | null>} parts
   */
  setParts(parts) {
    for (const [key, part] of parts) this.#put(key, part && meshOf(part.content, part.ranges, this.#extent.centre));
    this.invalidate();
  }

  /** What the camera sees, in the scene's frame. */
  get sight() {
    const { width, height } = this.canvas;
    return sightOf(this.camera, this.#extent.centre, width, height);
  }

  /** @param {SplatMesh} mesh @param {boolean} [up] whether its y points up, as in three.js */
  #replace(mesh, up = false) {
    for (const key of [...this.#meshes.keys()]) this.#put(key, null);
    this.#put(0, mesh, up);
    this.invalidate();
  }

  /** @param {number} key @param {SplatMesh | null} mesh @param {boolean} [up] */
  #put(key, mesh, up = false) {
    const former = this.#meshes.get(key);
    if (former) {
      this.#scene.remove(former);
      former.dispose();
      this.#meshes.delete(key);
    }
    if (!mesh) return;
    if (!up) mesh.quaternion.set(1, 0, 0, 0); // scenes have y down and z ahead
    this.#meshes.set(key, mesh);
    this.#scene.add(mesh);
  }

  /** Move the camera to the view that the scene opens with; return what it then turns about. */
  home() {
    this.invalidate();
    return openAt(this.camera, this.#view, this.#extent.centre);
  }

  /** @param {Pinhole} pinhole */
  setCamera(pinhole) {
    this.#renderer.setPixelRatio(1);
    this.#renderer.setSize(pinhole.width, pinhole.height, false);
    setPinhole(this.camera, pinhole, this.#extent.centre);
  }

  /** @param {THREE.PerspectiveCamera} camera of a viewer that this one follows */
  follow(camera) {
    this.camera.copy(camera);
    this.invalidate();
  }

  /**
   * @param {number} width CSS pixels
   * @param {number} height
   * @param {number} ratio pixels per CSS pixel
   * @param {number} covered CSS pixels at the bottom that the scene is not centred in, since buttons are over them
   */
  resize(width, height, ratio, covered) {
    this.#renderer.setPixelRatio(ratio);
    this.#renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.setViewOffset(width, height, 0, covered / 2, width, height);
    setAngle(this.camera, this.#view.fov);
    this.#draw(); // at once: a resized canvas is blank until then
  }

  /** @param {string} colour */
  setBackground(colour) {
    this.#renderer.setClearColor(colour, 1);
    this.invalidate();
  }

  /**
   * Mark a Gaussian, visible through all that is in front of it; null removes the mark.
   * @param {import("./scene.js").Gaussian | null} gaussian
   */
  mark(gaussian) {
    if (!gaussian && !this.#marker.object.visible) return; // a frame may take seconds
    this.#marker.show(gaussian, this.#extent.centre);
    this.invalidate();
  }

  /** Draw in the next animation frame, once for all changes until then. */
  invalidate() {
    if (!this.#requested && !this.#disposed) this.#requested = requestAnimationFrame(() => this.#draw());
  }

  #draw() {
    cancelAnimationFrame(this.#requested);
    this.#requested = 0;
    this.#renderer.render(this.#scene, this.camera);
    // Until the Gaussians of another scene are sorted, Spark goes on with those of the former one.
    this.#filled ||= this.#spark.display.mapping.some(({ node, count }) => count > 0 && node.parent === this.#scene);
    this.afterFrame();
  }

  /** Draw with all Gaussians sorted for this camera. */
  async render() {
    this.#scene.updateMatrixWorld();
    this.camera.updateMatrixWorld();
    await this.#sorted(); // of an earlier camera
    await this.#spark.update({ scene: this.#scene, camera: this.camera });
    await this.#sorted();
    this.#draw();
  }

  /** Whether Gaussians of this scene have been drawn: Spark sorts them before. */
  get hasDrawn() {
    return this.#filled;
  }

  /** Wait until the graphics driver has drawn all frames until now; software takes seconds for one. */
  async finished() {
    const gl = /** @type {WebGL2RenderingContext} */ (this.#renderer.getContext());
    const fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    while (fence && !this.#disposed && gl.getSyncParameter(fence, gl.SYNC_STATUS) === gl.UNSIGNALED)
      await new Promise((resolve) => setTimeout(resolve, 10));
    gl.deleteSync(fence);
  }

  async #sorted() {
    while ((this.#spark.sorting || this.#spark.sortDirty) && !this.#renderer.getContext().isContextLost())
      await new Promise((resolve) => setTimeout(resolve, 4));
  }

  /** Return the pixels of the canvas: RGBA, top row first. */
  readPixels() {
    return readPixels(this.#renderer);
  }

  /** Free all resources, after Spark has finished sorting, which would otherwise fail with an error that cannot be caught. */
  async dispose() {
    this.#disposed = true;
    cancelAnimationFrame(this.#requested);
    this.#spark.sortDirty = false;
    await this.#sorted();
    for (const mesh of this.#meshes.values()) mesh.dispose();
    this.#spark.dispose();
    this.#renderer.dispose();
    this.#renderer.forceContextLoss(); // browsers keep few contexts
  }
}
