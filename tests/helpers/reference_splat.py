"""Naive writers of .splat and .ksplat, number by number, without code of kissgs."""

import math
import struct

SH_C0 = 0.28209479177387814
RANGES = (1, 32767, 32767)
BUCKET = 256


def byte(value):
    return max(0, min(255, round(value)))


def rgba(splats, i):
    opacity = 1 / (1 + math.exp(-max(-80, min(80, float(splats.opacities[i])))))
    return [byte(255 * (0.5 + SH_C0 * float(c))) for c in splats.sh0[i]] + [byte(255 * opacity)]


def splat_bytes(splats):
    """Return a .splat of the scene."""
    data = b""
    for i in range(len(splats)):
        data += struct.pack("<3f", *map(float, splats.means[i]))
        data += struct.pack("<3f", *(math.exp(float(s)) for s in splats.scales[i]))
        data += bytes(rgba(splats, i)) + bytes(byte(float(q) * 128 + 128) for q in splats.quats[i])
    return data


def rest_by_band(splats, i):
    """Return the SH coefficients of one Gaussian: band by band, all of R, then G, then B."""
    values, first = [], 0
    for width in (3, 5, 7):
        if first < splats.shN.shape[1]:
            values += [float(splats.shN[i, first + k, channel]) for channel in range(3) for k in range(width)]
            first += width
    return values


def ksplat_bytes(scenes, level, *, block_size=5.0, sh_range=(-1.5, 1.5), unused=0):
    """Return a .ksplat with one section per scene; ``unused`` unused records and section headers follow."""
    sections = [section(scene, level, block_size, sh_range, unused) for scene in scenes]
    count = sum(map(len, scenes))
    head = struct.pack("<BBxxIIIIHxx", 0, 1, len(scenes) + unused, len(scenes), count + unused, count, level)
    head += struct.pack("<3f2f", 0, 0, 0, *sh_range)
    data = head.ljust(4096, b"\0")
    for header, _ in sections:
        data += header.ljust(1024, b"\0")
    data += bytes(1024 * unused)
    return data + b"".join(body for _, body in sections)


def section(splats, level, block_size, sh_range, unused):
    """Return header and data of a section; each 256 Gaussians are a bucket around their middle."""
    buckets = -(-len(splats) // BUCKET) if level else 0
    full = len(splats) // BUCKET if level else 0
    centres = []
    for b in range(buckets):
        rows = splats.means[b * BUCKET : (b + 1) * BUCKET]
        centres.append([(float(min(rows[:, axis])) + float(max(rows[:, axis]))) / 2 for axis in range(3)])
    lengths = [len(splats) - full * BUCKET] * (buckets - full)
    records = b"".join(record(splats, i, level, centres, block_size, sh_range) for i in range(len(splats)))
    size = len(records) // max(len(splats), 1)
    body = struct.pack(f"<{len(lengths)}I", *lengths)
    body += b"".join(struct.pack("<3f", *centre) for centre in centres) + records + bytes(size * unused)
    degree = (0, 3, 8, 15).index(splats.shN.shape[1])
    bucket_fields = (BUCKET, buckets, block_size, 12) if level else (0, 0, 0.0, 0)
    header = struct.pack("<IIIIfHxx", len(splats), len(splats) + unused, *bucket_fields)
    header += struct.pack("<IIIIH", RANGES[level] if level else 0, len(body), full, buckets - full, degree)
    return header, body


def record(splats, i, level, centres, block_size, sh_range):
    scales = [math.exp(float(s)) for s in splats.scales[i]]
    quat, rest = list(map(float, splats.quats[i])), rest_by_band(splats, i)
    if level == 0:
        data = struct.pack("<10f", *map(float, splats.means[i]), *scales, *quat)
        return data + bytes(rgba(splats, i)) + struct.pack(f"<{len(rest)}f", *rest)
    centre, scale = centres[i // BUCKET], RANGES[level] / (block_size / 2)
    places = [round((float(v) - c) * scale) + RANGES[level] for v, c in zip(splats.means[i], centre, strict=True)]
    data = struct.pack("<3H", *(max(0, min(2 * RANGES[level] + 1, p)) for p in places))
    data += struct.pack("<7e", *scales, *quat) + bytes(rgba(splats, i))
    if level == 1:
        return data + struct.pack(f"<{len(rest)}e", *rest)
    low, high = sh_range
    return data + bytes(byte((v - low) / (high - low) * 255) for v in rest)
