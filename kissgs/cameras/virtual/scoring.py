"""View scores: how useful a camera is, from a thumbnail of what it sees."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from kissgs.cameras.views import black
from kissgs.cameras.virtual.scene_bounds import SceneBounds, weighted_quantile
from kissgs.core.array_types import Float64, Int
from kissgs.core.progress import Progress
from kissgs.core.splats import SH_C0, Splats
from kissgs.core.threads import Workers
from kissgs.rendering.camera import Camera
from kissgs.rendering.cpu.frame import draw

PROXY_GAUSSIANS = 30_000
"""Largest number of Gaussians in the proxy scene that thumbnails show."""

OPAQUE = 0.01
"""Transmittance at which the list of a thumbnail's pixel ends: what is behind does not change its statistics."""

TOO_NEAR = 0.35
"""Depth in radii of the scene; anything nearer to the camera counts as an obstruction."""

CENTRE_SCALE = 30.0
"""Factor by which the mark of central Gaussians is scaled, so that it uses half the range of a colour channel."""


@dataclass(frozen=True, slots=True)
class ViewStats:
    """Statistics of a thumbnail.

    Attributes:
        alpha: mean alpha, 0 to 1.
        log_size: median logarithm of the largest scale of the Gaussians, world units. Parts that no photograph shows
            have large Gaussians.
        log_angle: median logarithm of the angle that these scales subtend, radians.
        near: mean alpha of what is nearer than :data:`TOO_NEAR`, 0 to 1.
        centre: mean alpha of the central Gaussians, those within two radii of the centre, 0 to 1.
    """

    alpha: float
    log_size: float
    log_angle: float
    near: float
    centre: float


class ViewScorer:
    """Renders thumbnails of a proxy scene and measures their statistics.

    Attributes:
        bounds: bounds of the part of the scene that views should show.
    """

    def __init__(self, proxy: Splats, bounds: SceneBounds, pool: Workers, progress: Progress) -> None:
        """Store the arguments; nothing is rendered.

        Args:
            proxy: scene to render, from :func:`proxy_scene`.
            bounds: bounds of the part of the scene that views should show.
            pool: threads to render with.
            progress: receives the stage ``"cameras"``.
        """
        self.bounds = bounds
        self._proxy, self._pool, self._progress = proxy, pool, progress
        self._log_sizes = proxy.scales.max(axis=1)
        self._central = np.linalg.norm(proxy.means - bounds.centre, axis=1) < 2 * bounds.radius
        self._measured = 0

    def measure(self, cameras: list[Camera]) -> list[ViewStats]:
        """Render a thumbnail from each camera, at the camera's size, and return its statistics."""

        def report(fraction: float) -> None:
            measured = self._measured + fraction * len(cameras)
            self._progress("cameras", measured / (measured + 300))  # the number of further cameras is unknown

        stats = self._pool.map(self._stats, cameras, report)
        self._measured += len(cameras)
        return stats

    def _stats(self, camera: Camera) -> ViewStats:
        """Render log size, log depth and centrality as the three colours, so that blending averages what is visible."""
        proxy = self._proxy
        log_depth = np.log(np.maximum(proxy.means @ camera.viewmat[2, :3] + camera.viewmat[2, 3], 1e-12))
        values = self._log_sizes, log_depth, CENTRE_SCALE * self._central
        colours = np.stack([_to_sh0(value) for value in values], axis=1)
        coloured = replace(proxy, sh0=colours.astype(np.float32), shN=np.empty((len(proxy), 0, 3), np.float32))
        with Workers(1) as single:  # cameras are already rendered in parallel
            frame = draw(coloured, camera, black(), single, OPAQUE)
        alpha = 1 - frame.transmittance.astype(np.float64)
        size, depth, centre = (_from_colour(frame.image[:, :, c] / np.maximum(alpha, 1e-6)) for c in range(3))
        near = (np.exp(depth) < TOO_NEAR * self.bounds.radius) * alpha
        return ViewStats(
            alpha=float(alpha.mean()),
            log_size=weighted_quantile(size.ravel(), alpha.ravel()),
            log_angle=weighted_quantile((size - depth).ravel(), alpha.ravel()),
            near=float(near.mean()),
            centre=float((centre / CENTRE_SCALE * alpha).mean()),
        )


def _to_sh0(logarithm: np.ndarray) -> np.ndarray:
    """Return the SH coefficient of a colour from 0 to 1 that stands for logarithms from -30 to 30."""
    return (np.clip(logarithm / 60 + 0.5, 0, 1) - 0.5) / SH_C0


def _from_colour(colour: np.ndarray) -> np.ndarray:
    """Return the logarithm that a colour from 0 to 1 stands for."""
    return (colour - 0.5) * 60


def proxy_scene(splats: Splats, max_count: int = PROXY_GAUSSIANS, among: Int[np.ndarray, " m"] | None = None) -> Splats:
    """Return at most ``max_count`` evenly selected Gaussians, without SH rest, enlarged to cover the same area.

    Args:
        splats: the scene.
        max_count: largest number of Gaussians.
        among: indices of the Gaussians to select from; by default, all.
    """
    count = len(splats) if among is None else len(among)
    step = max(1, -(-count // max_count))
    chosen = slice(None, None, step) if among is None else among[::step]
    return replace(
        splats,
        means=np.ascontiguousarray(splats.means[chosen]),
        quats=np.ascontiguousarray(splats.quats[chosen]),
        scales=splats.scales[chosen] + np.float32(np.log(step) / 2),
        opacities=np.ascontiguousarray(splats.opacities[chosen]),
        sh0=np.ascontiguousarray(splats.sh0[chosen]),
        shN=np.empty((-(-count // step), 0, 3), np.float32),
    )


def view_scores(stats: list[ViewStats], *, fills_image: bool = True) -> Float64[np.ndarray, " n"]:
    """Return the view score of each camera, ``(n,)`` float64, at most 1.

    1 is a sharp image of the scene's centre, without holes and with nothing right in front of the camera. Size and
    angle of Gaussians are compared with the best tenth of the views that show enough.

    Args:
        stats: statistics of all cameras to compare, at least one.
        fills_image: whether the scene should fill the image; if not, an object stands alone, and only an image that is
            much emptier than the others is a fault.
    """
    names = ("alpha", "log_size", "log_angle", "near", "centre")
    alpha, log_size, log_angle, near, centre = (np.array([getattr(view, name) for view in stats]) for name in names)
    enough = alpha >= 0.5 * alpha.max()
    excess_size, excess_angle = (
        np.maximum(value - np.quantile(value[enough], 0.1), 0) for value in (log_size, log_angle)
    )
    holes = 2 * (1 - alpha) if fills_image else np.maximum(0.5 - alpha / max(alpha.max(), 1e-9), 0)
    off_centre = np.maximum(1 - centre / 0.25, 0) if fills_image else np.zeros(len(stats))
    return np.asarray(1 - holes - 0.4 * excess_size - 0.35 * excess_angle - near - 0.5 * off_centre)
