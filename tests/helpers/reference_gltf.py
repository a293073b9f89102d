"""A naive writer and a naive parser of glTF with KHR_gaussian_splatting, number by number, without code of kissgs."""

import base64
import json
import math
import struct

NAME = "KHR_gaussian_splatting"
SPZ = "KHR_gaussian_splatting_compression_spz_2"
FLIPS = ((-1, 1, -1), (1, -1, 1, -1, 1), (-1, 1, -1, 1, -1, 1, -1))
"""Signs of the SH coefficients from a .ply's axes to x left, y up, z forward."""

SIZES = {"f": 5126, "b": 5120, "B": 5121, "h": 5122, "H": 5123}
TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}


def attributes(splats):
    """Return name -> rows of floats, in glTF's axes."""
    found = {
        "POSITION": [[-x, -y, z] for x, y, z in splats.means.tolist()],
        f"{NAME}:ROTATION": [[-y, x, w, -z] for w, x, y, z in splats.quats.tolist()],
        f"{NAME}:SCALE": [[math.exp(v) for v in row] for row in splats.scales.tolist()],
        f"{NAME}:OPACITY": [[1 / (1 + math.exp(-max(-80, min(80, v))))] for v in splats.opacities.tolist()],
        f"{NAME}:SH_DEGREE_0_COEF_0": splats.sh0.tolist(),
    }
    k = 0
    for band, signs in enumerate(FLIPS, 1):
        if k < splats.shN.shape[1]:
            for n, sign in enumerate(signs):
                found[f"{NAME}:SH_DEGREE_{band}_COEF_{n}"] = [[sign * v for v in row[k]] for row in splats.shN.tolist()]
                k += 1
    return found


def document(columns, codes=None, *, stride=None):
    """Return the JSON and the buffer of one primitive; ``codes`` are other component types than floats, by name."""
    codes, buffer = codes or {}, b""
    root = {
        "asset": {"version": "2.0"}, "extensionsUsed": [NAME], "buffers": [{}], "bufferViews": [], "accessors": [],
        "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
    }  # fmt: skip
    indices = {}
    for name, rows in columns.items():
        code, width = codes.get(name, "f"), len(rows[0]) if rows else 3
        top = {"f": 1, "b": 127, "B": 255, "h": 32767, "H": 65535}[code]
        size = struct.calcsize(f"<{width}{code}")
        step = -(-size // 4) * 4 if stride is None else stride
        start = len(buffer)
        for row in rows:
            values = row if code == "f" else [round(v * top) for v in row]
            buffer += struct.pack(f"<{width}{code}", *values).ljust(step, b"\xaa")
        view = {"buffer": 0, "byteOffset": start, "byteLength": len(buffer) - start}
        root["bufferViews"].append(view if step == size else {**view, "byteStride": step})
        accessor = {"bufferView": len(indices), "componentType": SIZES[code], "count": len(rows), "type": TYPES[width]}
        root["accessors"].append(accessor if code == "f" else {**accessor, "normalized": True})
        indices[name] = len(indices)
    root["buffers"][0]["byteLength"] = len(buffer)
    splatting = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    primitive = {"mode": 0, "attributes": indices, "extensions": {NAME: splatting}}
    root["meshes"] = [{"primitives": [primitive]}]
    return root, buffer


def glb_bytes(root, buffer):
    text = json.dumps(root).encode()
    text += b" " * (-len(text) % 4)
    buffer += b"\0" * (-len(buffer) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(buffer), b"BIN\0") + buffer
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def parse_glb(data):
    """Return the JSON, and name -> rows of numbers of the only primitive; the rules of GLB are asserted."""
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON"
    assert size % 4 == 0
    root = json.loads(data[20 : 20 + size])
    body_size, kind = struct.unpack_from("<I4s", data, 20 + size)
    assert kind == b"BIN\0"
    body = data[28 + size :]
    assert len(body) == body_size == root["buffers"][0]["byteLength"]
    (primitive,) = root["meshes"][0]["primitives"]
    columns, used = {}, 0
    for name, index in primitive["attributes"].items():
        accessor = root["accessors"][index]
        view = root["bufferViews"][accessor["bufferView"]]
        code = {number: code for code, number in SIZES.items()}[accessor["componentType"]]
        width = {text: width for width, text in TYPES.items()}[accessor["type"]]
        row = struct.Struct(f"<{width}{code}")
        assert view["byteOffset"] % 4 == 0
        assert view["byteLength"] == row.size * accessor["count"]
        used += view["byteLength"]
        columns[name] = [
            list(row.unpack_from(body, view["byteOffset"] + i * row.size)) for i in range(accessor["count"])
        ]
        for key, pick in (("min", min), ("max", max)):
            if name == "POSITION":
                assert accessor[key] == [pick(axis) for axis in zip(*columns[name], strict=True)]
    assert used == body_size
    return root, columns


def data_uri(buffer):
    return "data:application/octet-stream;base64," + base64.b64encode(buffer).decode()


def spz_document(spz, count):
    """Return the JSON and the buffer of a primitive whose attributes are in a .spz."""
    root = {
        "asset": {"version": "2.0"}, "buffers": [{"byteLength": len(spz)}],
        "bufferViews": [{"buffer": 0, "byteOffset": 0, "byteLength": len(spz)}],
        "accessors": [{"componentType": 5126, "count": count, "type": "VEC3"}],
        "meshes": [{"primitives": [{"mode": 0, "attributes": {"POSITION": 0}, "extensions": {NAME: {
            "kernel": "ellipse", "colorSpace": "srgb_rec709_display", "extensions": {SPZ: {"bufferView": 0}}}}}]}],
    }  # fmt: skip
    return root, spz
