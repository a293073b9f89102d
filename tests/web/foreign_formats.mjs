/**
 * Readers and writers that others wrote, for the tests of formats. Usage: foreign_formats.mjs WORK FILE [ARGUMENT…]
 *
 * - `read-spz FILE FRAME`: the format's own library; prints the scene in the axes of FRAME.
 * - `write-spz FILE FRAME VERSION`: the same; writes the scene of standard input, which has the axes of FRAME.
 * - `read-ksplat FILE`, `write-ksplat FILE PLY LEVEL`, `read-splat FILE`: GaussianSplats3D, from which `.ksplat` is.
 * - `read-glb FILE`: three.js; prints the accessors of the only primitive, and its `.spz` (axes of glTF).
 * - `read-glb-in-cesium FILE`: Cesium, which knows the extension for `.spz`; prints the attributes that it will draw.
 * - `validate-glb FILE`: Khronos' validator; prints its messages.
 */

import { readFileSync, writeFileSync } from "node:fs";

const MODULES = new URL("../../web_decoder/node_modules/", import.meta.url);
const SPZ = "KHR_gaussian_splatting_compression_spz_2";
const FIELDS = ["positions", "rotations", "scales", "alphas", "colors", "sh"];

const [work, file, ...given] = process.argv.slice(2);
const load = (name) => import(new URL(name, MODULES));
const bytesOf = (path) => new Uint8Array(readFileSync(path));
const bufferOf = (path) => bytesOf(path).slice().buffer;

/** Return the library of `.spz`; its messages would stand among the output. */
const spzLibrary = async () => (await load("@adobe/spz/dist/spz.js")).default({ print() {}, printErr() {} });

async function readSpz(bytes, frame) {
  const spz = await spzLibrary();
  const cloud = spz.loadSpzFromBuffer(bytes, { to: spz.CoordinateSystem[frame] });
  const { numPoints, shDegree } = cloud;
  return { numPoints, shDegree, ...Object.fromEntries(FIELDS.map((name) => [name, cloud[name]])) };
}

async function writeSpz(path, frame, version) {
  const spz = await spzLibrary();
  const scene = JSON.parse(readFileSync(0, "utf8"));
  const arrays = FIELDS.map((name) => [name, new Float32Array(scene[name])]);
  const cloud = { ...scene, ...Object.fromEntries(arrays), antialiased: false, extensions: [] };
  const options = { version: Number(version), from: spz.CoordinateSystem[frame], sh1Bits: 8, shRestBits: 8 };
  writeFileSync(path, spz.saveSpzToBuffer(cloud, options));
}

async function gaussianSplats3D() {
  const library = await load("@mkkellogg/gaussian-splats-3d/build/gaussian-splats-3d.module.js");
  return { ...library, three: await load("three/build/three.module.js") };
}

async function writeKsplat(path, ply, level) {
  const { PlyParser, SplatBufferGenerator, three } = await gaussianSplats3D();
  const padded = new Uint8Array([...bytesOf(ply), ...new Uint8Array(4096)]); // it does not read short headers else
  const scene = PlyParser.parseToUncompressedSplatArray(padded.buffer, 2);
  const generator = SplatBufferGenerator.getStandardGenerator(0, Number(level), 0, new three.Vector3(), 5, 256);
  writeFileSync(path, new Uint8Array(generator.generateFromUncompressedSplatArray(scene).bufferData));
}

async function readKsplat(path) {
  const { SplatBuffer, three } = await gaussianSplats3D();
  const splats = new SplatBuffer(bufferOf(path));
  const count = splats.getSplatCount();
  const degree = splats.getMinSphericalHarmonicsDegree();
  const [centre, scale, rotation, color] = [
    new three.Vector3(),
    new three.Vector3(),
    new three.Quaternion(),
    new three.Vector4(),
  ];
  const rows = [];
  for (let i = 0; i < count; i++) {
    splats.getSplatCenter(i, centre);
    splats.getSplatScaleAndRotation(i, scale, rotation);
    splats.getSplatColor(i, color);
    const { w, x, y, z } = rotation;
    rows.push([...centre.toArray(), ...scale.toArray(), w, x, y, z, ...color.toArray()]);
  }
  const sh = new Float32Array(count * [0, 9, 24][degree]);
  if (degree) splats.fillSphericalHarmonicsArray(sh, degree, new three.Matrix4(), 0, count - 1, 0, 0);
  return { degree, rows, sh };
}

/** Rows as those of `readKsplat`. */
async function readSplat(path) {
  const { SplatParser } = await gaussianSplats3D();
  return { rows: SplatParser.parseStandardSplatToUncompressedSplatArray(bufferOf(path)).splats };
}

async function readGlb(path) {
  const { GLTFLoader } = await load("three/examples/jsm/loaders/GLTFLoader.js");
  const { parser } = await new GLTFLoader().parseAsync(bufferOf(path), "");
  const [primitive] = parser.json.meshes[0].primitives;
  const columns = {};
  for (const [name, index] of Object.entries(primitive.attributes)) {
    const { array, itemSize, normalized } = await parser.getDependency("accessor", index);
    columns[name] = { values: array, width: itemSize, normalized };
  }
  const inside = primitive.extensions.KHR_gaussian_splatting.extensions?.[SPZ];
  const packed = inside && new Uint8Array(await parser.getDependency("bufferView", inside.bufferView));
  return { columns, spz: packed && (await readSpz(packed, "LUF")) };
}

async function readGlbInCesium(path) {
  globalThis.Image = class {
    set src(_address) {
      queueMicrotask(() => this.onerror()); // it only asks whether there is WebP
    }
  };
  const { GltfLoader, JobScheduler, Resource } = await load("@cesium/engine/index.js");
  const [gltfResource, baseResource] = [new Resource({ url: "scene.glb" }), new Resource({ url: "." })];
  const typedArray = bytesOf(path);
  const loader = new GltfLoader({ gltfResource, baseResource, typedArray, loadAttributesAsTypedArray: true });
  const { process } = globalThis;
  delete globalThis.process; // as in a browser: its build of the library of .spz does not start in Node
  await loader.load();
  const frame = { context: {}, jobScheduler: new JobScheduler(), afterRender: [] };
  while (!loader.process(frame)) await new Promise((resolve) => setTimeout(resolve, 1));
  globalThis.process = process;
  const { attributes } = loader.components.nodes[0].primitives[0];
  return Object.fromEntries(attributes.map((item) => [item.name, item.typedArray]));
}

async function validateGlb(path) {
  const { default: validator } = await load("gltf-validator/index.js");
  return (await validator.validateBytes(bytesOf(path), { maxIssues: 0 })).issues.messages;
}

const WORKS = {
  "read-spz": (path, frame) => readSpz(bytesOf(path), frame),
  "write-spz": writeSpz,
  "read-ksplat": readKsplat,
  "write-ksplat": writeKsplat,
  "read-splat": readSplat,
  "read-glb": readGlb,
  "read-glb-in-cesium": readGlbInCesium,
  "validate-glb": validateGlb,
};

/** JSON has no infinite numbers, which the opacities of bytes 0 and 255 are. */
function forJson(_key, value) {
  if (ArrayBuffer.isView(value)) return [...value];
  return typeof value === "number" && !Number.isFinite(value) ? String(value) : value;
}

process.stdout.write(JSON.stringify((await WORKS[work](file, ...given)) ?? null, forJson));
