"""An encoding plan -> the files of a SOG container of version 2: seven lossless images at most, and ``meta.json``."""

from __future__ import annotations

import json
from functools import partial
from typing import Any

import numpy as np

from kissgs._version import __version__
from kissgs.core.array_types import UInt8
from kissgs.core.context import DEFAULT_CONTEXT, Context, blas_workers
from kissgs.core.errors import UnsupportedError
from kissgs.core.positions import recorded
from kissgs.core.splats import SH_REST_COUNTS
from kissgs.io.containers import META_NAME
from kissgs.io.conventions import OPACITY_OF_BYTE
from kissgs.io.images import compress_images
from kissgs.planning.planner import Encoded, EncodingPlan
from kissgs.planning.quantize import ByteTables, ContainerModel, Quantized
from kissgs.planning.sh_codebook import COEFFICIENTS
from kissgs.settings import EncodeSettings
from kissgs.sog import ENTRIES_PER_ROW, FIRST_TAG, MEANS, QUATS, SCALES, SH0, SHN

# Description of SOG 2 for the planner: its tables, and no mask for padding.

FIRST_DRAWN = 2  # smallest level of opacity that viewers draw: they leave out opacities of 1/255 and less
LAST_DRAWN = 254  # largest level to use: 255 is an opacity of 1, whose logit no decoder can give back

_LOGITS = OPACITY_OF_BYTE.astype(np.float64)
_TABLES = ByteTables(opacity_logits=_LOGITS, first_drawn=FIRST_DRAWN, last_drawn=LAST_DRAWN)
SOG = ContainerModel(tables=_TABLES, padding_last=True, entry_bits=130)


def write_files(plan: EncodingPlan, settings: EncodeSettings, context: Context = DEFAULT_CONTEXT) -> Encoded:
    """Make the files of a plan."""
    if not plan.grid.mask.any():
        raise UnsupportedError("a SOG file cannot hold a scene without visible Gaussians; write SOG-XT (.zip) instead")
    context.progress("images", 0.0)
    images = render_planes(plan)
    with blas_workers(context.threads) as pool:
        files = compress_images(images, settings, pool, partial(context.progress, "images"), codebook=SHN[0])
    return Encoded.of(plan, {META_NAME: metadata(plan, plan.scene.sh_degree), **files})


def render_planes(plan: EncodingPlan) -> dict[str, UInt8[np.ndarray, "_ _ _"]]:
    """Return the images of a plan, by file name; Gaussians are row-major, and the last one fills the last row."""
    fields, side, sh_degree = plan.fields, plan.grid.side, plan.scene.sh_degree
    rows = -(-int(plan.grid.mask.sum()) // side)

    def image(*channels: np.ndarray) -> UInt8[np.ndarray, "H W C"]:
        cells = np.concatenate([channel[: rows * side] for channel in channels], axis=1)
        return np.ascontiguousarray(cells.astype(np.uint8).reshape(rows, side, -1))

    means = fields["means"].levels
    images = {
        MEANS[0]: image(means & 255),
        MEANS[1]: image(means >> 8),
        QUATS: image(fields["quaternions"].levels, fields["omitted"].levels + np.uint8(FIRST_TAG)),
        SCALES: image(fields["scales"].levels),
        SH0: image(fields["f_dc"].levels, fields["opacities"].levels),
    }
    if sh_degree > 0:
        labels = plan.codebook.labels[plan.grid.cell_to_gaussian][:, None]
        images[SHN[0]] = codebook_image(plan.codebook.centroids, sh_degree)
        images[SHN[1]] = image(labels & 255, labels >> 8, labels * 0)
    return images


def codebook_image(centroids: Quantized, sh_degree: int) -> UInt8[np.ndarray, "rows columns 3"]:
    """Return the image of the SH codebook: 64 entries in a row, one pixel per coefficient; the last entry repeats."""
    coefficients = SH_REST_COUNTS[sh_degree]
    levels = centroids.levels.reshape(-1, 3, COEFFICIENTS)[:, :, :coefficients].transpose(0, 2, 1)
    rows = -(-len(levels) // ENTRIES_PER_ROW)
    full = levels[np.minimum(np.arange(rows * ENTRIES_PER_ROW), len(levels) - 1)]
    return np.ascontiguousarray(full.reshape(rows, ENTRIES_PER_ROW * coefficients, 3).astype(np.uint8))


def metadata(plan: EncodingPlan, sh_degree: int) -> bytes:
    """Return ``meta.json``; numbers have the digits that readers need, and tables 256 values."""
    fields = plan.fields
    document: dict[str, Any] = {
        "version": 2,
        **({"model": "antialiased"} if plan.scene.antialiased else {}),
        "asset": {"generator": f"kissgs {__version__}"},
        "count": int(plan.grid.mask.sum()),
        "means": {
            "mins": [float(str(value)) for value in fields["means"].low],
            "maxs": [float(str(value)) for value in fields["means"].high],
            "files": list(MEANS),
        },
        "scales": {"codebook": _table(fields["scales"]), "files": [SCALES]},
        "quats": {"files": [QUATS]},
        "sh0": {"codebook": _table(fields["f_dc"]), "files": [SH0]},
    }
    if sh_degree > 0:
        centroids = plan.codebook.centroids
        codebook = {"count": len(centroids.levels), "bands": sh_degree, "codebook": _table(centroids)}
        document["shN"] = {**codebook, "files": list(SHN)}
    if own := recorded(plan.scene.origin, plan.scene.first_view):
        document["kissgs"] = own
    return json.dumps(document, separators=(",", ":")).encode()


def _table(field: Quantized) -> list[float]:
    """Return 256 ascending values; the last is repeated."""
    values = [float(str(value)) for value in field.table[:, 0].astype(np.float32)]
    return values + values[-1:] * (256 - len(values))
