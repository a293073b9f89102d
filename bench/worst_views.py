"""Compare presets with ``fast`` in random views of scenes of which parts are easily overlooked.

    python bench/worst_views.py 11

Scenes and cameras are those of ``tests/helpers/whole_scenes.py``, 128 views of each scene, with three backgrounds. A
preset falls short in an image whose PSNR is below 38 dB and more than 3 dB below that of ``fast``. Takes ten minutes.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from helpers.whole_scenes import SCENES, cameras, psnrs

from bench.common import parser_of, run, write
from kissgs import Settings, clean, compress, decompress

LIMITS = {"balanced": (38, 3)}
"""PSNR that is always enough, and largest loss against ``fast``, decibels."""


def main() -> None:
    """Print one line for each scene and preset, and the totals."""
    parser = parser_of(__doc__)
    parser.add_argument("seed", nargs="?", type=int, default=11)
    seed = parser.parse_args().seed
    totals = dict.fromkeys(LIMITS, (0, 0))
    for name, make in SCENES.items():
        scene = clean(make())[0]
        views = [camera for kind in cameras(scene, seed=seed).values() for camera in kind]
        fast_zip = compress(scene, settings=Settings.from_preset("fast")).to_zip()
        fast = psnrs(scene, decompress(fast_zip), views)
        for preset, (enough, loss) in LIMITS.items():
            container = compress(scene, settings=Settings.from_preset(preset)).to_zip()
            found = psnrs(scene, decompress(container), views)
            margin = found - np.minimum(enough, fast - loss)
            short = margin < 0
            images, short_views = totals[preset]
            totals[preset] = images + int(short.sum()), short_views + int(short.any(axis=1).sum())
            write(
                f"{name}, {preset}: {len(container):,} bytes, {len(container) / len(fast_zip):.3f} of fast; "
                f"{short.sum()} of {short.size} images in {short.any(axis=1).sum()} views fall short; "
                f"smallest margin {margin.min():.1f} dB, worst view {found.min():.1f} dB",
            )
    for preset, (images, short_views) in totals.items():
        write(f"{preset}: {images} images in {short_views} views fall short")


if __name__ == "__main__":
    run(main)
