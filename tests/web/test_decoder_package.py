"""The npm package of the decoder: types, size, contents; reference: TypeScript's compiler, gzip, npm."""

import gzip
import json
import re
import shutil
import subprocess

import pytest
from helpers.web_tools import DECODER, node, run_node

import kissgs

PARTS = ("webp.js", "sogxt.js", "container.js", "zip.js")
MAX_BYTES = 12_500

AGREE = """
import * as main from "./web_decoder/sogxt.js";
import * as sog from "./web_decoder/sog.js";
import * as webp from "./web_decoder/webp.js";
import type * as mainTypes from "./declared/types.js";
import type * as sogTypes from "./declared/sog.js";
import type * as webpTypes from "./declared/webp.js";

// Declarations and code agree in both directions.
const decode: typeof mainTypes.decode = main.decode;
const declaredDecode: typeof main.decode = null! as typeof mainTypes.decode;
const expandSH: typeof mainTypes.expandSH = main.expandSH;
const declaredExpandSH: typeof main.expandSH = null! as typeof mainTypes.expandSH;
const SogxtError: typeof mainTypes.SogxtError = main.SogxtError;
const decodeSog: typeof sogTypes.decode = sog.decode;
const declaredDecodeSog: typeof sog.decode = null! as typeof sogTypes.decode;
const SogError: typeof sogTypes.SogError = sog.SogError;
const undeclaredSog: never[] = [] as Exclude<keyof typeof sog, keyof typeof sogTypes>[];
const missingSog: never[] = [] as Exclude<keyof typeof sogTypes, keyof typeof sog>[];
const decodeWebP: typeof webpTypes.decodeWebP = webp.decodeWebP;
const declaredDecodeWebP: typeof webp.decodeWebP = null! as typeof webpTypes.decodeWebP;
const WebPError: typeof webpTypes.WebPError = webp.WebPError;
const error: Error = new SogxtError("x");
const undeclared: never[] = [] as Exclude<keyof typeof main, keyof typeof mainTypes>[];
const missing: never[] = [] as Exclude<keyof typeof mainTypes, keyof typeof main>[];
const undeclaredWebP: never[] = [] as Exclude<keyof typeof webp, keyof typeof webpTypes>[];

// Typical use.
const scene = await decode(new URL("https://localhost/scene/"), {
  signal: AbortSignal.timeout(1),
  request: { headers: { Authorization: "x" } },
  onPlane: (file, partial) => file.length + partial.means.length,
  onProgress: ({ received, total }) => received / total,
});
const shN: Float32Array = expandSH(scene);
const { width, rgba }: { width: number; rgba: Uint8Array } = decodeWebP(new Uint8Array(9), { maxPixels: 9 });
// @ts-expect-error: no such option
decode("x", { wrokers: 1 });
// @ts-expect-error: a source of no kind
decode(5);
"""


def compiler():
    found = DECODER / "node_modules" / ".bin" / "tsc"
    if not found.exists():
        pytest.skip("TypeScript is not installed (npm ci in web_decoder)")
    return [node(), str(found.resolve())]


def test_declarations_agree_with_the_code(tmp_path):
    """Declarations and code are in different folders here, so that neither hides the other."""
    (tmp_path / "web_decoder").mkdir()
    (tmp_path / "declared").mkdir()
    for path in DECODER.glob("*.js"):
        shutil.copy(path, tmp_path / "web_decoder")
    for name in ("types.d.ts", "sog.d.ts", "webp.d.ts"):
        shutil.copy(DECODER / name, tmp_path / "declared")
    shutil.copy(DECODER / "types.d.ts", tmp_path / "web_decoder")  # the code imports types from it
    (tmp_path / "use.ts").write_text(AGREE)
    options = json.loads((DECODER / "tsconfig.json").read_text())["compilerOptions"]
    (tmp_path / "tsconfig.json").write_text(json.dumps({"compilerOptions": options, "files": ["use.ts"]}))
    done = subprocess.run(
        [*compiler(), "--project", str(tmp_path)], capture_output=True, text=True, check=False, timeout=300
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_size():
    """Files are compressed by gzip and not minified."""
    assert sum(len(gzip.compress((DECODER / name).read_bytes(), 9)) for name in PARTS) < MAX_BYTES


def test_package():
    """The package has all files that the code imports and no others; all exported paths exist."""
    npm = shutil.which("npm")
    if npm is None:
        pytest.skip("no npm on the PATH")
    done = subprocess.run(
        [npm, "pack", "--dry-run", "--json", "--offline", "--ignore-scripts"],
        cwd=DECODER,
        capture_output=True,
        text=True,
        check=True,
        timeout=300,
    )
    found = {entry["path"] for entry in json.loads(done.stdout)[0]["files"]}
    package = json.loads((DECODER / "package.json").read_text())
    extras = found - {"package.json", "README.md", "LICENSE"}
    assert extras == set(package["files"]) - {"README.md", "LICENSE"}
    for name in extras:
        for imported in re.findall(r'from "\./([\w.]+)"|new URL\("\./([\w.]+)"', (DECODER / name).read_text()):
            target = next(filter(None, imported))
            assert target in found or target.replace(".js", ".d.ts") in found
    for entry in package["exports"].values():
        for path in entry.values() if isinstance(entry, dict) else [entry]:
            assert path.removeprefix("./") in found
    assert package["sideEffects"] == ["./worker.js"]
    assert not package.get("dependencies")


def test_imports_of_the_installed_package(tmp_path):
    """The package exports ``kissgs``, ``kissgs/sog`` and ``kissgs/webp``; internal files cannot be imported."""
    package = tmp_path / "node_modules" / "kissgs"
    package.mkdir(parents=True)
    for name in [*json.loads((DECODER / "package.json").read_text())["files"], "package.json"]:
        if (DECODER / name).exists():
            shutil.copy(DECODER / name, package)
    (tmp_path / "use.mjs").write_text(
        'import { decode } from "kissgs";\nimport { decodeWebP } from "kissgs/webp";\n'
        'import { decode as decodeSog } from "kissgs/sog";\n'
        'const inner = await import("kissgs/zip.js").catch((error) => error.code);\n'
        "console.log(typeof decode, typeof decodeWebP, typeof decodeSog, inner);\n"
    )
    assert run_node(tmp_path / "use.mjs").split() == [*["function"] * 3, "ERR_PACKAGE_PATH_NOT_EXPORTED"]


def test_the_version_is_that_of_the_python_package():
    assert json.loads((DECODER / "package.json").read_text())["version"] == kissgs.__version__
