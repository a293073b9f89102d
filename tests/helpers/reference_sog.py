"""A naive writer and reader of SOG, versions 1 and 2, number by number, without code of kissgs."""

import io
import json
import math
import zipfile

import numpy as np
from PIL import Image

BANDS = {3: 1, 8: 2, 15: 3}


def webp(rows, width, height, channels):
    """Return a lossless WebP of the rows, one per pixel; the last row fills what is left."""
    image = np.zeros((height * width, channels), np.uint8)
    image[: len(rows)] = np.reshape(rows, (-1, channels))
    image[len(rows) :] = rows[-1] if len(rows) else 0
    buffer = io.BytesIO()
    Image.fromarray(image.reshape(height, width, channels)).save(buffer, "WEBP", lossless=True, exact=True)
    return buffer.getvalue()


def signed_log(value):
    return math.copysign(math.log1p(abs(value)), value)


def nearest(value, codebook):
    return min(range(len(codebook)), key=lambda i: abs(codebook[i] - value))


def codebook_of(values):
    low, high = (min(values), max(values)) if values else (0, 1)
    return [low + (high - low) * i / 255 for i in range(256)]


def quat_pixel(quat):
    largest = max(range(4), key=lambda i: abs(quat[i]))
    sign = -1 if quat[largest] < 0 else 1
    small = [round((sign * quat[i] / math.sqrt(2) + 0.5) * 255) for i in range(4) if i != largest]
    return [*small, 252 + largest]


def sog_files(splats, *, version=2, width=None, height=None, names=str):
    """Return the files of a container; ``names`` maps file names, the metadata's too."""
    count, k = len(splats), splats.shN.shape[1]
    width = width or max(1, math.ceil(math.sqrt(count)))
    height = height or max(1, -(-count // width))
    files = {}

    def plane(name, rows, channels):
        files[names(f"{name}.webp")] = webp(rows, width, height, channels)
        return names(f"{name}.webp")

    logs = [[signed_log(v) for v in row] for row in splats.means.tolist()]
    mins = [min((row[a] for row in logs), default=0) for a in range(3)]
    maxs = [max((row[a] for row in logs), default=0) for a in range(3)]
    levels = [
        [round((row[a] - mins[a]) / (maxs[a] - mins[a]) * 65535) if maxs[a] > mins[a] else 0 for a in range(3)]
        for row in logs
    ]
    means = [
        plane("means_l", [[v % 256 for v in row] for row in levels], 3),
        plane("means_u", [[v // 256 for v in row] for row in levels], 3),
    ]
    meta = {
        "means": {"mins": mins, "maxs": maxs, "files": means},
        "quats": {"files": [plane("quats", [quat_pixel(q) for q in splats.quats.tolist()], 4)]},
    }
    logits = [max(-13.8, min(13.8, v)) for v in splats.opacities.tolist()]
    scales = codebook_of([v for row in splats.scales.tolist() for v in row])
    colors = codebook_of([v for row in splats.sh0.tolist() for v in row])
    rest = codebook_of(splats.shN.ravel().tolist())
    if version == 2:
        meta |= {"version": 2, "count": count, "asset": {"generator": "by hand"}}
        opacity = [round(255 / (1 + math.exp(-v))) for v in logits]
        meta["scales"], meta["sh0"] = {"codebook": scales}, {"codebook": colors}
        colors4 = colors
    else:
        meta["means"]["shape"] = [count, 3]
        low, high = min(logits, default=0), max(logits, default=0)
        opacity = [round((v - low) / ((high - low) or 1) * 255) for v in logits]
        meta["scales"] = {"shape": [count, 3], "mins": [scales[0]] * 3, "maxs": [scales[255]] * 3}
        ends = [[colors[0]] * 3 + [low], [colors[255]] * 3 + [high]]
        meta["sh0"] = {"shape": [count, 1, 4], "mins": ends[0], "maxs": ends[1]}
        meta["quats"] |= {"shape": [count, 4], "encoding": "quaternion_packed"}
        colors4 = colors
    meta["scales"]["files"] = [plane("scales", [[nearest(v, scales) for v in r] for r in splats.scales.tolist()], 3)]
    pixels = [[*(nearest(v, colors4) for v in r), o] for r, o in zip(splats.sh0.tolist(), opacity, strict=True)]
    meta["sh0"]["files"] = [plane("sh0", pixels, 4)]
    if k:
        meta["shN"] = _rest(splats, rest, files, plane, names, version)
    files["meta.json"] = json.dumps(meta).encode()
    return files


def _rest(splats, codebook, files, plane, names, version):
    """Return the metadata of the SH codebook; every Gaussian has an entry of its own, in the reverse order."""
    count, k = len(splats), splats.shN.shape[1]
    rows = -(-count // 64) or 1
    image = np.zeros((rows, 64 * k, 3), np.uint8)
    for i in range(count):
        entry = count - 1 - i
        for j in range(k):
            for c in range(3):
                image[entry // 64, entry % 64 * k + j, c] = nearest(float(splats.shN[i, j, c]), codebook)
    files[names("shN_centroids.webp")] = webp(image.reshape(-1, 3), 64 * k, rows, 3)
    labels = [[(count - 1 - i) % 256, (count - 1 - i) // 256, 0] for i in range(count)]
    both = [names("shN_centroids.webp"), plane("shN_labels", labels, 3)]
    if version == 2:
        return {"count": max(count, 1), "bands": BANDS[k], "codebook": codebook, "files": both}
    return {"shape": [count, 3 * k], "mins": codebook[0], "maxs": codebook[255], "files": both}


def zip_of(files, method=zipfile.ZIP_STORED, *, folder="", comment=b"", streamed=False):
    """Return a zip of files by name, or of (name, bytes) pairs; ``streamed``: with the sizes after the data."""
    buffer = io.BytesIO()
    if streamed:
        buffer.seekable = lambda: False
    with zipfile.ZipFile(buffer, "w", method) as archive:
        for name, data in files.items() if isinstance(files, dict) else files:
            archive.writestr(folder + name, data)
        archive.comment = comment
    return buffer.getvalue()


def write_folder(files, folder):
    for name, data in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)
    return folder


def sog_folder(scene, name):
    """Return the files of a container in a folder, and its file in a manifest."""
    return {f"{name}/{key}": data for key, data in sog_files(scene).items()}, f"{name}/meta.json"


def streamed_files(levels, *, environment=None, container=sog_folder, manifest="lod-meta.json"):
    """Return the files of a streamed scene: per level a list of scenes, one container each, which has two leaves.

    ``container`` returns the files of a scene under a name, and the file that the manifest names.
    """
    files, names, leaves = {}, [], {}
    for level, scenes in enumerate(levels):
        for number, scene in enumerate(scenes):
            more, name = container(scene, f"{level}_{number}")
            files |= more
            half = len(scene) // 2
            for part, (offset, count) in enumerate(((half, len(scene) - half), (0, half))):
                lods = leaves.setdefault((number, part), {})
                lods[str(level)] = {"file": len(names), "offset": offset, "count": count}
            names.append(name)
    bound = {"min": [0, 0, 0], "max": [1, 1, 1]}
    children = [{"bound": bound, "lods": lods} for lods in leaves.values()]
    meta = {"version": 1, "lodLevels": len(levels), "filenames": names, "tree": {"bound": bound, "children": children}}
    if environment is not None:
        more, meta["environment"] = container(environment, "env")
        files |= more
    return {manifest: json.dumps(meta).encode(), **files}


def read_files(files):
    """Read a container of version 2, number by number; return its arrays by name of the attribute."""
    meta = json.loads(files["meta.json"])

    def plane(name, mode):
        image = Image.open(io.BytesIO(files[name])).convert(mode)
        return [image.getpixel((x, y)) for y in range(image.height) for x in range(image.width)]

    def decode_means(low, high):
        ends = list(zip(meta["means"]["mins"], meta["means"]["maxs"], strict=True))
        logs = [a + (b - a) * (less + 256 * more) / 65535 for less, more, (a, b) in zip(low, high, ends, strict=True)]
        return [math.copysign(math.expm1(abs(v)), v) for v in logs]

    def decode_quat(pixel):
        small = [(v / 255 - 0.5) * math.sqrt(2) for v in pixel[:3]]
        missing = math.sqrt(max(0, 1 - sum(v * v for v in small)))
        return [*small[: pixel[3] - 252], missing, *small[pixel[3] - 252 :]]

    count = meta["count"]
    low, high = (plane(name, "RGB") for name in meta["means"]["files"])
    colors = plane(meta["sh0"]["files"][0], "RGBA")[:count]
    scales = plane(meta["scales"]["files"][0], "RGB")[:count]
    alphas = [min(max(p[3] / 255, 1e-6), 1 - 1e-6) for p in colors]
    return {
        "means": [decode_means(*pair) for pair in list(zip(low, high, strict=True))[:count]],
        "quats": [decode_quat(p) for p in plane(meta["quats"]["files"][0], "RGBA")[:count]],
        "scales": [[meta["scales"]["codebook"][v] for v in p] for p in scales],
        "opacities": [math.log(a / (1 - a)) for a in alphas],
        "sh0": [[meta["sh0"]["codebook"][v] for v in p[:3]] for p in colors],
        "shN": _read_rest(meta, plane, count),
    }


def _read_rest(meta, plane, count):
    if "shN" not in meta:
        return np.zeros((count, 0, 3))
    k = (0, 3, 8, 15)[meta["shN"]["bands"]]
    centroids, labels = meta["shN"]["files"]
    entries, codebook = plane(centroids, "RGB"), meta["shN"]["codebook"]
    numbers = [p[0] + 256 * p[1] for p in plane(labels, "RGB")[:count]]
    assert max(numbers) < meta["shN"]["count"]
    starts = [n // 64 * 64 * k + n % 64 * k for n in numbers]
    return np.array([[[codebook[v] for v in entries[start + j]] for j in range(k)] for start in starts])
