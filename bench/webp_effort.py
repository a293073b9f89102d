"""Bytes and processor seconds of libwebp's efforts for the images of containers.

python bench/webp_effort.py fast.zip balanced.zip
"""

from __future__ import annotations

import time
from pathlib import Path

from bench.common import head, parser_of, row, run
from kissgs.io.containers import open_source
from kissgs.io.images import decode_plane, encode_plane, probe_webp

EFFORTS = ((25, 0), (25, 1), (25, 4), (50, 1), (50, 2), (75, 2), (75, 4))
"""Quality and method; (50, 2) is that of the preset fast, (75, 4) that of balanced."""


def main() -> None:
    """Encode every image of every container with every effort."""
    parser = parser_of(__doc__)
    parser.add_argument("containers", nargs="+", type=Path)
    containers = parser.parse_args().containers
    head("container", "image", "megapixels", *(f"{quality}/{method}" for quality, method in EFFORTS))
    for path in containers:
        with open_source(path) as files:
            images = {name: files.read(name, 1 << 30) for name in sorted(files.names()) if name.endswith(".webp")}
        total = [[0.0, 0.0] for _ in EFFORTS]
        for name, data in images.items():
            width, height = probe_webp(data, name)
            image = decode_plane(data, name, width=width, height=height, channels=4).reshape(height, width, 4)
            if (image[:, :, 3] == 255).all():
                image = image[:, :, :3].copy()
            cells = []
            for (quality, method), sums in zip(EFFORTS, total, strict=True):
                start = time.process_time()
                size, seconds = len(encode_plane(image, quality=quality, method=method)), time.process_time() - start
                sums[0], sums[1] = sums[0] + size, sums[1] + seconds
                cells.append(f"{size:,}, {seconds:.2f} s")
            row(path.stem, name, f"{width * height / 1e6:.1f}", *cells)
        row(path.stem, "all", "", *(f"{size:,.0f}, {seconds:.1f} s" for size, seconds in total))


if __name__ == "__main__":
    run(main)
