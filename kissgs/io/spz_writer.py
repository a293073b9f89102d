"""Writing of ``.spz``: version 3, one gzip member without extension records, which the most readers take."""

from __future__ import annotations

import zlib
from collections.abc import Callable

import numpy as np

from kissgs.core.array_types import UInt8
from kissgs.core.errors import UnsupportedError
from kissgs.core.progress import Progress, silent
from kissgs.core.splats import Splats
from kissgs.io import spz_values
from kissgs.io.activations import steps
from kissgs.io.codes import note_clamped, opacities_of, to_bytes
from kissgs.io.frames import Signs, axis_signs, quat_signs, sh_signs
from kissgs.io.scene_file import BinaryWriter
from kissgs.io.spz import DEFAULT_FRAME, PLY_FRAME, header_bytes

_GZIP = 16 + zlib.MAX_WBITS

_Encode = Callable[[slice], UInt8[np.ndarray, "B width"]]


def write_spz(
    file: BinaryWriter, splats: Splats, *, raw_axes: bool = False, progress: Progress = silent
) -> tuple[str, ...]:
    """Write a clean scene; return what the format cannot hold, one phrase each.

    Args:
        file: The stream; it is not flushed or closed, and its OSErrors are not caught.
        splats: The scene, cleaned.
        raw_axes: Store the axes of a ``.ply`` instead of the format's own (x right, y up, z back).
        progress: Receives events of stage ``write``.

    Raises:
        UnsupportedError: the scene has no Gaussians, which readers of the format refuse.
    """
    count = len(splats)
    if not count:
        raise UnsupportedError("a scene without Gaussians cannot be written as .spz; write it as .ply")
    reach = float(np.abs(splats.means).max())
    bits = spz_values.fractional_bits_for(reach)
    encoders = _encoders(splats, bits, axis_signs(PLY_FRAME if raw_axes else DEFAULT_FRAME))
    packer = zlib.compressobj(wbits=_GZIP)  # writes no time into the file
    file.write(packer.compress(header_bytes(count, splats.sh_degree, bits, antialiased=splats.antialiased)))
    for done, encode in enumerate(encoders, 1):
        for part in steps(count):
            file.write(packer.compress(encode(part).tobytes()))
        progress("write", done / len(encoders))
    file.write(packer.flush())
    return _notes(splats, reach, bits)


def _encoders(splats: Splats, bits: int, signs: Signs) -> list[_Encode]:
    """Return the encoder of each stream, in the order of the file."""
    of_axes = np.array(signs, np.float32)
    of_quats = np.array(quat_signs(signs), np.float32)
    of_sh = sh_signs(signs, splats.shN.shape[1])[:, None]
    encoders: list[_Encode] = [
        lambda part: spz_values.encode_positions(splats.means[part] * of_axes, bits),
        lambda part: to_bytes(255 * opacities_of(splats.opacities[part]))[:, None],
        lambda part: spz_values.encode_colors(splats.sh0[part]),
        lambda part: spz_values.encode_scales(splats.scales[part]),
        lambda part: spz_values.encode_smallest_three(splats.quats[part] * of_quats),
    ]
    if splats.sh_degree:
        encoders.append(lambda part: spz_values.encode_sh(splats.shN[part] * of_sh))
    return encoders


def _notes(splats: Splats, reach: float, bits: int) -> tuple[str, ...]:
    """Return what is lost beyond the steps that the format always has."""
    notes: list[str] = []
    if bits < 12:
        notes.append(f"positions have steps of {2.0**-bits:g}, because the scene reaches {reach:,.0f} from the origin")
    limit = (1 << 23) - 1
    note_clamped(notes, "positions", splats.means, -limit - 1, limit + 0.5, f"±{limit:,}")
    note_clamped(notes, "scales", splats.scales, -10 - 1 / 32, 5.9375 + 1 / 32, "e^-10 to e^5.94")
    edge = (0.5 + 0.5 / 255) / 0.15
    note_clamped(notes, "colours", splats.sh0, -edge, edge, "coefficients of ±3.33")
    note_clamped(notes, "view-dependent colours", splats.shN, -1 - 1 / 32, 1 + 1 / 32, "coefficients of ±1")
    return tuple(notes)
