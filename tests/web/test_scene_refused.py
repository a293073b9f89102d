"""Containers that are damaged, invalid or too large; the error must name what was done to them."""

import io
import json
import struct
import zipfile

import numpy as np
from helpers.reference_sog import zip_of
from helpers.web_scenes import assert_scene, container, in_node, job, refusals, with_meta, without_checksums
from helpers.web_tools import pillow, put_value, webp
from PIL import Image

FILES = container("fast", 3, 65)


def without(name):
    return {key: data for key, data in FILES.items() if key != name}


def test_a_missing_file(site):
    names = ["meta.json", "active_mask.webp", "f_rest_centroids.webp", "means_bytes_0.webp"]
    found = refusals(
        *(job(without(name)) for name in names), *(job(site.put(f"without-{name}", without(name))) for name in names)
    )
    assert found[:4] == [f"this is no SOG-XT container: it has no {name}" for name in names]
    assert found[4:] == [f"{name} cannot be fetched: the server answers with status 404" for name in names]


def test_no_server_and_no_address():
    no_server, no_address = refusals(job("http://127.0.0.1:1/scene/"), job("no address"))
    assert no_server.startswith("meta.json cannot be fetched")
    assert no_address


def flipped(data, bit):
    new = bytearray(data)
    new[bit // 8] ^= 1 << bit % 8
    return bytes(new)


def test_a_damaged_image_is_named():
    """Any flipped bit of the stream makes it undecodable, or changes the checksum of the pixels."""
    cases = []
    for name in (name for name in FILES if name.endswith(".webp")):
        bits = np.random.default_rng(0).integers(25 * 8, (len(FILES[name]) - 2) * 8, 4)
        cases += [(name, flipped(FILES[name], int(bit))) for bit in bits]
    found = in_node(*(job({**FILES, name: data}) for name, data in cases))
    for report, (name, data) in zip(found, cases, strict=True):
        pixels = pillow(data)
        if pixels is None or (pixels != pillow(FILES[name])).any():
            assert report["error"]["name"] == "SogxtError"
            assert report["error"]["message"].startswith(f"{name}: ")


def test_images_of_another_size_or_kind():
    small = webp(np.zeros((8, 8, 3), np.uint8))
    lossy = io.BytesIO()
    Image.new("RGB", (16, 16)).save(lossy, "WEBP")
    found = refusals(
        job({**FILES, "f_dc.webp": small}),
        job({**FILES, "f_dc.webp": webp(np.zeros((4000, 4000, 3), np.uint8))}),
        job({**FILES, "f_dc.webp": lossy.getvalue()}),
        job({**FILES, "f_dc.webp": b""}),
        job({**FILES, "f_dc.webp": FILES["f_dc.webp"][:-9]}),
        job({**FILES, "scales.webp": bytes(1_000_000)}),
    )
    for error, why in zip(
        found,
        ("8 x 8 pixels, not 16 x 16", "16000000 pixels|4000 x 4000", "lossy", "not a WebP", "cut off", "1000000"),
        strict=True,
    ):
        assert any(part in error for part in why.split("|")), error


def test_a_mask_with_another_count():
    mask = pillow(FILES["active_mask.webp"])[:, :, 0]
    cell = np.argwhere(mask)[0]
    mask = mask.copy()
    mask[tuple(cell)] = 0
    (error,) = refusals(job(without_checksums({**FILES, "active_mask.webp": webp(mask[:, :, None])})))
    assert error == "active_mask.webp marks 64 Gaussians; meta.json declares 65"


def test_labels_outside_the_codebook():
    """The last entry is valid; the next one is not, by column or by row."""
    side = json.loads(FILES["meta.json"])["shN"]["centroidSide"]
    jobs = []
    for position in ((side - 1, side - 1), (0, side), (side, side - 1), (255, 255)):
        labels = pillow(FILES["f_rest_labels.webp"])[:, :, :3].copy()
        labels[2, 3, :2] = position
        jobs.append(job(without_checksums({**FILES, "f_rest_labels.webp": webp(labels)})))
    assert "error" not in in_node(jobs[0])[0]
    assert set(refusals(*jobs[1:])) == {"f_rest_labels.webp points outside the codebook"}


def test_more_gaussians_than_allowed():
    """The limit applies to the size of the grid too, and is inclusive."""
    large = with_meta(FILES, put_value("gridSide", 13376))
    found = refusals(
        job(large), job(large, options={"maxGaussians": 80_000_000}), job(FILES, options={"maxGaussians": 64})
    )
    assert all("Gaussians need, the most allowed" in error for error in found)
    (report,) = in_node(job(FILES, options={"maxGaussians": 96}))
    assert assert_scene(report, FILES) <= 1


ZIP = zip_of(FILES)
DEFLATED = zip_of(FILES, zipfile.ZIP_DEFLATED)


def record(data, name, signature, at_name):
    """Return the offset of the record of a file with this signature."""
    at = data.find(name.encode())
    while at >= 0:
        if data[at - at_name : at - at_name + 4] == signature:
            return at - at_name
        at = data.find(name.encode(), at + 1)
    raise AssertionError(name)


def central(data, name="f_dc.webp"):
    return record(data, name, b"PK\1\2", 46)


def local(data, name="f_dc.webp"):
    return record(data, name, b"PK\3\4", 30)


def patched(data, at, form, value):
    new = bytearray(data)
    struct.pack_into(form, new, at, value)
    return bytes(new)


INVALID_ZIPS = [
    (b"", "not a zip"),
    (b"PK\5\6", "not a zip"),
    (ZIP[:-1], "not a zip"),
    (ZIP[: len(ZIP) // 2], "not a zip"),
    (zip_of({}), "has no meta.json"),
    (patched(ZIP, central(ZIP) + 16, "<I", 1), "f_dc.webp is damaged: it does not match its checksum"),
    (patched(ZIP, central(ZIP) + 8, "<H", 1), "f_dc.webp is encrypted"),
    (patched(ZIP, central(ZIP) + 10, "<H", 12), "compression method 12"),
    (patched(ZIP, central(ZIP) + 24, "<I", 99), "damaged"),
    (patched(ZIP, central(ZIP) + 24, "<I", 2**32 - 1), "more than the"),
    (patched(ZIP, central(ZIP) + 20, "<I", 2**32 - 1), "cut off"),
    (patched(ZIP, central(ZIP) + 42, "<I", 2**32 - 1), "not where the zip says"),
    (patched(ZIP, central(ZIP) + 42, "<I", 7), "not where the zip says"),
    (patched(ZIP, central(ZIP), "<I", 7), "table of files is damaged"),
    (patched(ZIP, central(ZIP) + 28, "<H", 65535), "table of files is damaged"),
    (patched(ZIP, len(ZIP) - 6, "<I", 2**32 - 1), "a 64-bit zip"),
    (patched(ZIP, len(ZIP) - 12, "<H", 13), "table of files is damaged"),
    (patched(DEFLATED, central(DEFLATED) + 24, "<I", 99), "damaged"),
    (patched(DEFLATED, central(DEFLATED) + 24, "<I", len(FILES["f_dc.webp"]) + 1), "damaged"),
    (patched(DEFLATED, central(DEFLATED) + 24, "<I", len(FILES["f_dc.webp"]) - 1), "damaged"),
    (patched(DEFLATED, central(DEFLATED) + 16, "<I", 1), "checksum"),
    (patched(DEFLATED, central(DEFLATED) + 20, "<I", 20), "damaged"),
    (patched(DEFLATED, local(DEFLATED) + 39, "<I", 0xFFFFFFFF), "damaged"),
    (zip_of({**FILES, "sub/f_dc.webp": b""}), "the zip has f_dc.webp twice"),
    (zip_of({f"{i}.txt": b"" for i in range(1001)}), "a zip of more than 1000 files"),
]


def test_invalid_zips_are_refused():
    for error, (_, why) in zip(refusals(*(job(data) for data, _ in INVALID_ZIPS)), INVALID_ZIPS, strict=True):
        assert why in error


def test_a_zip_bomb_is_not_unpacked():
    """The file has 64 MiB of zeros and declares them, or declares 5000 bytes; streams may be a few blocks ahead."""
    bomb = zip_of({**FILES, "f_dc.webp": bytes(1 << 26)}, zipfile.ZIP_DEFLATED)
    at = central(bomb)
    found = in_node(job(bomb), job(patched(bomb, at + 24, "<I", 5000)))
    assert "more than the" in found[0]["error"]["message"]
    assert "damaged" in found[1]["error"]["message"]
    assert all(report["unpacked"] < 1 << 20 for report in found)


def test_the_most_entries_and_the_longest_comment():
    more = {f"{i}.txt": b"" for i in range(1000 - len(FILES))}
    zips = [zip_of({**FILES, **more}), zip_of(FILES, comment=b"x" * 65535), zip_of(FILES, comment=b"")]
    for report in in_node(*map(job, zips)):
        assert assert_scene(report, FILES) <= 1
