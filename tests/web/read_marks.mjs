// Print whether the preview page takes files for antialiased, one line each. Standard input: [[file name, base64], …].

import { readFileSync } from "node:fs";

import { fileTypeOf, isMarked } from "../../web_decoder/preview/file_types.js";
import { isAntialiased } from "../../web_decoder/preview/scene.js";
import { decode } from "../../web_decoder/sog.js";

for (const [name, text] of JSON.parse(readFileSync(0, "utf8"))) {
  const bytes = new Uint8Array(Buffer.from(text, "base64"));
  const type = fileTypeOf(name);
  console.log(type ? await isMarked(type, bytes) : isAntialiased(await decode(bytes)));
}
