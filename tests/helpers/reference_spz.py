"""A naive writer of .spz, versions 1 to 4, number by number, without code of kissgs; zstd frames hold plain bytes."""

import gzip
import math
import struct

FLIPS = ((-1, -1, 1), (-1, 1, 1, -1, 1), (-1, 1, -1, -1, 1, -1, 1))
"""Signs of the SH coefficients from a .ply's axes to x right, y up, z back."""


def clamp(value, low=0, high=255):
    return max(low, min(high, round(value)))


def positions(splats, version, bits, y_up):
    data = b""
    for x, y, z in splats.means.tolist():
        x, y, z = (x, -y, -z) if y_up else (x, y, z)
        if version == 1:
            data += struct.pack("<3e", x, y, z)
        else:
            for value in (x, y, z):
                data += (round(value * 2**bits) & 0xFFFFFF).to_bytes(3, "little")
    return data


def rotation(quat, version, y_up):
    w, x, y, z = quat
    parts = [x, -y, -z, w] if y_up else [x, y, z, w]
    if version < 3:
        sign = -1 if parts[3] < 0 else 1
        return bytes(clamp((sign * v + 1) * 127.5) for v in parts[:3])
    largest = max(range(4), key=lambda i: abs(parts[i]))
    sign = -1 if parts[largest] < 0 else 1
    word = largest
    for i in range(4):
        if i != largest:
            value = sign * parts[i]
            word = word << 10 | (value < 0) << 9 | math.floor(511 * abs(value) * math.sqrt(2) + 0.5)
    return struct.pack("<I", word)


def rest(splats, y_up):
    signs = [sign for band in FLIPS for sign in band]
    data = b""
    for row in splats.shN.tolist():
        for k, channels in enumerate(row):
            sign = signs[k] if y_up else 1
            data += bytes(clamp(sign * value * 128 + 128) for value in channels)
    return data


def streams(splats, version, bits=12, y_up=True):
    """Return the six streams of a scene."""
    alphas = bytes(clamp(255 / (1 + math.exp(-max(-80, min(80, v))))) for v in splats.opacities.tolist())
    colors = bytes(clamp(255 * (0.15 * v + 0.5)) for row in splats.sh0.tolist() for v in row)
    scales = bytes(clamp((v + 10) * 16) for row in splats.scales.tolist() for v in row)
    rotations = b"".join(rotation(quat, version, y_up) for quat in splats.quats.tolist())
    return [positions(splats, version, bits, y_up), alphas, colors, scales, rotations, rest(splats, y_up)]


def spz_bytes(splats, version, *, bits=12, flags=0, y_up=True, extensions=b""):
    """Return a file of the scene, ``extensions`` where the version has them."""
    degree = (0, 3, 8, 15).index(splats.shN.shape[1])
    parts = streams(splats, version, bits, y_up)
    flags |= 2 if extensions else 0
    header = struct.pack("<4sIIBBBB", b"NGSP", version, len(splats), degree, bits, flags, 0)
    if version < 4:
        return gzip.compress(header + b"".join(parts) + extensions, mtime=0)
    return v4_file(header, [part for part in parts if part or len(splats) == 0][: 6 if degree else 5], extensions)


def v4_file(header, parts, extensions=b""):
    frames = [frame(part) for part in parts]
    table = b"".join(struct.pack("<QQ", len(f), len(part)) for f, part in zip(frames, parts, strict=True))
    head = header[:15] + bytes([len(parts)]) + struct.pack("<I", 32 + len(extensions))
    return head.ljust(32, b"\0") + extensions + table + b"".join(frames)


def frame(data):
    """Return a zstd frame of uncompressed blocks."""
    blocks = [data[i : i + 131072] for i in range(0, len(data), 131072)] or [b""]
    body = b""
    for i, block in enumerate(blocks):
        body += (len(block) << 3 | (i == len(blocks) - 1)).to_bytes(3, "little") + block
    return bytes.fromhex("28b52ffda0") + struct.pack("<I", len(data)) + body
