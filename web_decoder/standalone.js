/** Start of a page that holds all its files: its modules become blobs, which import each other by their addresses. */

const text = document.getElementById("modules")?.textContent ?? "";
const packed = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
const unpacked = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
/** Each module comes after those that it imports. @type {[string, string][]} */
const modules = await new Response(unpacked).json();
/** @type {Record<string, string>} */
const addresses = {};
for (const [name, source] of modules) {
  const linked = source.replace(/"module:([^"]+)"/g, (_, imported) => JSON.stringify(addresses[imported]));
  addresses[name] = URL.createObjectURL(new Blob([linked], { type: "text/javascript" }));
}
await import(addresses["preview.js"]);

export {};
