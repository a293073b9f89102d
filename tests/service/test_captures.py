"""Captures of jobs; oracle: kissgs.compress with the same photographs, and archives of zipfile and tarfile."""

import io
import json
import re
import shutil
import signal
import stat
import subprocess
import tarfile
import zipfile
from dataclasses import replace

import numpy as np
import pytest
from helpers.captured_scene import SCENE, write_capture
from helpers.command_line import KISSGS, run
from helpers.fewer_cameras import try_fewer
from helpers.service import keys_of, ply_bytes, problem
from helpers.streamed_scenes import files_of

import kissgs
from kissgs.settings import Settings

FEW = {"sensitivity_views": 8, "sensitivity_view_size": 48}
CHANGES = [word for name, value in FEW.items() for word in ("--set", f"{name}={value}")]
OPTIONS = {"preset": "balanced", "encode": FEW, "for_research": True}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A capture with photographs, and with files that nothing needs."""
    found = write_capture(tmp_path_factory.mktemp("capture") / "statue", names=[f"{n}.png" for n in range(9)])
    (found / "notes.txt").write_text("notes")
    (found / "images" / "points3D.ply").write_bytes(bytes(1000))
    return found


@pytest.fixture(scope="module")
def scene():
    return ply_bytes(SCENE)


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
    with pytest.MonkeyPatch.context() as patch:
        try_fewer(patch)  # as in the threads of jobs
        settings = Settings.model_validate(OPTIONS)
        return kissgs.compress(scene, settings=settings, views=kissgs.load_views(folder)).to_zip()


def unmarked_zip(files):
    """Return a zip as macOS and Info-ZIP write it: names in UTF-8 without the flag that says so."""
    ascii_names = {name: "".join(f"{byte:c}" if byte < 128 else "x" for byte in name.encode()) for name in files}
    data = zipped({ascii_names[name]: content for name, content in files.items()}, zipfile.ZIP_STORED)
    for name, placeholder in ascii_names.items():
        data = data.replace(placeholder.encode(), name.encode())
    return data


ARCHIVES = {
    "zip": zipped,
    "zip of Info-ZIP": unmarked_zip,
    "zip below a folder": lambda files: zipped({f"my statue/{name}": data for name, data in files.items()}),
    "tar": lambda files: tarred({f"./{name}": data for name, data in files.items()}),
    "tar.gz below a folder": lambda files: tarred({f"a/b/{name}": data for name, data in files.items()}, "w:gz"),
}


@pytest.mark.parametrize("kind", ARCHIVES)
def test_what_is_needed_of_an_archive_is_stored(service, folder, scene, kind):
    """Regression: zips of Info-ZIP, and names with spaces that are not ASCII, were refused."""
    photo, others = "images/写真\u3000é\u202f0.png", [f"images/{n}.png" for n in range(1, 9)]
    files = moved(files_of(folder), photo)
    files[photo] = files.pop("images/0.png")
    status = submitted(service, scene, ARCHIVES[kind](files), {"preset": "fast"})
    assert service.ended(status)["state"] == "succeeded"
    stored = files_of(service.folder / "jobs" / status["id"] / "capture")
    found = {name.removeprefix("my statue/").removeprefix("a/b/"): data for name, data in stored.items()}
    needed = {name: files[name] for name in ("transforms.json", photo, *others)}
    assert found == {"unpacked.json": found["unpacked.json"], **needed}


TRAINED = {
    "encode": {"max_psnr_drop": 1.0, "max_encodes": 2, **FEW},
    "compact": {"sparsify_steps": 6, "refine_steps": 6, "prune_rounds": 2, "max_compactions": 2, "view_size": 40},
    "finetune": {"steps": 3, "view_size": 40},
    "evaluate": True,
    "for_research": True,
}


def test_a_goal_trains_on_the_photographs_and_tells_what_is_held_out(service, folder, scene):
    pytest.importorskip("torch")
    status = service.ended(submitted(service, scene, zipped(files_of(folder)), TRAINED))
    assert status["state"] == "succeeded", status
    settings = Settings.model_validate({name: value for name, value in TRAINED.items() if name != "evaluate"})
    local = kissgs.compress(scene, settings=settings, views=kissgs.load_views(folder), evaluate=True)
    assert service.http.get(status["links"]["result"]).content == local.to_zip()
    mean = local.report.evaluation.mean
    found = status["evaluation"]
    assert (found["reference"]["psnr"], found["candidate"]["psnr"]) == (mean.reference.psnr, mean.candidate.psnr)
    assert found["psnr"] == mean.candidate_vs_reference.psnr
    assert (status["options"]["compact"]["auto_count"], status["options"]["finetune"]["enabled"]) == (True, True)


def by_reference(service, scene, reference):
    return service.http.post("/v1/jobs", content=scene, params={"options": json.dumps({**OPTIONS, **reference})})


def test_other_jobs_name_the_capture_until_the_last_is_removed(service, folder, scene, expected):
    archive = zipped({**files_of(folder), "images/more.png": b"of this test"})
    first = submitted(service, scene, archive)
    reference = {"capture": first["options"]["capture"]}
    assert reference["capture"].startswith("sha256:")
    second = by_reference(service, scene, reference).json()
    service.ended(second)
    assert service.only_result(first) == expected
    assert service.http.delete(first["links"]["self"]).status_code == 204
    third = submitted(service, scene, archive, {**OPTIONS, **reference})  # the archive, with its name
    service.ended(third)
    assert service.only_result(second) == service.only_result(third) == expected
    for job in (second, third):
        service.http.delete(job["links"]["self"])
    found = problem(by_reference(service, scene, reference), 410, "gone")
    assert "send its archive in the field 'capture'" in found["detail"]
    head = b"POST /v1/jobs?options=%%7B%%22capture%%22:%%22%s%%22%%7D HTTP/1.1\r\nHost: localhost\r\n"
    with service.raw(head % reference["capture"].encode() + b"Content-Length: 500000\r\n\r\n") as connection:
        assert connection.recv(100).startswith(b"HTTP/1.1 410")  # before the body
    other = problem(post(service, scene, archive, {"capture": f"sha256:{'0' * 64}"}), 422, "invalid-request")
    assert first["options"]["capture"] in other["detail"]
    assert service.uploads() == []


def image(data=b"\x89PNG no image"):
    return {"images/0.png": data}


def with_link(name, kind):
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w") as archive:
        entry = tarfile.TarInfo(name)
        entry.type, entry.linkname = kind, "/etc/passwd"
        archive.addfile(entry)
    return buffer.getvalue()


def zip_with_link():
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        entry = zipfile.ZipInfo("images/0.png")
        entry.external_attr = (stat.S_IFLNK | 0o777) << 16
        archive.writestr(entry, "/etc/passwd")
    return buffer.getvalue()


def damaged(files):
    data = bytearray(zipped(files, zipfile.ZIP_STORED))
    at = data.index(b"IDAT")
    data[at : at + 4] = b"tadI"
    return bytes(data)


def tar_of_size(size):
    """Return an archive whose only file has this size according to its header."""
    entry = tarfile.TarInfo("images/0.png")
    entry.size = 1
    header = bytearray(entry.tobuf(tarfile.GNU_FORMAT))
    header[124:136] = b"\x80" + size.to_bytes(11) if size >= 0 else b"\xff" + (size + 256**11).to_bytes(11)
    header[148:156] = b" " * 8
    header[148:156] = b"%06o\0 " % sum(header)
    return bytes(header) + bytes(10240)


def changed(data, at, byte=0):
    data = bytearray(data)
    data[at] ^= byte or 0xFF
    return bytes(data)


def with_header_damaged(files):
    """Return a tar with a damaged header in its midst: what comes after it cannot be found."""
    data = tarred(files)
    return changed(data, data.index(b"images/3.png\0"))


def without_endings(files):
    return {name.removesuffix(".png"): data for name, data in files.items()}


def two(files):
    return {f"{folder}/{name}": data for folder in ("one", "two") for name, data in files.items()}


HOSTILE = {
    "no archive": (lambda files: b"hello" * 1000, "neither zip nor tar"),
    "a bomb": (lambda files: zipped({"images/0.bmp": bytes(100 << 20)}), "more than .* bytes when it is unpacked"),
    "a tar bomb": (lambda files: tarred({"images/0.bmp": bytes(100 << 20)}, "w:gz"), "more than .* bytes when"),
    "entries": (lambda files: zipped({**files, **{f"{n}": b"" for n in range(300)}}), "more than 300 entries"),
    "tar entries": (lambda files: tarred({f"{n}": b"" for n in range(301)}, "w:gz"), "more than 300 entries"),
    "above": (lambda files: zipped({"../../0.png": b"x"}), "'../../0.png', which is outside its folder"),
    "backslashes": (lambda files: zipped({"..\\0.png": b"x"}), "which is outside its folder"),
    "absolute": (lambda files: tarred({"/tmp/0.png": b"x"}), "'/tmp/0.png', which is outside its folder"),
    "a link": (lambda files: with_link("images/0.png", tarfile.SYMTYPE), "'images/0.png', a link or a device"),
    "a hard link": (lambda files: with_link("0.png", tarfile.LNKTYPE), "'0.png', a link or a device"),
    "a device": (lambda files: with_link("images/0.png", tarfile.CHRTYPE), "a link or a device"),
    "a link in a zip": (lambda files: zip_with_link(), "'images/0.png', a link or a device"),
    "a long name": (lambda files: zipped({"a/" * 150 + "0.png": b"x"}), "a name that is not printable or too long"),
    "odd name": (lambda files: tarred({"a\n.png": b"x"}), "a name that is not printable or too long"),
    "one file twice": (lambda files: tarred({"./0.png": b"x", "0.png": b"y"}), "two files of one name"),
    "a file and a folder": (lambda files: tarred({"0.png": b"x", "0.png/0.png": b"y"}), "two files of one name"),
    "damaged": (damaged, "damaged or encrypted"),
    "truncated": (lambda files: tarred(files, "w:gz")[:-5000], "damaged"),
    "a huge size": (lambda files: tar_of_size(2**62), "more than .* bytes when"),
    "an impossible size": (lambda files: tar_of_size(2**70), "more than .* bytes when"),
    "a negative size": (lambda files: tar_of_size(-1024), "damaged"),
    "a wrong offset": (lambda files: changed(zipped(files), -4), "damaged"),
    "a wrong checksum of tar.gz": (lambda files: changed(tarred(files, "w:gz"), -8), "damaged"),
    "a wrong checksum of tar.bz2": (lambda files: changed(tarred(files, "w:bz2"), -2, 8), "damaged"),
    "a truncated end of tar.gz": (lambda files: tarred(files, "w:gz")[:-6], "damaged"),
    "a tar without end": (lambda files: tarred(files).rstrip(b"\0"), "damaged"),
    "a damaged header": (with_header_damaged, "damaged"),
    "nested folders": (
        lambda files: zipped({f"{n}" + "/a" * 100 + "/0.png": b"" for n in range(3)}),
        "more than 300 entries",
    ),
    "other endings": (lambda files: zipped(without_endings(files)), "no photographs that can be used, but 'images/."),
    "another folder": (
        lambda files: zipped({name.replace("images", "photos"): data for name, data in files.items()}),
        "no photographs that can be used, but 'photos/",
    ),
    "two captures": (lambda files: zipped(two(files)), "two captures, 'one' and 'two'; pack one of them"),
    "an image that is none": (lambda files: zipped({**files, **image()}), "images/0.png is damaged, truncated, or not"),
    "no cameras": (lambda files: zipped(image()), "the capture has no cameras: neither"),
    "half a model": (
        lambda files: zipped({"sparse/0/cameras.bin": b"x"}),
        "sparse/0 has cameras.bin but no images.bin",
    ),
    "a missing photograph": (
        lambda files: zipped({name: data for name, data in files.items() if name != "images/3.png"}),
        "1 of 9 photographs is missing; the first is 'images/3.png', searched in images; add what is missing$",
    ),
    "no JSON": (lambda files: zipped({**files, "transforms.json": b"{"}), "transforms.json is not JSON"),
}


@pytest.mark.parametrize("kind", HOSTILE)
def test_hostile_archives(service, folder, scene, kind):
    make, message = HOSTILE[kind]
    answer = post(service, scene, make(files_of(folder)))
    found = problem(answer, 422, "invalid-views")
    assert len(found["detail"].splitlines()) == 1
    assert re.search(message, found["detail"]), found["detail"]
    assert ".part" not in found["detail"]
    assert str(service.folder) not in found["detail"]
    assert service.uploads() == []


def test_files_that_nothing_needs_may_have_any_name(service, folder, scene, expected):
    odd = {"Icon\r": b"", "x/" * 200 + "y": b"", "../notes.txt": b"", "._transforms.json": b"", "Lies mich \udcfc": b""}
    buffer = io.BytesIO(tarred({**odd, **files_of(folder)}))
    with tarfile.open(fileobj=buffer, mode="a") as archive:
        for kind in (tarfile.SYMTYPE, tarfile.FIFOTYPE):
            entry = tarfile.TarInfo("latest")
            entry.type, entry.linkname = kind, "images"
            archive.addfile(entry)
    assert service.only_result(submitted(service, scene, buffer.getvalue())) == expected


def test_cameras_without_photographs(service, folder, scene):
    files = {name: data for name, data in files_of(folder).items() if not name.startswith("images/")}
    archive = zipped({**files, "images.db": b"not their folder"})
    status = service.ended(submitted(service, scene, archive, {"preset": "fast", "evaluate": True}))
    assert status["state"] == "succeeded"
    assert "no photograph of the capture" in status["note"]
    report = service.http.get(status["links"]["report"])
    assert report.json()["evaluation"]["note"].startswith("the archive has no photographs")
    assert str(service.folder) not in report.text


def moved(files, name):
    """Return the files of the capture with the first photograph at this path, according to its camera file."""
    document = json.loads(files["transforms.json"])
    document["frames"][0]["file_path"] = name
    return {**files, "transforms.json": json.dumps(document).encode()}


def test_photographs_are_looked_for_in_the_archive_only(service, folder, scene, expected, tmp_path):
    """A camera file may name any file of the server; the photograph there fits the camera."""
    files = files_of(folder)
    outside = tmp_path / "images" / "secret.png"
    outside.parent.mkdir()
    outside.write_bytes(files["images/0.png"])
    above = "../" * len(service.folder.parts) + str(outside)[1:]
    for name in (str(outside), above, f"images/{above}", f"images/../{above}", "/etc/passwd\0"):
        found = problem(post(service, scene, zipped(moved(files, name))), 422, "invalid-views")
        assert "1 of 9 photographs is missing" in found["detail"]
        assert "60x40" not in found["detail"]
    known = submitted(service, scene, zipped(moved(files, "/home/me/statue/images/0.png")))
    assert service.only_result(known)


def test_a_capture_of_another_scene_is_refused_unless_it_is_forced(service, folder, scene):
    options = {"preset": "fast", "evaluate": True}
    archive = zipped(files_of(folder))
    other = ply_bytes(replace(SCENE, means=SCENE.means + np.float32(100)))
    failed = service.ended(submitted(service, other, archive, options))
    assert (failed["state"], failed["problem"]["code"]) == ("failed", "invalid-views"), failed
    assert "shows any of the scene" in failed["problem"]["detail"]
    assert str(service.folder) not in failed["problem"]["detail"]
    forced = service.ended(submitted(service, other, archive, {**options, "force_views": True}))
    assert forced["state"] == "succeeded"


@pytest.mark.quick(0)
def test_limits(start, folder, scene):
    files = files_of(folder)
    size = sum(len(data) for name, data in files.items() if name.endswith((".png", ".json")))
    service = start(KISSGS_MAX_CAPTURE_BYTES=size - 1)
    found = problem(post(service, scene, zipped(files)), 422, "invalid-views")
    assert f"more than {size - 1:,} bytes when it is unpacked" in found["detail"]
    found = problem(post(service, scene, zipped({**files, "x": bytes(range(256)) * size}, 0)), 413, "too-large")
    assert f"the capture exceeds {size - 1:,} bytes" in found["detail"]
    assert service.uploads() == []
    full = start(KISSGS_MAX_DISK_BYTES=len(scene) + 50_000)
    problem(post(full, scene, zipped(files)), 507, "disk-full")
    assert full.uploads() == []
    slow = start(processes=True, capture_seconds=0.01)
    assert "more than 0.01 s" in problem(post(slow, scene, zipped(files)), 422, "invalid-views")["detail"]


@pytest.mark.quick(0)
def test_only_the_owner_names_a_capture(start, folder, scene):
    service = start(KISSGS_KEYS=keys_of(alice="alice", bob="bob"))
    answer = post(service, scene, zipped(files_of(folder)), Authorization="Bearer alice")
    params = {"options": json.dumps({**OPTIONS, "capture": answer.json()["options"]["capture"]})}
    for name, status in (("bob", 410), ("alice", 202)):
        headers = {"Authorization": f"Bearer {name}"}
        assert service.http.post("/v1/jobs", content=scene, params=params, headers=headers).status_code == status


@pytest.mark.quick(0)
def test_a_killed_service_goes_on_and_leaves_nothing(start_process, folder, scene, tmp_path):
    """Oracle: the command in a process, which chooses from all cameras, as the processes of jobs do."""
    (tmp_path / "statue.ply").write_bytes(scene)
    subprocess.run([KISSGS, "compress", tmp_path / "statue.ply", "--views", folder, *CHANGES], check=True)
    expected = (tmp_path / "statue.zip").read_bytes()
    service = start_process()
    job = submitted(service, scene, zipped(files_of(folder)))
    second = by_reference(service, scene, {"capture": job["options"]["capture"]}).json()
    service.kill(signal.SIGKILL)
    half = service.folder / "incoming" / f"{'0' * 16}.part"
    (half / "images").mkdir(parents=True)
    (half / "images" / "0.png").write_bytes(b"half")
    service.restart()
    service.ended(second)
    assert service.only_result(job) == service.only_result(second) == expected
    assert sorted(path.name for path in (service.folder / "jobs").iterdir()) == sorted([job["id"], second["id"]])


@pytest.mark.parametrize("lost", ["images/0.png", "unpacked.json"])
def test_a_capture_that_has_lost_files_is_sent_again(service, folder, scene, lost):
    archive = zipped({**files_of(folder), f"images/{lost.replace('/', ' ')}.png": lost.encode()})
    job = submitted(service, scene, archive, {"preset": "fast"})
    service.ended(job)
    (service.folder / "jobs" / job["id"] / "capture" / lost).unlink()
    found = problem(by_reference(service, scene, {"capture": job["options"]["capture"]}), 410, "gone")
    assert "send its archive" in found["detail"]
    assert service.uploads() == []


def test_a_repeated_request_gives_its_job_without_the_capture(service, folder, scene):
    archive, key = zipped({**files_of(folder), "images/key.png": b"of this test"}), {"Idempotency-Key": "capture"}
    job = post(service, scene, archive, {"preset": "fast"}, **key).json()
    service.ended(job)
    shutil.rmtree(service.folder / "jobs" / job["id"] / "capture")
    options = {"options": json.dumps({"preset": "fast", "capture": job["options"]["capture"]})}
    assert service.http.post("/v1/jobs", content=scene, params=options, headers=key).json()["id"] == job["id"]
    assert post(service, scene, archive, {"preset": "fast"}, **key).json()["id"] == job["id"]
    problem(service.http.post("/v1/jobs", content=scene, headers=key), 422, "key-reused")


@pytest.mark.quick(0)
def test_space_is_made_of_captures_of_ended_jobs(start, folder, scene):
    archive = zipped(files_of(folder))
    service = start(KISSGS_MAX_DISK_BYTES="35500000")
    first = service.ended(submitted(service, scene, archive))
    kept = service.folder / "jobs" / first["id"] / "capture"
    assert kept.is_dir()
    while kept.exists():
        service.ended(submitted(service, scene, archive))
    found = by_reference(service, scene, {"capture": first["options"]["capture"]})
    assert found.status_code == 202  # of a later job


def test_the_command_packs_sends_and_names_the_capture(service, folder, scene, expected, tmp_path, monkeypatch):
    path = tmp_path / "statue.ply"
    path.write_bytes(scene)
    words = ["remote", "compress", path, "--views", folder, "--server", service.url, "-f", "--json", *CHANGES]
    first = run(*words)
    assert (first.returncode, first.stderr) == (0, b"")
    assert (tmp_path / "statue.zip").read_bytes() == expected
    monkeypatch.setattr(kissgs.client, "_form", None)  # which a second command does not need
    second = run(*words)
    assert second.returncode == 0, second.stderr
    jobs = [json.loads(done.stdout) for done in (first, second)]
    assert jobs[0]["options"]["capture"] == jobs[1]["options"]["capture"]
    refused = run(*words[:4], tmp_path, *words[5:])
    assert (refused.returncode, b"has no cameras" in refused.stderr) == (2, True)
