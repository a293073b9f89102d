"""A naive writer of PlayCanvas' compressed .ply, value by value, without code of kissgs."""

import math
import struct

SH_C0 = 0.28209479177387814
BOUNDS = ["x", "y", "z", "scale_x", "scale_y", "scale_z", "r", "g", "b"]
PACKED = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]


def quantise(value, low, high, steps):
    t = (value - low) / (high - low) if high > low else 0
    return max(0, min(steps, round(t * steps)))


def pack_vector(values, bounds):
    x, y, z = (quantise(v, *b, s) for v, b, s in zip(values, bounds, (2047, 1023, 2047), strict=True))
    return x << 21 | y << 11 | z


def pack_quat(quat):
    largest = max(range(4), key=lambda i: abs(quat[i]))
    sign = -1 if quat[largest] < 0 else 1
    word = largest
    for i in range(4):
        if i != largest:
            word = word << 10 | quantise(sign * quat[i], -math.sqrt(0.5), math.sqrt(0.5), 1023)
    return word


def pack_colour(rgb, bounds, opacity):
    r, g, b = (quantise(v, *bound, 255) for v, bound in zip(rgb, bounds, strict=True))
    return r << 24 | g << 16 | b << 8 | quantise(opacity, 0, 1, 255)


def pack_sh(value):
    return max(0, min(255, math.floor((value / 8 + 0.5) * 256)))


def compressed_bytes(gaussians, rest_count, *, colour_bounds=True, order="<"):
    """Return a file; ``gaussians`` are dicts of position, quat, log_scale, rgb, opacity (0 to 1), rest (f_rest_*)."""
    body, packed, sh = b"", b"", b""
    for start in range(0, len(gaussians), 256):
        chunk = gaussians[start : start + 256]
        position, log_scale, rgb = (extents(chunk, key) for key in ("position", "log_scale", "rgb"))
        for bounds in [position, log_scale, *([rgb] if colour_bounds else [])]:
            body += struct.pack(f"{order}6f", *(low for low, _ in bounds), *(high for _, high in bounds))
        for g in chunk:
            packed += struct.pack(
                f"{order}4I",
                pack_vector(g["position"], position),
                pack_quat(g["quat"]),
                pack_vector(g["log_scale"], log_scale),
                pack_colour(g["rgb"], rgb if colour_bounds else [(0, 1)] * 3, g["opacity"]),
            )
            sh += bytes(pack_sh(value) for value in g["rest"])
    return header_bytes(len(gaussians), rest_count, colour_bounds, order) + body + packed + sh


def extents(chunk, key):
    """Return minimum and maximum of each of the three values, as float32."""
    columns = [[g[key][i] for g in chunk] for i in range(3)]
    return [struct.unpack("<2f", struct.pack("<2f", min(column), max(column))) for column in columns]


def header_bytes(count, rest_count, colour_bounds=True, order="<", *, chunks=None):
    names = BOUNDS if colour_bounds else BOUNDS[:6]
    groups = [names[i : i + 3] for i in range(0, len(names), 3)]
    encoding = {"<": "binary_little_endian", ">": "binary_big_endian"}[order]
    lines = ["ply", f"format {encoding} 1.0", f"element chunk {-(-count // 256) if chunks is None else chunks}"]
    lines += [f"property float {end}_{name}" for group in groups for end in ("min", "max") for name in group]
    lines += [f"element vertex {count}", *(f"property uint {name}" for name in PACKED)]
    if rest_count:
        lines += [f"element sh {count}", *(f"property uchar f_rest_{i}" for i in range(rest_count))]
    return "\n".join([*lines, "end_header", ""]).encode()
