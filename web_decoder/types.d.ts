/** An image as it is stored: four bytes per pixel, row by row, alpha not premultiplied. */
export interface Plane {
  width: number;
  height: number;
  rgba: Uint8Array<ArrayBuffer>;
}

/** A part of a scene that an image gives; positions have two images, of high and of low bytes. */
export type Attribute =
  "cells" | "high means" | "low means" | "quats" | "scales" | "opacities" | "sh0" | "labels" | "centroids";

/** A scene of N Gaussians, in the order of the container's grid, row by row. */
export interface Scene {
  /** Number of Gaussians, N. */
  count: number;
  /** SH degree, 0 to 3: K = 0, 3, 8 or 15 coefficients beside `sh0`. */
  degree: number;
  /** 3 N: x, y, z. */
  means: Float32Array;
  /** 4 N: w, x, y, z as stored; the length is within a few per cent of 1. */
  quats: Float32Array;
  /** 3 N: natural logarithms of the standard deviations. */
  scales: Float32Array;
  /** N: logits; opacity = 1 / (1 + exp(-logit)). */
  opacities: Float32Array;
  /** 3 N: red, green, blue; colour = 0.5 + 0.28209479 sh0. */
  sh0: Float32Array;
  /** N: entries of the codebook; empty in SOG of degree 0. */
  labels: Uint16Array;
  /** 3 K per codebook entry: red, green, blue of each coefficient, in the order of `.ply` files. */
  centroids: Float32Array;
  /** N: cells of the grid, row × gridSide + column; in SOG 0 to N - 1, because images have no other pixels before the last. */
  cells: Uint32Array;
  /** Number of columns. */
  gridSide: number;
  /** Entries of the codebook per row and per column of its tiles; 0 in SOG, which has no tiles. */
  codebookSide: number;
  /** What each image gives, in the order of decoding. */
  contents: Record<string, Attribute[]>;
  /** Bytes of each file. */
  sizes: Record<string, number>;
  /** Decoded images by file, with the option `keepPlanes`. */
  planes: Record<string, Plane>;
  /** Content of meta.json. */
  meta: any;
}

export interface Progress {
  /** Bytes received. */
  received: number;
  /** Bytes announced so far. */
  total: number;
  /** Images decoded. */
  decoded: number;
  /** Images in total. */
  planes: number;
}

export interface Options {
  /** Aborts decoding, which then throws the signal's reason. */
  signal?: AbortSignal;
  /** Options of all requests, for example headers. */
  request?: RequestInit;
  /** Whether to keep decoded images in `scene.planes`. */
  keepPlanes?: boolean;
  /** Largest number of Gaussians, checked before memory is allocated; default: 20 million. */
  maxGaussians?: number;
  /** Number of workers; 0 for the caller's thread; default: one per processor, at most 4. */
  workers?: number;
  /**
   * Whether the browser may decode images; default: true. Pixels are verified by the checksums of the metadata. If they
   * differ, without checksums, and for images with alpha, `decodeWebP` decodes.
   */
  native?: boolean;
  onProgress?: (progress: Progress) => void;
  /**
   * Called when an image is decoded and its values are in `scene`, the object that `decode` returns in the end. The mask
   * comes first, and coarse positions come before exact ones. Values of images that have not arrived are neutral.
   */
  onPlane?: (file: string, scene: Scene) => void;
}

/** Error of a container; the message is a sentence. */
export declare class SogxtError extends Error {}

/**
 * Decode a container.
 * @param source address of a folder (with a slash at its end), of its meta.json, or of a zip; or a zip
 * @throws {SogxtError} a file is missing, damaged, invalid or too large
 */
export declare function decode(
  source: string | URL | ArrayBuffer | Uint8Array | Blob,
  options?: Options,
): Promise<Scene>;

/** Return the SH coefficients of each Gaussian, 3 K N, from the codebook. */
export declare function expandSH(scene: Scene): Float32Array;

/** An image to decode, and its expected size and checksum. */
export interface Task {
  file: string;
  bytes: Uint8Array;
  /** Largest number of pixels. */
  pixels: number;
  width?: number;
  height?: number;
  /** CRC-32 of the pixels. */
  checksum?: number;
  native: boolean;
}
