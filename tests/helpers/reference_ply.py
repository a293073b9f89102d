"""A naive PLY writer and the expected scenes, without code of kissgs."""

import random
import struct

import numpy as np

from kissgs.core.splats import Splats

STRUCT_CODES = {
    **dict.fromkeys(["char", "int8"], "b"),
    **dict.fromkeys(["uchar", "uint8"], "B"),
    **dict.fromkeys(["short", "int16"], "h"),
    **dict.fromkeys(["ushort", "uint16"], "H"),
    **dict.fromkeys(["int", "int32"], "i"),
    **dict.fromkeys(["uint", "uint32"], "I"),
    **dict.fromkeys(["half", "float16"], "e"),
    **dict.fromkeys(["float", "float32"], "f"),
    **dict.fromkeys(["double", "float64"], "d"),
}
ENCODINGS = ("ascii", "binary_little_endian", "binary_big_endian")
REST = {0: 0, 1: 9, 2: 24, 3: 45}


def names(degree):
    """Return the property names in INRIA's order, without normals."""
    dc_and_rest = [f"f_dc_{i}" for i in range(3)] + [f"f_rest_{i}" for i in range(REST[degree])]
    return ["x", "y", "z", *dc_and_rest, "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]


def random_columns(count, degree, *, integers=False):
    """Return random values that are exact in float32; with ``integers``, exact in all PLY types."""
    rng = random.Random(f"{count} {degree}")
    draw = (lambda: rng.randrange(0, 100)) if integers else (lambda: rng.randrange(-(2**20), 2**20) / 2**12)
    return {name: [draw() for _ in range(count)] for name in names(degree)}


def element_bytes(columns, encoding, kind):
    rows = list(zip(*columns.values(), strict=True))
    if encoding == "ascii":
        return b"".join(" ".join(map(repr, row)).encode() + b"\n" for row in rows)
    order = "<" if encoding == "binary_little_endian" else ">"
    return b"".join(struct.pack(order + STRUCT_CODES[kind], value) for row in rows for value in row)


def declaration(element, columns, kind):
    count = len(next(iter(columns.values())))
    return [f"element {element} {count}", *(f"property {kind} {name}" for name in columns)]


def header_bytes(lines, encoding="binary_little_endian", newline="\n"):
    return newline.join(["ply", f"format {encoding} 1.0", *lines, "end_header", ""]).encode()


def ply_bytes(columns, encoding="binary_little_endian", kind="float"):
    return header_bytes(declaration("vertex", columns, kind), encoding) + element_bytes(columns, encoding, kind)


def expected(columns, degree):
    """Return the scene of ``columns``, value by value."""
    count, k = len(columns["x"]), REST[degree] // 3

    def array(*keys):
        return np.array([[columns[key][row] for key in keys] for row in range(count)], np.float32)

    shN = np.zeros((count, k, 3), np.float32)
    for row in range(count):
        for coefficient in range(k):
            for channel in range(3):
                shN[row, coefficient, channel] = columns[f"f_rest_{channel * k + coefficient}"][row]
    return Splats(
        means=array("x", "y", "z").reshape(count, 3),
        quats=array("rot_0", "rot_1", "rot_2", "rot_3").reshape(count, 4),
        scales=array("scale_0", "scale_1", "scale_2").reshape(count, 3),
        opacities=array("opacity").reshape(count),
        sh0=array("f_dc_0", "f_dc_1", "f_dc_2").reshape(count, 3),
        shN=shN,
    )


def assert_identical(a, b):
    """Assert that scenes are equal bit by bit, so that NaN equals itself and -0 differs from 0."""
    for name in ("means", "quats", "scales", "opacities", "sh0", "shN"):
        x, y = getattr(a, name), getattr(b, name)
        assert x.shape == y.shape, name
        assert x.tobytes() == y.tobytes(), name
