"""A preview page of few files, in which each kind of import occurs."""

PAGE = """<!doctype html>
<html>
  <head>
    <meta charset="utf-8" />
    <title>Preview · kissgs</title>
    <link rel="stylesheet" href="./preview.css" />
    <script type="importmap">
      {"imports": {"three": "./vendor/three/three.min.js", "three/addons/": "./vendor/three/addons/"}}
    </script>
    <script type="module" src="./preview.js"></script>
  </head>
  <body>
    <a id="home" href="./preview.html">home</a>
  </body>
</html>
"""
FILES = {
    "preview.html": PAGE,
    "preview.css": "a { color: red }\n",
    "preview.js": 'import { add } from "./preview/sum.js";\nimport "./plane.js";\nawait import("./late.js");\nadd();\n',
    "preview/sum.js": '/** @typedef {import("../preview.js").Page} Page */\nexport { add } from "../plane.js";\n',
    "plane.js": 'import * as three from "three";\nexport const add = () => new URL("./worker.js", import.meta.url);\n',
    "worker.js": "addEventListener('message', postMessage);\n",
    "late.js": "import {Pass} from 'three/addons/Pass.js';\nexport const none = 'import none';\n",
    "standalone.js": "await 0;\n",
    "vendor/versions.json": "{}",
    "vendor/three/LICENSE": "MIT -- by all\n",
    "vendor/three/three.min.js": 'import{a}from"./core.min.js";export const Pass=1;',
    "vendor/three/core.min.js": '/** @license import "x" */export const a=`from"other"`;',
    "vendor/three/addons/Pass.js": "/**\n * import 'three/addons/Pass.js';\n */\nexport { Pass } from 'three';\n",
}
UNSERVED = (
    *("package.json", "README.md", "vendor/three/package.json", "node_modules/x.js", "preview/tests/x.js", "x.d.ts"),
)
