"""The backward pass of one image on the CPU, independent of the number of threads.

Only Gaussians that contribute to the image have gradients: of many Gaussians, most lie outside it, or behind others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from kissgs.core.array_types import Bool, Float32, Int32, Shaped
from kissgs.core.splats import SH_C0
from kissgs.core.threads import Workers
from kissgs.rendering.cpu import blending_backward, projection_backward, shading
from kissgs.rendering.cpu.frame import LIMITS, Frame
from kissgs.rendering.cpu.lists import Slots, each_part, even, even_tiles, number_slots, projection_constants


@dataclass(frozen=True, slots=True)
class Gradients:
    """Gradients of a loss by the stored parameters of the R Gaussians that have any; those of all others are 0.

    Attributes:
        gaussians: ``(R,)`` indices of these Gaussians, ascending.
        means, quats, scales, opacities, sh0, shN: gradients by the parameters of each, see :class:`kissgs.Splats`.
    """

    gaussians: Int32[np.ndarray, " R"]
    means: Float32[np.ndarray, "R 3"]
    quats: Float32[np.ndarray, "R 4"]
    scales: Float32[np.ndarray, "R 3"]
    opacities: Float32[np.ndarray, " R"]
    sh0: Float32[np.ndarray, "R 3"]
    shN: Float32[np.ndarray, "R K 3"]

    def add_to(self, name: str, total: Shaped[np.ndarray, "N ..."]) -> None:
        """Add the gradients by the attribute ``name`` to those of all Gaussians."""
        total[self.gaussians] += getattr(self, name)

    @classmethod
    def sum(cls, parts: Sequence[Gradients]) -> Gradients:
        """Return the sum of one or more gradients, added in order."""
        if len(parts) == 1:
            return parts[0]
        gaussians = np.unique(np.concatenate([part.gaussians for part in parts]))
        totals = []
        for field in fields(cls)[1:]:
            total = np.zeros((len(gaussians), *getattr(parts[0], field.name).shape[1:]), np.float32)
            for part in parts:
                total[np.searchsorted(gaussians, part.gaussians)] += getattr(part, field.name)
            totals.append(total)
        return cls(gaussians, *totals)


def differentiate(
    frame: Frame,
    v_image: Float32[np.ndarray, "H W 3"],
    v_alpha: Float32[np.ndarray, "H W"],
    pool: Workers,
) -> Gradients:
    """Return the gradients of a loss by the stored parameters.

    Args:
        frame: a rendered image.
        v_image: ``(H, W, 3)`` gradient of the loss by the image.
        v_alpha: ``(H, W)`` gradient of the loss by alpha.
        pool: threads; the result does not depend on their number.

    Raises:
        MemoryError: there is not enough memory.
    """
    splats, camera, footprints = frame.splats, frame.camera, frame.footprints
    v_slots, slots, any_gradient = differentiate_footprints(frame, v_image, v_alpha, pool)
    changed = slots.rows[any_gradient[slots.rows]]
    count = len(changed)
    found = Gradients(
        np.empty(count, np.int32),
        *(np.empty((count, *getattr(splats, field.name).shape[1:]), np.float32) for field in fields(Gradients)[1:]),
    )
    v_colors = np.empty((count, 3), np.float64)

    def project(first: int, last: int) -> None:
        projection_backward.project_backward(
            splats.means,
            splats.quats,
            splats.scales,
            splats.opacities,
            footprints.visible,
            changed,
            slots.first,
            v_slots,
            footprints.records,
            first,
            last,
            camera.viewmat,
            camera.K,
            camera.width,
            camera.height,
            projection_constants(splats, camera),
            found.gaussians,
            found.means,
            found.quats,
            found.scales,
            found.opacities,
            v_colors,
        )
        shading.shade_backward(
            splats.means,
            splats.shN,
            camera.position,
            found.gaussians,
            first,
            last,
            v_colors,
            found.means,
            found.sh0,
            found.shN,
        )

    each_part(project, even(count, pool), pool)
    return found


def differentiate_footprints(
    frame: Frame,
    v_image: Float32[np.ndarray, "H W 3"],
    v_alpha: Float32[np.ndarray, "H W"],
    pool: Workers,
) -> tuple[Float32[np.ndarray, "slots 9"], Slots, Bool[np.ndarray, " N"]]:
    """Return the gradients of a loss by each footprint in each tile, their slots, and the rows that have any.

    Arguments are those of :func:`differentiate`; the gradients are described at
    :func:`kissgs.rendering.cpu.blending_backward.blend_backward`.
    """
    lists, changed = frame.lists, np.zeros(len(frame.footprints.records), bool)
    slots = number_slots(frame.footprints, lists, 0, len(lists.starts) - 1)
    v_slots = np.empty((len(lists.members), 9), np.float32)
    v_slots.fill(0)  # members behind the end of all pixels get nothing

    def blend(first: int, last: int) -> None:
        blending_backward.blend_backward(
            frame.footprints.records,
            lists.members,
            lists.spans,
            slots.of,
            lists.starts,
            first,
            last,
            lists.columns,
            LIMITS,
            frame.background,
            frame.transmittance,
            frame.stops,
            v_image,
            v_alpha,
            v_slots,
            changed,
        )

    each_part(blend, even_tiles(lists, pool), pool)
    return v_slots, slots, changed


def add_color_gradients(
    frame: Frame, v_image: Float32[np.ndarray, "H W 3"], into: Float32[np.ndarray, "N 3"], pool: Workers
) -> None:
    """Add the gradients of a loss by ``sh0`` alone, given its gradient by the image, ``v_image``, to ``into``."""
    lists, visible, records = frame.lists, frame.footprints.visible, frame.footprints.records
    slots = number_slots(frame.footprints, lists, 0, len(lists.starts) - 1)
    v_slots = np.empty((len(lists.members), 3), np.float32)

    def blend(first: int, last: int) -> None:
        blending_backward.blend_colors_backward(
            records,
            lists.members,
            lists.spans,
            slots.of,
            lists.starts,
            first,
            last,
            lists.columns,
            LIMITS,
            frame.stops,
            v_image,
            v_slots,
        )

    each_part(blend, even_tiles(lists, pool), pool)

    def add(first: int, last: int) -> None:
        blending_backward.add_colors(v_slots, records, slots.rows, slots.first, visible, first, last, SH_C0, into)

    each_part(add, even(len(slots.rows), pool), pool)
