"""``Plane``: what training needs of a field's levels, even or of a table; and the planes of an encoding plan."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from torch import Tensor

from kissgs.core.array_types import Float32, Float64, Int
from kissgs.core.splats import SH_REST_COUNTS
from kissgs.finetuning.even_plane import EvenPlane
from kissgs.finetuning.table_plane import TablePlane, ValueTable
from kissgs.planning import smallest_three
from kissgs.planning.container_model import ByteTables
from kissgs.planning.encoding_plan import EncodingPlan
from kissgs.planning.quantize import MEANS_TOP, Quantized
from kissgs.planning.rdo_quantize import CAPTURED
from kissgs.planning.sh_codebook import COEFFICIENTS
from kissgs.planning.value_table import SIZE
from kissgs.rendering.rasterizer import Device

FIELDS = ("means", "opacities", "scales", "quaternions", "f_dc", "f_rest_centroids")
"""Trained fields of an encoding plan."""

TABLES = ("scales", "f_dc", "f_rest_centroids")
"""Fields whose tables are trained, in a container with tables."""


class Plane(Protocol):
    """One field: maps latents, ``(R, C)`` float32, to levels to values."""

    @property
    def field(self) -> Quantized:
        """Levels of the plan, ``(R, C)``; one row per Gaussian, or per entry of the codebook."""

    @property
    def base_multiples(self) -> Float64[Tensor, "R C"]:
        """Number of each level of the plan among those that its row may use."""

    @property
    def min_latent(self) -> Float32[Tensor, "R C"]:
        """Smallest latent whose level the row may use; 0 for frozen levels."""

    @property
    def max_latent(self) -> Float32[Tensor, "R C"]:
        """Largest latent whose level the row may use; 0 for frozen levels."""

    def levels(self, latents: Float32[Tensor, "R C"]) -> Float64[Tensor, "R C"]:
        """Return levels, whole numbers; their gradient ignores the rounding."""

    def values(self, latents: Float32[Tensor, "R C"], table: Tensor | None = None) -> Float64[Tensor, "R C"]:
        """Return the decoded values of the levels, differentiable; ``table`` holds the values of a trained table."""

    def units(self, latents: Float32[Tensor, "R C"], table: Tensor | None = None) -> Float64[Tensor, "R C"]:
        """Return the change of each value per unit of its latent."""

    def quantized(self, latents: Float32[Tensor, "R C"], table: Tensor | None = None) -> Quantized:
        """Return the field with the levels of these latents and the values of that table."""


def planes_of(
    plan: EncodingPlan, sh_degree: int, tables: ByteTables | None, device: Device
) -> tuple[dict[str, Plane], dict[str, ValueTable]]:
    """Return the plane of each trained field, and the tables that are trained.

    Args:
        plan: the plan.
        sh_degree: that of the decoded scene.
        tables: tables of the container; None for even levels.
        device: device of the tensors.
    """
    filled = plan.grid.mask.nonzero()[0]
    fields = {name: field if name == "f_rest_centroids" else field.take(filled) for name, field in plan.fields.items()}
    if tables is None:
        return {name: _even(name, field, device) for name, field in fields.items()}, {}
    planes: dict[str, Plane] = {}
    trained: dict[str, ValueTable] = {}
    for name, field in fields.items():
        if name == "f_rest_centroids" and field.table is not None:
            planes[name] = _codebook(field, field.table, sh_degree, device)
        elif name in ("opacities", "quaternions", "scales", "f_dc"):
            planes[name] = _of_table(name, field, plan.classes.astype(np.int64), tables, device)
        elif name in FIELDS:
            planes[name] = _even(name, field, device, as_text=True)
        if name in TABLES and field.table is not None:
            trained[name] = ValueTable.of(
                field.table,
                device,
                freeze_zero=name == "f_rest_centroids",
                largest_gap=CAPTURED.get(name, CAPTURED["f_dc"]),
            )
    return planes, trained


def _even(name: str, field: Quantized, device: Device, *, as_text: bool = False) -> EvenPlane:
    return EvenPlane.of(field, device, freeze_top=name == "means" and field.top == MEANS_TOP, as_text=as_text)


def _codebook(field: Quantized, table: Float32[np.ndarray, " L"], sh_degree: int, device: Device) -> TablePlane:
    levels = np.arange(len(table))
    frozen = np.zeros(field.levels.shape, bool)
    frozen[:, np.arange(field.levels.shape[1]) % COEFFICIENTS >= SH_REST_COUNTS[sh_degree]] = True
    rows = np.zeros(len(frozen), np.int64)
    return TablePlane.of(field, [levels], rows, frozen, device, largest_gap=CAPTURED["f_dc"])


def _of_table(
    name: str, field: Quantized, classes: Int[np.ndarray, " M"], tables: ByteTables, device: Device
) -> TablePlane:
    usable = (0, SIZE - 1)
    if name == "opacities":  # those that renderers do not draw stay invisible
        usable = tables.first_drawn, tables.last_drawn
    frozen = (field.levels < usable[0]) | (field.levels > usable[1])
    lists = [np.unique(field.levels[classes == number]) for number in range(int(classes.max()) + 1)]
    fixed = {"opacities": tables.opacity_logits, "quaternions": smallest_three.TABLE}.get(name)
    return TablePlane.of(field, lists, classes, frozen, device, fixed=fixed, usable=usable, largest_gap=CAPTURED[name])
