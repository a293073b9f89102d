"""Captures of jobs; oracle: local kissgs.compress with the same photographs, and archives made by zipfile and tarfile."""

import io
import json
import stat
import tarfile
import zipfile

import pytest
from helpers.captured_scene import SCENE, write_capture
from helpers.service import SMALL, events, problem

import kissgs
from kissgs.io.ply import write_ply
from kissgs.settings import Settings

FEW = {"sensitivity_views": 8, "sensitivity_view_size": 48}
OPTIONS = {"preset": "balanced", "encode": FEW, "for_research": True}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A capture with photographs, and with files that nothing needs."""
    found = write_capture(tmp_path_factory.mktemp("capture") / "statue", names=[f"{n}.png" for n in range(9)])
    (found / "notes.txt").write_text("notes")
    (found / "images" / "points3D.bin").write_bytes(bytes(1000))
    return found


@pytest.fixture(scope="module")
def scene():
    file = io.BytesIO()
    write_ply(file, SCENE)
    return file.getvalue()


def files_of(folder, above=""):
    return {f"{above}{path.relative_to(folder)}": path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def zipped(files, method=zipfile.ZIP_DEFLATED):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", method) as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return buffer.getvalue()


def tarred(files, mode="w"):
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode=mode) as archive:
        for name, data in files.items():
            entry = tarfile.TarInfo(name)
            entry.size = len(data)
            archive.addfile(entry, io.BytesIO(data))
    return buffer.getvalue()


def post(service, scene, archive, options=OPTIONS, **headers):
    form = {"capture": ("x.zip", archive), "file": ("scene.ply", scene), "options": (None, json.dumps(options))}
    return service.http.post("/v1/jobs", files=form, headers=headers)


def submitted(service, scene, archive, options=OPTIONS):
    answer = post(service, scene, archive, options)
    assert answer.status_code == 202, answer.text
    return answer.json()


@pytest.fixture(scope="module")
def expected(folder, scene, tmp_path_factory):
    return kissgs.compress(scene, settings=Settings.model_validate(OPTIONS), views=kissgs.load_views(folder)).to_zip()


ARCHIVES = {
    "zip": zipped,
    "zip below a folder": lambda files: zipped({f"my statue/{name}": data for name, data in files.items()}),
    "tar": lambda files: tarred({f"./{name}": data for name, data in files.items()}),
    "tar.gz below a folder": lambda files: tarred({f"a/b/{name}": data for name, data in files.items()}, "w:gz"),
}


@pytest.mark.parametrize("kind", ARCHIVES)
def test_the_bytes_are_those_of_a_local_compression(service, folder, scene, expected, kind):
    status = submitted(service, scene, ARCHIVES[kind](files_of(folder)))
    assert service.only_result(status) == expected
    assert status["options"]["capture"].startswith("sha256:")
    stored = service.folder / "jobs" / status["id"] / "capture"
    names = {path.name for path in stored.rglob("*") if path.is_file()}
    assert names == {"capture.json", "transforms.json", *(f"{n}.png" for n in range(9))}
