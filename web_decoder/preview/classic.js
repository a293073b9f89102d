/** Settings with which Spark renders like the original 3DGS rasteriser, and like Mip-Splatting's. */

/** Ranges for unknown scenes: base colours of trained scenes exceed 0 to 1, and Spark would clip them. */
export const WIDE_RANGES = {
  rgbMin: -1,
  rgbMax: 2,
  lnScaleMin: -12,
  lnScaleMax: 9,
  sh1Max: 1,
  sh2Max: 1,
  sh3Max: 1,
  lodOpacity: false,
};

/**
 * Options of the dilation by 0.3 square pixels: Gaussians keep their opacity, or it is compensated as in scenes trained
 * with antialiasing.
 * @param {boolean} antialiased
 */
export const dilation = (antialiased) =>
  antialiased ? { preBlurAmount: 0, blurAmount: 0.3 } : { preBlurAmount: 0.3, blurAmount: 0 };

/** Options of the original rasteriser: Gaussians are sorted by depth, and are drawn down to an alpha of 1/255. */
export const CLASSIC = {
  ...dilation(false),
  sortRadial: false,
  minAlpha: 1 / 255,
  maxStdDev: Math.sqrt(2 * Math.log(255)),
  maxPixelRadius: 4096,
  accumExtSplats: true, // a second rounding to 8 bits would be visible
  enableLod: false,
};

/**
 * Draw Gaussians with centres far outside the image that extend into it, such as those of a sky. Spark omits them, because
 * it takes the derivative of the projection at the centre, where footprints grow without bound; the original rasteriser
 * clamps that point to 0.3 of half the image outside. A version of Spark without this line of shader is not changed.
 * @param {import("@sparkjsdev/spark").SparkRenderer} spark before it has drawn
 */
export function drawFromOutside(spark) {
  const shader = spark.material.vertexShader.replace(
    "vec2 J2 = -(J1 * viewCenter.xy) * invZ;",
    `vec2 near = clamp(clipCenter.xy / clipCenter.w, -1.3, 1.3);
     vec2 J2 = J1 * (near + projectionMatrix[2].xy) / vec2(projectionMatrix[0][0], projectionMatrix[1][1]);`,
  );
  if (shader === spark.material.vertexShader) return;
  spark.material.vertexShader = shader;
  spark.clipXY = Infinity;
}
