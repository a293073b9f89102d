/** Pixels of what a renderer has drawn. */

/**
 * Return the pixels of the canvas: RGBA, top row first.
 * @param {import("three").WebGLRenderer} renderer
 */
export function readPixels(renderer) {
  renderer.setRenderTarget(null);
  const gl = renderer.getContext();
  const [width, height] = [gl.drawingBufferWidth, gl.drawingBufferHeight];
  const upward = new Uint8Array(4 * width * height);
  gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, upward);
  const data = new Uint8Array(upward.length);
  for (let y = 0; y < height; y++)
    data.set(upward.subarray(4 * width * y, 4 * width * (y + 1)), 4 * width * (height - 1 - y));
  return { width, height, data };
}
