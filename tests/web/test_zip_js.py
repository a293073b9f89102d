"""CRC-32 and zips in Node.js; reference: zlib and zipfile."""

import base64
import io
import json
import zipfile
import zlib

import numpy as np
from helpers.web_tools import run_node, sha_of, webp

PROGRAM = "read_zips.mjs"


def test_crc32_of_any_length_and_offset():
    """Offsets in a larger buffer may be odd; arrays are Uint8Array or Buffer."""
    rng = np.random.default_rng(0)
    blob = rng.bytes(5000)
    views = [(at, length) for length in range(71) for at in range(9)] + [(3, 4990), (0, 5000), (1, 4999)]
    job = {"blob": base64.b64encode(blob).decode(), "views": views}
    found = json.loads(run_node(PROGRAM, json.dumps(job)))
    wanted = [zlib.crc32(blob[at : at + length]) for at, length in views]
    assert found["crcs"] == wanted
    assert found["buffers"] == wanted


def test_files_of_zips_in_any_view():
    rng = np.random.default_rng(1)
    files = {f"dir/{i}.bin": rng.bytes(i * i) + bytes(i * 50) for i in range(30)} | {"empty": b"", "ü.txt": b"x"}
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for i, (name, data) in enumerate(files.items()):
            archive.writestr(name, data, (zipfile.ZIP_DEFLATED, zipfile.ZIP_STORED)[i % 2])
        archive.mkdir("folder")
    streamed = io.BytesIO()

    class Unseekable(io.RawIOBase):
        """A stream for which zipfile writes sizes after the data."""

        def writable(self):
            return True

        def write(self, data):
            return streamed.write(data)

    with zipfile.ZipFile(Unseekable(), "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    zips = [base64.b64encode(data).decode() for data in (buffer.getvalue(), streamed.getvalue())]
    found = json.loads(run_node(PROGRAM, json.dumps({"zips": zips})))
    wanted = {name.rpartition("/")[2]: sha_of(np.frombuffer(data, np.uint8)) for name, data in files.items()}
    assert found["files"] == [wanted] * 8


def test_webp_in_any_view():
    image = np.random.default_rng(2).integers(0, 256, (13, 9, 4)).astype(np.uint8)
    job = {"webp": base64.b64encode(webp(image)).decode()}
    assert json.loads(run_node(PROGRAM, json.dumps(job)))["images"] == [sha_of(image)] * 9
