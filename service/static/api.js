/** Requests to the service: keys, problem documents, responses. */

/**
 * @typedef {{stage: string, fraction: number, note?: string, seconds_left?: number}} Progress
 * @typedef {{title: string, detail: string, code: string, status: number, retryable: boolean}} ProblemDocument
 * @typedef {{target_size?: number | null, max_psnr_drop?: number | null, max_ssim_drop?: number | null,
 *   psnr?: number | null, quality?: string | null}} Goals
 * @typedef {{ratio?: number | null, count?: number | null, max_psnr_drop?: number | null,
 *   auto_count?: boolean | null}} Budget
 * @typedef {{preset: string, format?: string, evaluate: boolean, origin?: string | null, time_limit?: number | null,
 *   capture?: string | null,
 *   encode: {rate_distortion: boolean, order: string} & Goals,
 *   compact: {method: string, sparsify_steps: number, refine_steps: number} & Budget,
 *   finetune: {enabled: boolean | null}}} JobOptions
 * @typedef {{container: number, files: Record<string, number>, ratio: number,
 *   bytes_per_gaussian: number}} Sizes
 * @typedef {{created_at: string, queue_seconds?: number, run_seconds?: number}} Timings
 * @typedef {{id: string, name: string, state: string, position?: number, progress?: Progress,
 *   estimate?: {seconds_left: number}, options: JobOptions,
 *   finetuning?: {kept: boolean, psnr_before: number | null, psnr_after: number | null, bytes_before: number | null,
 *     bytes_after: number},
 *   upload_bytes: number, gaussians: number, sh_degree: number, kept?: number, compacted?: number, invisible?: number, cleaned?: Record<string, number>,
 *   evaluation?: {psnr?: number | null, ssim: number, ms_ssim?: number, reference?: {psnr: number | string | null},
 *     candidate?: {psnr: number | string | null}, worst?: {psnr: number | string | null, position: number[]}}, sizes?: Sizes, timings: Timings, starts: number,
 *   note?: string, problem?: ProblemDocument, links: Record<string, string>, expires_at?: string}} Status
 * @typedef {{jobs: Status[], next: string | null}} JobPage
 * @typedef {{max_upload_bytes: number, max_capture_bytes: number, max_header_bytes: number, max_gaussians: number, job_seconds: number,
 *   formats: string[], keys_required: boolean, training: boolean}} Limits
 * @typedef {{name: string, title: string, description: string, bytes_per_gaussian: number, psnr_change: number,
 *   cpu_seconds_per_million: number, settings: {encode: {rate_distortion: boolean}}}} Preset
 * @typedef {{default: string, measured_on: string, presets: Preset[]}} Presets
 */

const STORED = "kissgs-key";

export const key = {
  /** @returns {string} empty if there is none */
  get: () => sessionStorage.getItem(STORED) ?? "",
  /** @param {string} value */
  set: (value) => sessionStorage.setItem(STORED, value),
  forget: () => sessionStorage.removeItem(STORED),
};

/** A failed request, with the service's problem document, or one of this page if the service did not respond. */
export class Problem extends Error {
  /** @param {ProblemDocument} document */
  constructor(document) {
    super(document.detail);
    this.document = document;
  }

  get code() {
    return this.document.code;
  }

  /** Whether a repetition would fail as well. */
  get final() {
    return this.document.status >= 400 && this.document.status < 500 && !this.document.retryable;
  }
}

/** Return the problem of a service that does not respond. */
export const unreachable = () =>
  new Problem({
    title: "The service cannot be reached",
    detail: "The connection failed or was interrupted. Check your network, then try again.",
    code: "unreachable",
    status: 0,
    retryable: true,
  });

/**
 * Return the problem of a failed response, which a proxy may have sent without a problem document.
 * @param {number} status
 * @param {string} body
 */
export function problemFrom(status, body) {
  try {
    const document = JSON.parse(body);
    if (typeof document.title === "string" && typeof document.detail === "string") return new Problem(document);
  } catch {
    // not JSON: handled below
  }
  const detail = `The server, or a proxy, responded with status ${status}.`;
  return new Problem({ title: "The request failed", detail, code: "unknown", status, retryable: status >= 500 });
}

/** @type {() => void} */
let onUnauthorized = () => {};

/** @param {() => void} handler called whenever a key is rejected */
export function whenUnauthorized(handler) {
  onUnauthorized = handler;
}

/** @returns {Record<string, string>} */
export const authorization = () => (key.get() ? { Authorization: `Bearer ${key.get()}` } : {});

/**
 * Return the problem of a failed response, and show the key form if a key was rejected.
 * @param {number} status
 * @param {string} body
 */
export function refused(status, body) {
  const problem = problemFrom(status, body);
  if (status === 401) onUnauthorized();
  return problem;
}

/**
 * Call `fetch` with the key; throw a problem if the response is not a success.
 * @param {string} path
 * @param {RequestInit & {headers?: Record<string, string>}} [options]
 * @throws {Problem}
 */
export async function call(path, options = {}) {
  const headers = { ...authorization(), ...options.headers };
  let answer;
  try {
    answer = await fetch(path, { ...options, headers });
  } catch (error) {
    throw options.signal?.aborted ? error : unreachable();
  }
  if (!answer.ok) throw refused(answer.status, await answer.text().catch(() => ""));
  return answer;
}

/**
 * @param {string} path
 * @param {RequestInit & {headers?: Record<string, string>}} [options]
 * @returns {Promise<any>}
 */
export const json = async (path, options) => (await call(path, options)).json();

/** @param {string} id @param {AbortSignal} [signal] @returns {Promise<Status>} */
export const status = (id, signal) => json(`/v1/jobs/${id}`, { signal });

/** @param {string} id @returns {Promise<Status>} */
export const cancel = (id) => json(`/v1/jobs/${id}/cancel`, { method: "POST" });

/** @param {string} id */
export const remove = (id) => call(`/v1/jobs/${id}`, { method: "DELETE" });

/** @param {{state: string}} job */
export const active = (job) => job.state === "queued" || job.state === "running";
