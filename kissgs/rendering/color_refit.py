"""Base colours that make up for what everything else lost: least squares over the pictures of a scene.

A picture is linear in the colours. Once positions, shapes and gloss are what a decoder will find, the base colours with
which its pictures come nearest to the original's solve a linear system that no one needs to write down: a picture of a
change is the matrix times it, the gradient of a picture is the transposed matrix times one. So conjugate gradients
solve it, preconditioned by the diagonal, which is the sensitivity of colours. Few steps do: the first ones take away
what all Gaussians of a neighbourhood have in common, which is what the eye sees and what rounding would not.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from kissgs.core.array_types import Float32, Float64
from kissgs.core.progress import Progress, silent
from kissgs.core.splats import SH_C0, Splats
from kissgs.core.threads import Workers
from kissgs.rendering.sensitivity import WeightedCameras

DAMPING = 0.02
"""How much all are held to the colours that they begin from, in units of the diagonal's median."""

REACH = 0.5 / SH_C0
"""Largest change of a coefficient: half of a colour's range. Few pictures would let faint Gaussians go further, for
nothing that other pictures would thank them for."""

KEPT = 1 << 27
"""Pixels of the original's pictures that are kept; where there are more, they are drawn anew for each step."""

STEP = 0.1
"""Root mean square of the changes by which the matrix is probed: colours that are clamped at black are not linear."""


def refit_colors(
    decoded: Splats,
    original: Splats,
    watch: WeightedCameras,
    colors: Float32[np.ndarray, " M"],
    guessed: Float32[np.ndarray, " M"],
    *,
    steps: int,
    threads: int = 0,
    progress: Progress = silent,
) -> Float32[np.ndarray, "M 3"]:
    """Base colours of ``decoded`` with which it looks like ``original``.

    Args:
        decoded: finite; what a decoder will find, with colours to begin from.
        original: finite; what it should look like.
        watch: from where.
        colors: ``(M,)`` of the sensitivity of ``decoded``'s Gaussians, and
        guessed: ``(M,)``, by which they are held to the colours that they begin from.
        steps: of conjugate gradients; each costs a picture and a gradient per camera.
        threads: 0 means one per processor; the result does not depend on it.
        progress: receives the stage ``"refit"``.

    Returns:
        ``(M, 3)`` like ``sh0``.

    Raises:
        UnsupportedError: a picture would take too much memory.
    """
    from kissgs.rendering.cpu.frame import differentiate, draw

    if steps == 0 or not (colors > 0).any():
        return decoded.sh0
    diagonal = colors.astype(np.float64)[:, None] * SH_C0**2
    anchor = guessed.astype(np.float64)[:, None] * SH_C0**2 + DAMPING * float(np.median(diagonal[diagonal > 0]))
    diagonal = diagonal + DAMPING * np.median(diagonal[diagonal > 0])
    sweeps, total = 0, steps + 1

    def gradient(sh0: Float64[np.ndarray, "M 3"], pool: Workers) -> Float64[np.ndarray, "M 3"]:
        nonlocal sweeps
        pull = anchor * (decoded.sh0 - sh0)
        scene = replace(decoded, sh0=sh0.astype(np.float32))
        for done, (camera, weight) in enumerate(zip(watch.cameras, watch.per_pixel(), strict=True)):
            progress("refit", (sweeps + done / len(watch.cameras)) / total)
            frame = draw(scene, camera, watch.background, pool)
            target = targets[done] if targets else draw(original, camera, watch.background, pool).image
            missing = (target - frame.image) * np.float32(weight)
            pull += differentiate(frame, missing, np.zeros(missing.shape[:2], np.float32), pool).sh0
        sweeps += 1
        return pull

    with Workers(threads) as pool:
        few = sum(camera.width * camera.height for camera in watch.cameras) <= KEPT
        targets = [draw(original, camera, watch.background, pool).image for camera in watch.cameras] if few else []
        sh0 = decoded.sh0.astype(np.float64)
        rest = gradient(sh0, pool)
        search = rest / diagonal
        size = float((rest * search).sum())
        for _ in range(steps):
            scale = STEP / max(float(np.sqrt(np.mean(search**2))), 1e-30)
            image = (rest - gradient(sh0 + scale * search, pool)) / scale
            bend = float((search * image).sum())
            if not bend > 0 or not size > 0:
                break
            sh0 += (size / bend) * search
            rest = rest - (size / bend) * image
            ahead = rest / diagonal
            size, before = float((rest * ahead).sum()), size
            search = ahead + (size / before) * search
    progress("refit", 1.0)
    return np.clip(sh0, decoded.sh0 - REACH, decoded.sh0 + REACH).astype(np.float32)
