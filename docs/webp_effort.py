"""Print bytes and processor seconds of libwebp's efforts for the planes of containers, as a table of Markdown.

``python docs/webp_effort.py fast.zip balanced.zip``
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

from kissgs.io.packed_files import open_source
from kissgs.io.webp import decode_plane, encode_plane, probe_webp

EFFORTS = ((25, 0), (25, 1), (25, 4), (50, 1), (50, 2), (75, 2), (75, 4))
"""Quality and method; (50, 2) is that of the preset fast, (75, 4) that of balanced."""


def write(line: str) -> None:
    """Print a line at once."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def main() -> None:
    """Encode every plane of every container with every effort; the first column of figures is megapixels."""
    names = [f"{quality}/{method}" for quality, method in EFFORTS]
    write(f"| container | plane | megapixels | {' | '.join(names)} |")
    write(f"|---|---|---|{'---|' * len(names)}")
    for path in map(Path, sys.argv[1:]):
        with open_source(path) as files:
            planes = {name: files.read(name, 1 << 30) for name in sorted(files.names()) if name.endswith(".webp")}
        total = [[0.0, 0.0] for _ in EFFORTS]
        for name, data in planes.items():
            width, height = probe_webp(data, name)
            image = decode_plane(data, name, width=width, height=height, channels=4).reshape(height, width, 4)
            if (image[:, :, 3] == 255).all():
                image = image[:, :, :3].copy()
            found = []
            for effort, sums in zip(EFFORTS, total, strict=True):
                start = time.process_time()
                size = len(encode_plane(image, quality=effort[0], method=effort[1]))
                seconds = time.process_time() - start
                sums[0], sums[1] = sums[0] + size, sums[1] + seconds
                found.append(f"{size:,}, {seconds:.2f} s")
            write(f"| {path.stem} | {name} | {width * height / 1e6:.1f} | {' | '.join(found)} |")
        write(f"| {path.stem} | all | | {' | '.join(f'{size:,.0f}, {seconds:.1f} s' for size, seconds in total)} |")


if __name__ == "__main__":
    main()
