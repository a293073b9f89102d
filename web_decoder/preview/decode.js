/** Decoding of a container of either format, SOG-XT or SOG, which its metadata tells. */

import { load, parseMeta } from "../container.js";
import { Assembly, PLANES } from "../scene.js";
import { SogAssembly } from "../sog_scene.js";
import { SogxtError } from "../sogxt.js";

/** Only SOG-XT has a mask and a grid. @param {any} meta */
const isSog = (meta) => meta?.means && !("mask" in meta) && !("gridSide" in meta);

/** @type {(source: string | Blob, options: import("../types.js").Options & {pool?: import("../pool.js").Pool}) => Promise<import("../types.js").Scene>} */
export const decode = (source, options) =>
  load(source, options, {
    name: "SOG-XT or SOG",
    images: PLANES.length,
    Failure: SogxtError,
    assemble: (json, maxGaussians, yaml) =>
      isSog(parseMeta(json)) ? new SogAssembly(json, maxGaussians) : new Assembly(json, maxGaussians, yaml),
  });
