"""Oracle: files packed value by value with struct in naive_ply.py, INRIA's layout by hand, and real scenes."""

import io
import itertools
import math
import os
import random
import struct
import subprocess
import sys
from decimal import Decimal, localcontext

import numpy as np
import pytest
from helpers.reference_ply import (
    ENCODINGS,
    STRUCT_CODES,
    assert_identical,
    declaration,
    element_bytes,
    expected,
    header_bytes,
    names,
    ply_bytes,
    random_columns,
)

import kissgs
from kissgs.core.errors import InvalidSceneError
from kissgs.core.splats import Splats, concatenate
from kissgs.io import ply
from kissgs.io import ply_rows as ply_body
from kissgs.io.ply import PlyInfo, read_ply, read_ply_blocks, read_ply_info, write_ply


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_every_degree_in_every_encoding(encoding):
    for degree in range(4):
        columns = random_columns(5, degree)
        data = ply_bytes(columns, encoding)
        assert_identical(read_ply(data), expected(columns, degree))
        assert read_ply_info(data) == PlyInfo(count=5, sh_degree=degree, encoding=encoding, compressed=False)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_every_type_in_shuffled_order(encoding):
    columns = random_columns(3, 1, integers=True)
    for kind in STRUCT_CODES:
        order = sorted(columns)
        random.Random(kind).shuffle(order)
        data = ply_bytes({name: columns[name] for name in order}, encoding, kind)
        assert_identical(read_ply(data), expected(columns, 1))


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_types_may_differ_between_properties(encoding):
    columns = random_columns(4, 0, integers=True)
    kinds = dict(zip(columns, itertools.cycle(STRUCT_CODES), strict=False))
    lines = ["element vertex 4", *(f"property {kind} {name}" for name, kind in kinds.items())]
    order = ">" if encoding == "binary_big_endian" else "<"
    if encoding == "ascii":
        body = element_bytes(columns, encoding, "float")
    else:
        body = b"".join(
            struct.pack(order + STRUCT_CODES[kinds[name]], columns[name][row]) for row in range(4) for name in columns
        )
    assert_identical(read_ply(header_bytes(lines, encoding) + body), expected(columns, 0))


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("newline", ["\n", "\r\n"])
def test_what_gaussians_do_not_need_is_ignored(encoding, newline):
    """Comments, normals, labels, elements on both sides, a list after, bytes after the end; what is lost is named."""
    columns = random_columns(3, 1)
    extra = {"nx": [1.0, 2.0, 3.0], **columns, "label": [4.0, 5.0, 6.0]}
    before, after = {"fx": [7.0, 8.0], "fy": [9.0, 9.5]}, {"frame": [1.0]}
    lines = ["comment Vertical axis: y", "obj_info näive", "", *declaration("camera", before, "double")]
    lines += [*declaration("vertex", extra, "float"), *declaration("last", after, "float")]
    lines += ["element face 1", "property list uchar int vertex_indices"]
    body = element_bytes(before, encoding, "double") + element_bytes(extra, encoding, "float")
    data = header_bytes(lines, encoding, newline) + body + element_bytes(after, encoding, "float") + b"\x03 and more"
    splats = read_ply(data)
    assert_identical(splats, expected(columns, 1))
    assert splats.notes == ("left out: label, element last, element face",)


def test_many_and_strange_names_are_one_short_line():
    columns = random_columns(1, 0) | {f"feature_{i}": [0.0] for i in range(40)} | {"y" * 999: [0.0]}
    (note,) = read_ply(ply_bytes(columns)).notes
    assert note == f"left out: {', '.join(f'feature_{i}' for i in range(6))} and 35 more"
    (note,) = read_ply(ply_bytes(random_columns(1, 0) | {"\x1b[31m" + "x" * 99: [0.0]})).notes
    assert note.isprintable()
    assert len(note) < 130


def test_what_says_nothing_new_is_not_named():
    columns = {name: [0.0] for name in ("nx", "ny", "nz", *names(1), "red", "green", "blue", "alpha")}
    lines = [*declaration("vertex", columns, "float"), *declaration("camera", {"fx": [1.0]}, "float"), "element face 0"]
    assert read_ply(header_bytes(lines) + element_bytes(columns, ENCODINGS[1], "float") + b"\0" * 4).notes == ()


def decimal_filter(scales, logit, size):
    """Mip-Splatting's fusion in decimals of 80 digits: wider scales, opacity times the ratio of the volumes."""
    with localcontext() as context:
        context.prec = 80
        before = [Decimal(scale).exp() for scale in scales]
        after = [(scale**2 + Decimal(size) ** 2).sqrt() for scale in before]
        opacity = math.prod(before) / math.prod(after) / (1 + (-Decimal(logit)).exp())
        return [float(scale.ln()) for scale in after], float((opacity / (1 - opacity)).ln())


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_filters_of_mip_splatting_are_applied(encoding):
    columns = random_columns(7, 0)
    sizes, scales = [0.05, -0.05, 1e-12, 1e12, 3.0, 0.0, math.nan], [-4.0, -4.0, 30.0, -30.0, -30.0, 12.0, -4.0]
    logits = [1.0, 1.0, 13.0, 13.0, -13.0, 40.0, 1.0]
    columns |= {"scale_0": scales, "scale_1": [value / 2 for value in scales], "opacity": logits, "filter_3D": sizes}
    path_splats = read_ply(ply_bytes(columns, encoding))
    for row in range(5):
        wide, logit = decimal_filter([columns[f"scale_{i}"][row] for i in range(3)], logits[row], sizes[row])
        np.testing.assert_allclose(path_splats.scales[row], wide, rtol=2e-7)
        np.testing.assert_allclose(path_splats.opacities[row], logit, rtol=2e-7)
    unchanged = expected(columns, 0)
    assert path_splats.opacities[5] == unchanged.opacities[5]
    np.testing.assert_array_equal(path_splats.scales[5], unchanged.scales[5])
    assert np.isnan(path_splats.opacities[6])
    np.testing.assert_array_equal(path_splats.means, unchanged.means)
    assert [note for note in path_splats.notes if "filter_3D" in note] == list(path_splats.notes) != []


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_several_blocks(encoding, monkeypatch):
    monkeypatch.setattr(ply_body, "BLOCK_BYTES", 1000)
    columns = random_columns(600, 0)
    seen = []
    splats = read_ply(ply_bytes(columns, encoding), progress=lambda stage, fraction: seen.append((stage, fraction)))
    assert_identical(splats, expected(columns, 0))
    assert {stage for stage, _ in seen} == {"read"}
    fractions = [fraction for _, fraction in seen]
    assert fractions == sorted(fractions)
    assert len(fractions) > 3
    assert fractions[0] == 0
    assert fractions[-1] == 1


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_no_gaussians(encoding):
    data = ply_bytes({name: [] for name in names(3)}, encoding)
    splats = read_ply(data)
    assert len(splats) == 0
    assert splats.sh_degree == 3
    assert_identical(read_ply(data.rstrip(b"\n")), splats)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_doubles_beyond_float32_become_infinite(encoding):
    columns = {name: [1e300, -1e300, 1e-300, float("nan")] for name in names(0)}
    means = read_ply(ply_bytes(columns, encoding, "double")).means
    np.testing.assert_array_equal(means[:, 0], np.array([np.inf, -np.inf, 0, np.nan], np.float32))


def test_ascii_is_read_as_people_write_it():
    values = "\t1 +2 -3e0 .5 NaN inf -Infinity 1e999 0 0 1 0 0 0  \r\n"
    data = header_bytes(["element vertex 2", *(f"property float {n}" for n in names(0))], "ascii", "\r\n")
    splats = read_ply(data + ("\r\n" + values + " \n\n" + values.strip()).encode())
    np.testing.assert_array_equal(splats.means, [[1, 2, -3], [1, 2, -3]])
    np.testing.assert_array_equal(splats.sh0[1], [0.5, np.nan, np.inf])
    np.testing.assert_array_equal(splats.opacities, [-np.inf, -np.inf])
    np.testing.assert_array_equal(splats.scales[0], [np.inf, 0, 0])


@pytest.mark.parametrize(
    ("words", "value"),
    [
        (
            "nan(snan) -nan(ind) NAN(IND) nan(0x7fc00000) -nan nanq 1.#QNAN -1.#IND 1.#SNAN 1.#QNAN0 -1.#IND00 1.#J",
            np.nan,
        ),
        ("1.#INF 1.#inf00 1.#INF00e+000 inf INF Infinity", np.inf),
        ("-1.#INF -1.#INF00 -inf", -np.inf),
    ],
)
def test_nan_and_infinity_of_c_libraries(words, value):
    """The words that printf of glibc, AIX and Visual C++, old and new, writes, some rounded to few digits."""
    rows = [["1"] * 14 for _ in words.split()]
    for number, word in enumerate(words.split()):
        rows[number][number % 14] = word
    data = header_bytes([f"element vertex {len(rows)}", *(f"property float {n}" for n in names(0))], "ascii")
    splats = read_ply(data + "\n".join(map(" ".join, rows)).encode())
    table = np.concatenate([splats.means, splats.sh0, splats.opacities[:, None], splats.scales, splats.quats], axis=1)
    wanted = np.ones((len(rows), 14))
    wanted[range(len(rows)), [number % 14 for number in range(len(rows))]] = value
    np.testing.assert_array_equal(table, wanted)


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("newline", [b"\n", b"\r\n"])
def test_line_ends_and_a_byte_order_mark(encoding, newline):
    """Text editors of Windows add the mark."""
    columns = random_columns(3, 1)
    (columns["x"][0],) = struct.unpack("<f", b"\n\0\0\n")  # the body begins like a line end, in either byte order
    header = header_bytes(declaration("vertex", columns, "float"), encoding).replace(b"\n", newline)
    body = element_bytes(columns, encoding, "float")
    data = b"\xef\xbb\xbf" + header + (body.replace(b"\n", newline) if encoding == "ascii" else body)
    assert_identical(read_ply(data), expected(columns, 1))


def test_nerfstudio_rgb_colours():
    """The exporter's --ply-color-mode rgb writes 8-bit colours instead of f_dc_*."""
    columns = random_columns(1, 0)
    geometry = [name for name in columns if not name.startswith("f_dc")]
    lines = ["element vertex 1", *(f"property float {name}" for name in geometry)]
    lines += [f"property uchar {name}" for name in ("red", "green", "blue")]
    body = struct.pack("<11f3B", *(columns[name][0] for name in geometry), 0, 255, 51)
    splats = read_ply(header_bytes(lines) + body)
    np.testing.assert_allclose(splats.sh0 * 0.28209479177387814 + 0.5, [[0, 1, 0.2]], atol=1e-6)
    np.testing.assert_array_equal(splats.means[0], [columns[axis][0] for axis in "xyz"])


def test_f_dc_wins_over_rgb():
    columns = random_columns(2, 0, integers=True)
    data = ply_bytes({"red": [1, 2], "green": [1, 2], "blue": [1, 2], **columns}, kind="uchar")
    assert_identical(read_ply(data), expected(columns, 0))


def test_lists_before_the_gaussians_in_ascii():
    columns = random_columns(2, 0)
    lines = ["element face 2", "property list uchar int i", *declaration("vertex", columns, "float")]
    data = header_bytes(lines, "ascii") + b"3 0 1 2\n1 0\n" + element_bytes(columns, "ascii", "float")
    assert_identical(read_ply(data), expected(columns, 0))


def test_fox(shared_data):
    path = shared_data / "fox" / "point_cloud.ply"
    splats = read_ply(path)
    assert read_ply_info(path) == PlyInfo(count=79451, sh_degree=3, encoding="binary_little_endian", compressed=False)
    row = 40_000  # x y z, nx ny nz, f_dc 3, f_rest 45, opacity, scale 3, rot 4
    with path.open("rb") as file:
        file.seek(-4 * 62 * (79451 - row), os.SEEK_END)
        values = struct.unpack("<62f", file.read(4 * 62))
    assert tuple(splats.means[row]) == values[:3]
    assert tuple(splats.sh0[row]) == values[6:9]
    assert tuple(splats.shN[row].T.ravel()) == values[9:54]
    assert splats.opacities[row] == values[54]
    assert tuple(splats.scales[row]) == values[55:58]
    assert tuple(splats.quats[row]) == values[58:]


def test_written_layout():
    columns = random_columns(1, 1)
    stream = io.BytesIO()
    write_ply(stream, expected(columns, 1))
    position = {axis: columns[axis] for axis in "xyz"}
    assert stream.getvalue() == ply_bytes({**position, "nx": [0.0], "ny": [0.0], "nz": [0.0], **columns})


class Pipe:
    """A stream that can only be written."""

    def __init__(self):
        self.data = b""

    def write(self, data):
        self.data += bytes(data)


@pytest.mark.parametrize(("degree", "count"), [(0, 16_385), (1, 1), (2, 0), (3, 16_385)])
def test_written_and_read_again_bit_by_bit(degree, count):
    """Any 32 bits: payloads of NaN, infinities and -0 included."""
    rng = np.random.default_rng(degree)

    def bits(*shape):
        return rng.integers(0, 2**32, (count, *shape), np.uint32).view(np.float32)

    splats = Splats(
        means=bits(3), quats=bits(4), scales=bits(3), opacities=bits(), sh0=bits(3), shN=bits((0, 3, 8, 15)[degree], 3)
    )
    pipe, seen = Pipe(), []
    write_ply(pipe, splats, progress=lambda stage, fraction: seen.append((stage, fraction)))
    assert_identical(read_ply(pipe.data), splats)
    assert seen[-1:] == ([("write", 1.0)] if count else [])


def test_info_does_not_read_the_body():
    data = header_bytes(declaration("vertex", {name: [0, 0] for name in names(2)}, "float"), "ascii") + b"?\n" * 100
    assert read_ply_info(data) == PlyInfo(count=2, sh_degree=2, encoding="ascii", compressed=False)


MEASURE = """
import resource, sys
from pathlib import Path
from kissgs.io.ply import read_ply
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
read_ply(Path(sys.argv[1]))
print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024)
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="ru_maxrss is in kilobytes on Linux only")
def test_peak_memory(tmp_path):
    """The arrays are 0.95 of the file; all else has to fit in a few blocks, so the page cache's copy must not count."""
    path, rows = tmp_path / "big.ply", 4096
    block = np.random.default_rng(0).standard_normal((rows, 62), np.float32).tobytes()
    properties = [*names(0)[:3], "nx", "ny", "nz", *names(3)[3:]]
    with path.open("wb") as file:
        file.write(header_bytes([f"element vertex {40 * rows}", *(f"property float {name}" for name in properties)]))
        for _ in range(40):
            file.write(block)
    result = subprocess.run([sys.executable, "-c", MEASURE, path], capture_output=True, text=True, check=True)
    size = path.stat().st_size
    path.unlink()  # pytest keeps the folders of three runs
    assert int(result.stdout) < 1.1 * size


def test_info_of_a_beginning():
    """The first bytes of an upload and its size give the header's information."""
    data = ply_bytes(random_columns(3, 1))
    header = data[: data.index(b"end_header\n") + 11]
    assert read_ply_info(header, size=len(data)) == read_ply_info(data)
    with pytest.raises(InvalidSceneError, match="is cut short"):
        read_ply_info(header, size=len(data) - 1)


# Scenes read in blocks. Oracle: the same file read as a whole.


@pytest.mark.parametrize(("count", "degree"), [(0, 0), (299, 2), (300, 0), (1000, 2)])
@pytest.mark.parametrize("encoding", ENCODINGS)
def test_blocks_are_the_scene(encoding, count, degree, tmp_path, monkeypatch):
    monkeypatch.setattr(ply, "BLOCK", 100)
    monkeypatch.setattr(ply_body, "BLOCK_BYTES", 100 * 4 * (14 + 45))
    path = tmp_path / "scene.ply"
    path.write_bytes(ply_bytes(random_columns(count, degree), encoding))
    blocks = list(read_ply_blocks(path))
    assert sum(map(len, blocks)) == count
    assert len(blocks) > 1 or count < 1000
    if count:
        assert_identical(concatenate(blocks), read_ply(path))
        path.write_bytes(path.read_bytes()[:-60])
        with pytest.raises(InvalidSceneError, match=r"scene\.ply"):
            list(read_ply_blocks(path))


@pytest.mark.parametrize("kind", ["filters and notes", "8-bit colours", "compressed"])
def test_a_block_of_other_properties(kind, tmp_path):
    path = tmp_path / "scene.ply"
    columns = random_columns(3, 0)
    if kind == "filters and notes":
        path.write_bytes(ply_bytes(columns | {"filter_3D": [0.1, 0.2, 0.3], "label": [1.0, 2.0, 3.0]}))
    elif kind == "8-bit colours":
        rgb = {"red": [0, 40, 80], "green": [128] * 3, "blue": [255] * 3}
        values = {name: values for name, values in columns.items() if not name.startswith("f_dc")}
        lines = [*declaration("vertex", values, "float"), *(f"property uchar {name}" for name in rgb)]
        path.write_bytes(header_bytes(lines, "ascii") + element_bytes(values | rgb, "ascii", "float"))
    else:
        with path.open("wb") as file:
            ply.write_compressed(file, kissgs.sample_scene(700, sh_degree=1))
    whole, (block,) = read_ply(path), read_ply_blocks(path)
    assert_identical(block, whole)
    assert block.notes == whole.notes
    assert len(whole.notes) == 2 * (kind == "filters and notes")
