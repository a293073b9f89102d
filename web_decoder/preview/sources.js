/** Sources of scenes: the page's address, the page itself, or a file. */

import { fileTypeOfFormat } from "./file_types.js";
import { isManifest } from "./lod_tree.js";
import { UserError } from "./problem.js";

/**
 * @typedef {object} Source
 * @property {string} name
 * @property {string | Blob} container
 * @property {number} [bytes] size of the container
 * @property {boolean} [zipped] whether it is a zip at an address, whose response tells its size
 * @property {RequestInit} [request]
 * @property {{url: string, bytes: number, type: import("./file_types.js").FileType} | null} [original]
 *   address, size and type of the original, if it is a file that Spark reads
 * @property {number} [originalBytes]
 */

/** Return the key that the user entered on the service's page, stored for this tab. */
const key = () => sessionStorage.getItem("kissgs-key") ?? "";

/** @returns {RequestInit} */
const withKey = () => (key() ? { headers: { Authorization: `Bearer ${key()}` } } : {});

/** The scene inside this page, as `kissgs view -o` writes it: base64, and its name. */
const embedded = document.getElementById("embedded-scene");

/** Whether this page holds its scene and all its files, and may stand anywhere. */
export const standsAlone = embedded !== null;

/**
 * Return the source inside this page, or the one that its address names.
 * @param {Location} location
 * @param {AbortSignal} signal
 * @returns {Promise<Source>}
 */
export async function addressed(location, signal) {
  if (embedded) return ofElement(embedded);
  const job = jobIn(location);
  if (job) return ofJob(job, signal);
  return ofAddress(new URLSearchParams(location.search).get("src") ?? "", location.href);
}

/** @param {HTMLElement} element @returns {Source} */
function ofElement(element) {
  const text = atob(element.textContent);
  element.textContent = "";
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  return { name: element.dataset.name ?? "scene", container: new Blob([bytes]), bytes: bytes.length };
}

/**
 * @param {string} address
 * @param {string} here
 * @returns {Source}
 */
function ofAddress(address, here) {
  try {
    const url = new URL(address, here);
    const path = url.pathname.replace(/\/((lod-)?meta\.json|levels\.json)?$/, "");
    const name = decodeURIComponent(path.slice(path.lastIndexOf("/") + 1));
    return { name: name || url.host, container: url.href, zipped: path === url.pathname };
  } catch {
    throw new UserError("What this page is to open is not an address: check what stands after “src=” in its own.");
  }
}

/** @param {Location} location */
export const jobIn = (location) => location.pathname.match(/\/preview\/([0-9a-f]{32})\/?$/)?.[1] ?? null;

/** @param {Location} location */
export const namesSource = (location) =>
  standsAlone || jobIn(location) !== null || new URLSearchParams(location.search).has("src");

/**
 * @param {string} id
 * @param {AbortSignal} signal
 * @returns {Promise<Source>}
 */
async function ofJob(id, signal) {
  const request = withKey();
  const job = `../v1/jobs/${id}`; // relative: the service may be served under a prefix
  const status = await (await get(job, { ...request, signal })).json();
  if (!status.sizes) throw new UserError(`This job has no container to show: it is ${status.state}.`);
  const type = (status.links.source && fileTypeOfFormat(status.source_format ?? "ply")) || null;
  const file = status.links.files ? null : `${status.name}.${status.options.format}`; // no container
  return {
    name: file ?? status.name,
    container: new URL(`${job}/${file ? "result" : "files/"}`, window.location.href).href,
    bytes: status.sizes.container,
    request,
    original: type && { url: `${job}/source`, bytes: status.upload_bytes, type },
    originalBytes: status.upload_bytes,
  };
}

/**
 * Fetch a file; errors are sentences.
 * @param {string} url
 * @param {RequestInit} init
 */
export async function get(url, init) {
  const response = await fetch(url, init).catch((error) => {
    throw init.signal?.aborted
      ? error
      : new UserError("The server cannot be reached: check your network, then reload.");
  });
  if (response.status === 401)
    throw new UserError("This service wants a key: enter it on its page, then open the preview from there.");
  if (response.status === 404 || response.status === 410)
    throw new UserError("The server does not have this any more.");
  if (!response.ok) throw new UserError(`The server answered with status ${response.status}.`);
  return response;
}

/**
 * Download a file, with progress.
 * @param {{url: string, bytes: number}} file address, and its size if that is known, else 0
 * @param {import("./loading.js").Load} load
 */
export async function download({ url, bytes: total }, load) {
  const response = await get(url, { ...withKey(), signal: load.signal });
  const parts = [];
  let received = 0;
  const reader = /** @type {ReadableStream<Uint8Array<ArrayBuffer>>} */ (response.body).getReader();
  for (let part = await reader.read(); !part.done; part = await reader.read()) {
    parts.push(part.value);
    load.progress({ received: (received += part.value.length), total: Math.max(total, received) });
  }
  return new Uint8Array(await new Blob(parts).arrayBuffer());
}

/** Throw an error for files that say what they are by their names, but cannot be opened here. @param {string} name */
export function refuse(name) {
  const kind = isManifest(`/${name}`)
    ? "the list of a scene's files alone"
    : /\.(glb|gltf)$/i.test(name)
      ? "glTF"
      : null;
  if (kind) throw new UserError(`This page does not open ${kind}; "kissgs view ${name}" does.`);
}
