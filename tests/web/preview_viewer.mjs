/** The preview's viewers: of a decoded scene, and of a file beside it. */

import { Viewer } from "/web_decoder/preview/viewer.js";

const bytesOf = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
const floats = (text) => new Float32Array(bytesOf(text).buffer);
const textOf = (bytes) => {
  let text = "";
  for (let at = 0; at < bytes.length; at += 32768) text += String.fromCharCode(...bytes.subarray(at, at + 32768));
  return btoa(text);
};
const newViewer = () => new Viewer(document.body.appendChild(document.createElement("canvas")));
const [one, other] = [newViewer(), newViewer()];

function sceneOf({ count, degree, labels, meta, ...fields }) {
  const arrays = Object.fromEntries(Object.entries(fields).map(([name, text]) => [name, floats(text)]));
  return { count, degree, meta, labels: new Uint16Array(bytesOf(labels).buffer), ...arrays };
}

async function imagesOf(viewer, cameras) {
  const images = [];
  for (const camera of cameras) {
    viewer.setCamera(camera);
    await viewer.render();
    images.push(textOf(viewer.readPixels().data));
  }
  return images;
}

window.draw = async ({ scene, cameras, background = "#000000", file = null }) => {
  one.setScene(sceneOf(scene));
  one.setBackground(background);
  const found = { drawn: await imagesOf(one, cameras) };
  if (file !== null) {
    found.read = await other.setFile(file.type, bytesOf(file.bytes), one);
    if (!file.beside) await other.setFile(file.type, bytesOf(file.bytes));
    found.beside = await imagesOf(other, cameras);
  }
  return found;
};
