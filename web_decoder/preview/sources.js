/** Where a scene comes from: the page's own address, or a file. */

import { Trouble } from "./trouble.js";

/**
 * @typedef {object} Source
 * @property {string} name
 * @property {string | Blob} container
 * @property {number} [bytes] of the container
 * @property {boolean} [zipped] whether it is a zip at an address, which says itself how long it is
 * @property {RequestInit} [request]
 * @property {{url: string, bytes: number} | null} [original] where the .ply can be had
 * @property {number} [originalBytes]
 */

/** What the service's page has been told, for this tab. */
const key = () => sessionStorage.getItem("kissgs-key") ?? "";

/** @returns {RequestInit} */
const withKey = () => (key() ? { headers: { Authorization: `Bearer ${key()}` } } : {});

/**
 * What the address names.
 * @param {Location} location
 * @param {AbortSignal} signal
 * @returns {Promise<Source>}
 */
export async function addressed(location, signal) {
  const job = jobIn(location);
  if (job) return ofJob(job, signal);
  return ofAddress(new URLSearchParams(location.search).get("src") ?? "", location.href);
}

/**
 * @param {string} address
 * @param {string} here
 * @returns {Source}
 */
function ofAddress(address, here) {
  try {
    const url = new URL(address, here);
    const path = url.pathname.replace(/\/(meta\.json)?$/, "");
    const name = decodeURIComponent(path.slice(path.lastIndexOf("/") + 1));
    return { name: name || url.host, container: url.href, zipped: path === url.pathname };
  } catch {
    throw new Trouble("What this page is to open is not an address: check what stands after “src=” in its own.");
  }
}

/** @param {Location} location */
export const jobIn = (location) => location.pathname.match(/\/preview\/([0-9a-f]{32})\/?$/)?.[1] ?? null;

/** @param {Location} location */
export const namesSource = (location) => jobIn(location) !== null || new URLSearchParams(location.search).has("src");

/**
 * @param {string} id
 * @param {AbortSignal} signal
 * @returns {Promise<Source>}
 */
async function ofJob(id, signal) {
  const request = withKey();
  const job = `../v1/jobs/${id}`; // relative: the service may be served under a prefix
  const status = await (await get(job, { ...request, signal })).json();
  if (!status.sizes) throw new Trouble(`This job has no container to show: it is ${status.state}.`);
  return {
    name: status.name,
    container: new URL(`${job}/files/`, window.location.href).href,
    bytes: status.sizes.container,
    request,
    original: status.links.source ? { url: `${job}/source`, bytes: status.upload_bytes } : null,
    originalBytes: status.upload_bytes,
  };
}

/**
 * @param {string} url
 * @param {RequestInit} init
 */
async function get(url, init) {
  const answer = await fetch(url, init).catch((error) => {
    throw init.signal?.aborted ? error : new Trouble("The server cannot be reached: check your network, then reload.");
  });
  if (answer.status === 401)
    throw new Trouble("This service wants a key: enter it on its page, then open the preview from there.");
  if (answer.status === 404 || answer.status === 410) throw new Trouble("The server does not have this any more.");
  if (!answer.ok) throw new Trouble(`The server answered with status ${answer.status}.`);
  return answer;
}

/**
 * All bytes behind an address of the service, with progress.
 * @param {{url: string, bytes: number}} original
 * @param {import("./loading.js").Load} load
 */
export async function download({ url, bytes: total }, load) {
  const answer = await get(url, { ...withKey(), signal: load.signal });
  const parts = [];
  let received = 0;
  const reader = /** @type {ReadableStream<Uint8Array<ArrayBuffer>>} */ (answer.body).getReader();
  for (let part = await reader.read(); !part.done; part = await reader.read()) {
    parts.push(part.value);
    load.progress({ received: (received += part.value.length), total: Math.max(total, received) });
  }
  return new Uint8Array(await new Blob(parts).arrayBuffer());
}
