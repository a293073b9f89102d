/** An image as it is stored: four bytes a pixel, row by row, alpha not multiplied in. */
export interface Plane {
  width: number;
  height: number;
  rgba: Uint8Array<ArrayBuffer>;
}

/** A scene of N Gaussians, row by row of the container's grid. */
export interface Scene {
  /** N */
  count: number;
  /** Of the spherical harmonics, 0 to 3: K = 0, 3, 8 or 15 coefficients beside `sh0`. */
  degree: number;
  /** 3 N: x, y, z. */
  means: Float32Array;
  /** 4 N: w, x, y, z as stored; their length is within a few per cent of 1. */
  quats: Float32Array;
  /** 3 N: natural logarithms of the standard deviations. */
  scales: Float32Array;
  /** N: logits; opacity = 1 / (1 + exp(-logit)). */
  opacities: Float32Array;
  /** 3 N: red, green, blue; colour = 0.5 + 0.28209479 sh0. */
  sh0: Float32Array;
  /** N: entries of the codebook. */
  labels: Uint16Array;
  /** 3 K for every entry of the codebook: red, green, blue of each coefficient, in the order of `.ply` files. */
  centroids: Float32Array;
  /** N: places in the grid, row × gridSide + column. */
  cells: Uint32Array;
  gridSide: number;
  codebookSide: number;
  /** Bytes of each file. */
  sizes: Record<string, number>;
  /** The images by file, if `keepPlanes` asked for them. */
  planes: Record<string, Plane>;
  /** What meta.json says. */
  meta: any;
}

export interface Progress {
  /** Bytes that have come. */
  received: number;
  /** Bytes that have been announced until now. */
  total: number;
  /** Images decoded. */
  decoded: number;
  /** Images in all. */
  planes: number;
}

export interface Options {
  /** Ends the work, which then throws the signal's reason. */
  signal?: AbortSignal;
  /** For every fetch; headers, for example. */
  request?: RequestInit;
  /** Keep the images, in `scene.planes`. */
  keepPlanes?: boolean;
  /** More are refused before memory is taken for them (20 million unless given). */
  maxGaussians?: number;
  /** Threads that decode (one per processor, at most 4, unless given); 0: the caller's. */
  workers?: number;
  /**
   * Whether the browser may decode images (unless given: yes). What comes out is compared with the checksums of pixels in
   * the metadata; where it differs, where there are none, and for images with alpha, `decodeWebP` decodes.
   */
  native?: boolean;
  onProgress?: (progress: Progress) => void;
  /**
   * An image has been decoded and its values are in `scene`, the one that `decode` returns in the end. First of all comes the
   * mask; coarse positions come before exact ones. What has not come is neutral.
   */
  onPlane?: (file: string, scene: Scene) => void;
}

/** What is wrong with a container, in a sentence. */
export declare class SogxtError extends Error {}

/**
 * Decode a container.
 * @param source address of a folder (with a slash at its end), of its meta.json, or of a zip; or a zip
 * @throws {SogxtError} something is missing, damaged, impossible or not allowed
 */
export declare function decode(
  source: string | URL | ArrayBuffer | Uint8Array | Blob,
  options?: Options,
): Promise<Scene>;

/** The coefficients of every Gaussian, 3 K N, out of the codebook. */
export declare function expandSH(scene: Scene): Float32Array;

/** An image to decode and what it must be. */
export interface Task {
  file: string;
  bytes: Uint8Array;
  width: number;
  height: number;
  /** CRC-32 of the pixels. */
  checksum?: number;
  native: boolean;
}
