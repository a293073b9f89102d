/** How Spark has to be set to draw as the original rasteriser does. */

/** Base colours of trained scenes leave 0 to 1; Spark would clip them. Three times its range is three times its steps. */
export const WIDE = {
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
 * As the original rasteriser draws: Gaussians are widened by 0.3 square pixels and keep their opacity (`blurAmount`
 * would thin them out in return), are sorted by depth and followed until they are fainter than 1/255.
 */
export const CLASSIC = {
  preBlurAmount: 0.3,
  blurAmount: 0,
  sortRadial: false,
  minAlpha: 1 / 255,
  maxStdDev: Math.sqrt(2 * Math.log(255)),
  maxPixelRadius: 4096,
  accumExtSplats: true, // a second rounding to 8 bits would be seen
  enableLod: false,
};

/**
 * Let Gaussians be drawn that lie far beside the picture, when they are large enough to reach into it, as skies are.
 * Spark leaves them out, because it takes the derivative of the projection where they are, and footprints grow without
 * end there; the original rasteriser takes it no further outside than 0.3 of half the picture. A Spark whose shader has
 * no such line is left as it is.
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
