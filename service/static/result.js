/** The view of a succeeded job: results and downloads. */

import { call } from "./api.js";
import { el, facts, time } from "./dom.js";
import { ago, bytes, capitalised, count, duration, moment, share, short } from "./format.js";
import { formatLabel, formatOf } from "./container_formats.js";
import { explain, problemBox, sentence } from "./problems.js";
import { cleaningNotes, goalLabels, planes } from "./labels.js";

/**
 * @typedef {import("./api.js").Status} Status
 * @typedef {import("./api.js").Sizes} Sizes
 */

/**
 * @param {Status & {sizes: Sizes}} status
 * @param {boolean} keyed whether downloads need a key, which links cannot send
 */
export function resultView(status, keyed) {
  const { sizes, name } = status;
  const notes = cleaningNotes(status);
  return [
    el("p", { class: "kicker good" }, "Done"),
    el("h1", { id: "job-title", tabindex: "-1" }, name),
    ratio(status),
    downloads(status, keyed),
    figures(status),
    status.note ? el("p", { class: "small muted" }, sentence(status.note)) : null,
    status.links.files ? planeTable(sizes) : null,
    notes.length ? notesList(notes) : null,
  ].filter((child) => child !== null);
}

/** @param {Status & {sizes: Sizes}} status */
function ratio(status) {
  const { sizes } = status;
  const filled = el("span");
  filled.style.inlineSize = `${Math.min(100, 100 / sizes.ratio)}%`;
  const [before, after] = [bytes(status.upload_bytes), bytes(sizes.container)];
  return el(
    "div",
    { class: "ratio" },
    el("p", {}, el("strong", {}, `${short(sizes.ratio)}×`), " smaller"),
    el("div", { class: "beside", "aria-hidden": "true" }, filled),
    el("p", { class: "spread" }, el("span", {}, el("b", {}, after), " result"), el("span", {}, `${before} upload`)),
  );
}

/** @param {Status & {sizes: Sizes}} status */
function figures(status) {
  const { sizes, timings, evaluation, finetuning, options } = status;
  const [waited, kept] = [timings.queue_seconds ?? 0, status.kept ?? status.gaussians];
  const limit = options.time_limit ? `limit ${duration(options.time_limit)}` : "";
  const spent = [limit, waited >= 1 ? `after ${duration(waited)} in the queue` : ""].filter(Boolean);
  const [goal, ...goals] = goalLabels(options.encode);
  /** @type {[string, string, string?][]} */
  const pairs = [
    ["Per Gaussian", `${short(sizes.bytes_per_gaussian)} bytes`],
    ["Gaussians", count(kept), kept === status.gaussians ? "all of them" : `of ${count(status.gaussians)}`],
    ["Time", duration(timings.run_seconds ?? 0), spent.join(", ")],
    ["Format", formatLabel(formatOf(status))],
  ];
  if (status.links.files) pairs.push(["Preset", options.preset]); // what is no container holds the scene as it is
  if (goal) pairs.push(["Goal", capitalised(goal), goals.length ? `and ${goals.join(", ")}` : undefined]);
  if (finetuning) pairs.push(["Fine-tuning", gain(finetuning), "on held-out views"]);
  if (evaluation) {
    const { psnr, ssim, ms_ssim, worst, reference, candidate } = evaluation; // no PSNR if the images are identical
    pairs.push([
      "PSNR",
      typeof psnr === "number" ? `${psnr.toFixed(2)} dB` : "identical",
      "to the upload's renderings",
    ]);
    if (typeof candidate?.psnr === "number" && typeof reference?.psnr === "number") {
      const scene = `the upload has ${reference.psnr.toFixed(2)} dB`;
      pairs.push(["PSNR to photographs", `${candidate.psnr.toFixed(2)} dB`, `held out; ${scene}`]);
    }
    pairs.push(["SSIM", ssim.toFixed(4), "1 is identical"]);
    if (typeof ms_ssim === "number") pairs.push(["MS-SSIM", ms_ssim.toFixed(4), "1 is identical"]);
    if (typeof worst?.psnr === "number") {
      pairs.push(["Worst view", `${worst.psnr.toFixed(2)} dB`, `from ${point(worst.position)}`]);
    }
  }
  return facts(pairs);
}

/** @param {number[]} position */
function point(position) {
  return `(${position.map((value) => Number(value.toPrecision(4))).join(", ")})`;
}

/** @param {NonNullable<Status["finetuning"]>} finetuning */
function gain({ kept, psnr_before: before, psnr_after: after, bytes_before: first, bytes_after: last }) {
  if (!kept || before === null || after === null || first === null) return kept ? "kept" : "no improvement";
  const [psnr, share] = [after - before, (100 * last) / first - 100];
  return `${psnr < 0 ? "−" : "+"}${Math.abs(psnr).toFixed(2)} dB, ${share < 0 ? "−" : "+"}${Math.abs(share).toFixed(1)} %`;
}

/** @param {Sizes} sizes */
function planeTable(sizes) {
  const rows = planes(sizes.files);
  const largest = Math.max(...rows.map(([, size]) => size));
  const total = rows.reduce((sum, [, size]) => sum + size, 0); // without the zip's directory
  const lines = rows.map(([name, size]) => {
    const bar = el("span");
    bar.style.inlineSize = `${(100 * size) / largest}%`;
    return el(
      "tr",
      {},
      el("th", { scope: "row" }, name),
      el("td", { class: "bar", "aria-hidden": "true" }, bar),
      el("td", {}, bytes(size)),
      el("td", { class: "muted share" }, share(size / total)),
    );
  });
  const head = (/** @type {string} */ text, /** @type {string} */ kind) =>
    el("th", { scope: "col", class: kind }, el("span", { class: "visually-hidden" }, text));
  const heads = [
    head("Part", "part"),
    el("td", { "aria-hidden": "true" }),
    head("Size", "size"),
    head("Share", "share"),
  ];
  return el(
    "table",
    { class: "planes" },
    el("caption", {}, "Where the bytes go"),
    el("thead", {}, el("tr", {}, ...heads)),
    el("tbody", {}, ...lines),
  );
}

/** @param {string[]} notes */
function notesList(notes) {
  const items = notes.map((note) => el("li", {}, note));
  return el("section", { class: "notes" }, el("h2", {}, "Corrected in the upload"), el("ul", {}, ...items));
}

/**
 * @param {Status} status
 * @param {boolean} keyed
 */
function downloads(status, keyed) {
  const { name, links, expires_at: expires } = status;
  const { ending } = formatOf(status);
  const message = el("div");
  /** @type {[string, string, string, string][]} */
  const all = [
    ["result", `Download (${ending})`, `${name}${ending}`, "primary"],
    ["decoded", "Decoded .ply", `${name}.decoded.ply`, "quiet"],
    ["report", "Report", `${name}.report.json`, "quiet"],
  ];
  const buttons = all
    .filter(([link]) => links[link])
    .map(([link, label, file, kind]) =>
      keyed
        ? fetchButton(links[link], label, file, kind, message)
        : el("a", { class: `button ${kind}`, href: links[link], download: file }, label),
    );
  // in this tab, because other tabs do not have the key
  const preview = links.preview ? el("a", { class: "button quiet", href: links.preview }, "Preview") : null;
  const [container, ...others] = buttons;
  const until = expires
    ? el("p", { class: "small muted" }, "Kept until ", time(expires, moment(expires)), `, ${ago(expires)}.`)
    : null;
  return el(
    "div",
    { class: "downloads" },
    el("div", { class: "buttons" }, container, preview, ...others),
    until,
    message,
  );
}

/**
 * Create a download button that sends the key in a header, which links cannot.
 * @param {string} path
 * @param {string} label
 * @param {string} file
 * @param {string} kind
 * @param {HTMLElement} message element for errors
 */
function fetchButton(path, label, file, kind, message) {
  const button = el("button", { class: kind, type: "button", onclick: press }, label);
  async function press() {
    button.disabled = true;
    button.textContent = "Downloading…";
    message.replaceChildren();
    try {
      save(await (await call(path)).blob(), file);
    } catch (error) {
      message.replaceChildren(problemBox(explain(error)));
    }
    button.disabled = false;
    button.textContent = label;
    button.focus();
  }
  return button;
}

/**
 * @param {Blob} blob
 * @param {string} file
 */
function save(blob, file) {
  const url = URL.createObjectURL(blob);
  el("a", { href: url, download: file }).click();
  setTimeout(() => URL.revokeObjectURL(url), 60_000); // some browsers start reading late
}
