"""Virtual cameras that show a scene well: its bounds, candidates, their scores by thumbnails, and the choice."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from kissgs.cameras.views import UP, Vec3, View, Views, black, check_images, rotation_matrices
from kissgs.core.array_types import Float64, Int
from kissgs.core.context import DEFAULT_CONTEXT, Context, Progress, Workers, silent
from kissgs.core.splats import SH_C0, Splats
from kissgs.rendering.camera import Camera, look_at, pinhole
from kissgs.rendering.constants import NEAR
from kissgs.rendering.cpu.frame import draw

UP_AXES = (UP, np.array([0.0, 0.0, 1.0]))  # COLMAP's y points down, nerfstudio's z up; the first is the default


@dataclass(frozen=True, slots=True)
class SceneBounds:
    """Position, size and orientation of a scene's densest part."""

    centre: Vec3  # centre of the densest part, world units
    radius: float  # distance from the centre within which half of the opacity of that part lies, world units
    up: Vec3


def scene_bounds(splats: Splats, start: tuple[Vec3, float] | None = None) -> SceneBounds:
    """Estimate centre, radius and up direction of a scene; without any opacity, the unit sphere around the origin. A
    capture has most Gaussians where its photographs point. The centre is a mode of that density, by opacity, found by
    mean shift from the weighted median of the positions, or from the centre and radius ``start``."""
    means = splats.means.astype(np.float64)
    weights = opacity(splats)
    if not weights.sum() > 0:
        return SceneBounds(np.zeros(3), 1.0, UP_AXES[0])
    centre = np.array([weighted_median(axis, weights) for axis in means.T]) if start is None else start[0]
    distance = np.linalg.norm(means - centre, axis=1)
    gaussian_size = float(np.exp(np.median(splats.scales.max(axis=1)).astype(np.float64)))
    min_radius = max(2 * gaussian_size, 1e-5 * float(np.abs(centre).max()), 1e-9)  # float32 positions are no finer
    radius = max(weighted_median(distance, weights) if start is None else start[1], min_radius)
    for _ in range(30):
        kernel = weights * np.exp(-0.5 * (distance / radius) ** 2)
        new_centre = kernel @ means / kernel.sum()
        distance = np.linalg.norm(means - new_centre, axis=1)
        near = distance < 2.5 * radius
        new_radius = max(weighted_median(distance[near], weights[near]), min_radius) if near.any() else radius
        moved = np.linalg.norm(new_centre - centre)
        converged = moved < 0.01 * radius and abs(new_radius - radius) < 0.01 * radius
        centre, radius = new_centre, new_radius
        if converged:
            break
    return SceneBounds(centre, radius, _up(splats, weights * (distance < 3 * radius), means - centre))


def opacity(splats: Splats) -> Float64[np.ndarray, " N"]:
    """Return opacities after the sigmoid, 0 to 1."""
    return 1 / (1 + np.exp(-splats.opacities.astype(np.float64)))


def weighted_median(values: Float64[np.ndarray, " n"], weights: Float64[np.ndarray, " n"]) -> float:
    """Return the value at which half of the weight is reached; 0 without values."""
    return weighted_quantiles(values, weights, 0.5)[0]


def weighted_quantiles(
    values: Float64[np.ndarray, " n"], weights: Float64[np.ndarray, " n"], *quantiles: float
) -> list[float]:
    """Return the values at which these fractions of the weight are reached; 0 without values."""
    if not len(values):
        return [0.0] * len(quantiles)
    order = np.argsort(values, kind="stable")
    cumulative = np.cumsum(weights[order])
    places = np.searchsorted(cumulative, np.array(quantiles) * cumulative[-1])
    return [float(value) for value in values[order[np.minimum(places, len(values) - 1)]]]


def _up(splats: Splats, weights: Float64[np.ndarray, " N"], offsets: Float64[np.ndarray, "N 3"]) -> Vec3:
    """Return the up direction: the normal of the ground, or the axis that files use if there is no ground. The short
    axes of flat Gaussians are surface normals; most of them near one file axis select that axis. The sign follows from
    the skew of heights if there is ground: objects stand on it, so that density falls off upwards. Without ground,
    density tells nothing: a person has more Gaussians in the face than in the legs."""
    axis = UP_AXES[0]
    if not weights.any():
        return axis
    log_scales = np.sort(splats.scales.astype(np.float64), axis=1)
    area = np.exp(log_scales[:, 1] + log_scales[:, 2])
    flatness = np.clip(log_scales[:, 1] - log_scales[:, 0], 0, 1)
    flat_weights = flatness * np.minimum(area, np.quantile(area, 0.95)) * weights
    rotations = rotation_matrices(splats.quats.astype(np.float64))
    normals = rotations[np.arange(len(splats)), :, splats.scales.argmin(axis=1)]
    level = [float(flat_weights @ (np.abs(normals @ each) > np.cos(np.radians(15)))) for each in UP_AXES]
    if level[1] > 2 * level[0] + 0.1 * flat_weights.sum():
        axis = UP_AXES[1]
    axis = _ground_normal(axis, normals, flat_weights)
    heights = offsets @ axis
    mean = weights @ heights / weights.sum()
    deviation = np.sqrt(weights @ (heights - mean) ** 2 / weights.sum())
    skew = weights @ ((heights - mean) / max(deviation, 1e-30)) ** 3 / weights.sum()
    ground = flat_weights * (np.abs(normals @ axis) > np.cos(np.radians(15)))
    above = ground.sum() > 0.2 * flat_weights.sum() and ground @ heights > mean * ground.sum()
    return -axis if skew < -0.3 and above else axis


def _ground_normal(axis: Vec3, normals: Float64[np.ndarray, "N 3"], weights: Float64[np.ndarray, " N"]) -> Vec3:
    """Return the mean normal near ``axis``, in a cone that narrows; ``axis`` if less than 35 % have one within 30°."""
    for degrees, min_share in ((30, 0.35), (15, 0.0), (8, 0.0)):
        cosines = normals @ axis
        near = (np.abs(cosines) > np.cos(np.radians(degrees))) * weights
        if near.sum() <= min_share * weights.sum() or not near.any():
            return axis
        mean = (near * np.sign(cosines)) @ normals
        axis = mean / np.linalg.norm(mean)
    return axis


# View scores: how useful a camera is, from a thumbnail of what it sees.

PROXY_GAUSSIANS = 30_000  # largest number of Gaussians in the proxy scene that thumbnails show
OPAQUE = 0.01  # transmittance at which the list of a thumbnail's pixel ends
TOO_NEAR = 0.35  # depth in radii of the scene; anything nearer to the camera counts as an obstruction
CENTRE_SCALE = 30.0  # of the mark of central Gaussians, to use half the range of a colour channel


@dataclass(frozen=True, slots=True)
class ViewStats:
    """Statistics of a thumbnail."""

    alpha: float  # mean alpha, 0 to 1
    log_size: float  # median logarithm of the largest scale, world units; large where no photograph shows a part
    log_angle: float  # median logarithm of the angle that these scales subtend, radians
    near: float  # mean alpha of what is nearer than TOO_NEAR, 0 to 1
    centre: float  # mean alpha of the central Gaussians, those within two radii of the centre, 0 to 1


class ViewScorer:
    """Renders thumbnails of a proxy scene, and measures how they show the part of it within ``bounds``."""

    def __init__(self, proxy: Splats, bounds: SceneBounds, pool: Workers, progress: Progress) -> None:
        self.bounds = bounds
        self.proxy, self._pool, self._progress = proxy, pool, progress
        self._log_sizes = proxy.scales.max(axis=1)
        self._central = np.linalg.norm(proxy.means - bounds.centre, axis=1) < 2 * bounds.radius

    def measure(self, cameras: list[Camera]) -> list[ViewStats]:
        """Render a thumbnail from each camera, at the camera's size, and return its statistics."""
        # The number of further cameras is unknown, and so is the fraction that is done.
        return self._pool.map(self._stats, cameras, lambda fraction: self._progress("cameras", 0.0))

    def _stats(self, camera: Camera) -> ViewStats:
        """Render log size, log depth and centrality as the three colours, so that blending averages what is visible."""
        proxy = self.proxy
        log_depth = np.log(np.maximum(proxy.means @ camera.viewmat[2, :3] + camera.viewmat[2, 3], 1e-12))
        values = self._log_sizes, log_depth, CENTRE_SCALE * self._central  # colours from 0 to 1 stand for -30 to 30
        colours = np.stack([(np.clip(value / 60 + 0.5, 0, 1) - 0.5) / SH_C0 for value in values], axis=1)
        coloured = replace(proxy, sh0=colours.astype(np.float32), shN=np.empty((len(proxy), 0, 3), np.float32))
        with Workers(1) as single:  # cameras are already rendered in parallel
            frame = draw(coloured, camera, black(), single, OPAQUE)
        alpha = 1 - frame.transmittance.astype(np.float64)
        size, depth, centre = ((frame.image[:, :, c] / np.maximum(alpha, 1e-6) - 0.5) * 60 for c in range(3))
        near = (np.exp(depth) < TOO_NEAR * self.bounds.radius) * alpha
        return ViewStats(
            alpha=float(alpha.mean()),
            log_size=weighted_median(size.ravel(), alpha.ravel()),
            log_angle=weighted_median((size - depth).ravel(), alpha.ravel()),
            near=float(near.mean()),
            centre=float((centre / CENTRE_SCALE * alpha).mean()),
        )


def proxy_scene(splats: Splats, max_count: int = PROXY_GAUSSIANS, among: Int[np.ndarray, " m"] | None = None) -> Splats:
    """Return evenly selected Gaussians ``among`` some, or all, without SH rest, enlarged to cover the same area."""
    count = len(splats) if among is None else len(among)
    step = max(1, -(-count // max_count))
    chosen = slice(None, None, step) if among is None else among[::step]
    names = ("means", "quats", "opacities", "sh0")
    arrays: dict[str, Any] = {name: np.ascontiguousarray(getattr(splats, name)[chosen]) for name in names}
    scales = splats.scales[chosen] + np.float32(np.log(step) / 2)
    return replace(splats, **arrays, scales=scales, shN=np.empty((-(-count // step), 0, 3), np.float32))


def view_scores(stats: list[ViewStats], *, fills_image: bool = True) -> Float64[np.ndarray, " n"]:
    """Return the view score of each camera, at most 1. 1 is a sharp image of the scene's centre, without holes and with
    nothing right in front of the camera. Size and angle of Gaussians are compared with the best tenth of the views that
    show enough. The image of an object that stands alone need only not be much emptier than the others."""
    names = ("alpha", "log_size", "log_angle", "near", "centre")
    alpha, log_size, log_angle, near, centre = (np.array([getattr(view, name) for view in stats]) for name in names)
    enough = alpha >= 0.5 * alpha.max()
    excess_size, excess_angle = (np.maximum(each - np.quantile(each[enough], 0.1), 0) for each in (log_size, log_angle))
    holes = 2 * (1 - alpha) if fills_image else np.maximum(0.5 - alpha / max(alpha.max(), 1e-9), 0)
    off_centre = np.maximum(1 - centre / 0.25, 0) if fills_image else np.zeros(len(stats))
    return np.asarray(1 - holes - 0.4 * excess_size - 0.35 * excess_angle - near - 0.5 * off_centre)


FIELD_OF_VIEW = np.radians(60)  # angle of view along the longer side, radians; roughly that of a phone
AZIMUTHS = 16  # number of azimuths on each orbit
ORBIT_RADII = (0.7, 1.1, 1.7, 2.6)  # radii of the orbits, in radii of the scene
ORBIT_ELEVATIONS = (-5, 12, 35)  # elevations of the orbits as seen from the centre, degrees
OBJECT_ELEVATIONS = (-10, 12, 35, 60)  # elevations of the cameras around an object, degrees
INSIDE_DIRECTIONS = 8  # number of viewing directions from each position inside the scene
CLOSE_UP_INTERVAL = 4  # one in this many cameras around an object is at half the distance


def horizontal_axes(up: Vec3) -> tuple[Vec3, Vec3]:
    """Return two unit vectors, orthogonal to each other and to the unit vector ``up``."""
    first = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    first /= np.linalg.norm(first)
    return first, np.cross(up, first)


def direction_at(up: Vec3, elevation: float, azimuth: float) -> Vec3:
    """Return the unit vector at an elevation above the horizontal plane and an azimuth, radians."""
    east, north = horizontal_axes(up)
    horizontal = np.cos(azimuth) * east + np.sin(azimuth) * north
    return np.asarray(np.cos(elevation) * horizontal + np.sin(elevation) * up)


def directions(up: Vec3, elevations: tuple[float, ...], azimuths: int) -> Iterator[Vec3]:
    """Yield unit vectors at evenly spaced azimuths, for each elevation above the horizontal plane, degrees."""
    for elevation in np.radians(elevations):
        for azimuth in np.arange(azimuths) * (2 * np.pi / azimuths):
            yield direction_at(up, elevation, azimuth)


def orbit_cameras(bounds: SceneBounds, size: tuple[int, int]) -> Iterator[Camera]:
    """Yield cameras that look at the centre from all sides, nearest first."""
    width, height = size
    for radius in ORBIT_RADII:
        for direction in directions(bounds.up, ORBIT_ELEVATIONS, AZIMUTHS):
            position = bounds.centre + radius * bounds.radius * direction
            yield look_at(position, bounds.centre, bounds.up, fov=FIELD_OF_VIEW, width=width, height=height)


def inside_cameras(bounds: SceneBounds, size: tuple[int, int]) -> Iterator[Camera]:
    """Yield cameras near the centre, at each position :data:`INSIDE_DIRECTIONS` in succession."""
    width, height = size
    east, north = horizontal_axes(bounds.up)
    for rise in (0.0, 0.4):
        for right, ahead in ((0, 0), (0.5, 0), (-0.5, 0), (0, 0.5), (0, -0.5)):
            position = bounds.centre + bounds.radius * (rise * bounds.up + right * east + ahead * north)
            for direction in directions(bounds.up, (-6,), INSIDE_DIRECTIONS):
                yield look_at(position, position + direction, bounds.up, fov=FIELD_OF_VIEW, width=width, height=height)


def object_cameras(splats: Splats, bounds: SceneBounds, size: tuple[int, int]) -> Iterator[Camera]:
    """Yield cameras that frame an object; one in :data:`CLOSE_UP_INTERVAL` is at half the distance."""
    weights = opacity(splats)
    means = splats.means.astype(np.float64)
    width, height = size
    for number, direction in enumerate(directions(bounds.up, OBJECT_ELEVATIONS, AZIMUTHS)):
        camera = framing_camera(means, weights, bounds, direction, size)
        if number % CLOSE_UP_INTERVAL == CLOSE_UP_INTERVAL - 1:
            position = bounds.centre + 0.5 * (camera.position - bounds.centre)
            camera = look_at(position, bounds.centre, bounds.up, fov=FIELD_OF_VIEW, width=width, height=height)
        yield camera


def framing_camera(
    means: Float64[np.ndarray, "N 3"],
    weights: Float64[np.ndarray, " N"],
    bounds: SceneBounds,
    direction: Vec3,
    size: tuple[int, int],
) -> Camera:
    """Return a camera in ``direction`` that frames 98 % of the weight along each image axis, with a 15 % margin."""
    width, height = size
    target, half_extents = bounds.centre.copy(), []
    towards = look_at(target + direction, target, bounds.up, fov=FIELD_OF_VIEW, width=width, height=height)
    right, down, _ = towards.viewmat[:3, :3]
    for axis in (right, down, direction):
        along = (means - bounds.centre) @ axis
        low, high = weighted_quantiles(along, weights, 0.01, 0.99)
        target += 0.5 * (low + high) * axis
        half_extents.append(max(0.5 * (high - low), 0.5 * bounds.radius))
    slopes = np.array([width, height]) / (2 * towards.K[0, 0])  # tangents of half the angles of view
    distance = max(1.15 * float((np.array(half_extents[:2]) / slopes).max()), 2 * NEAR) + half_extents[2]
    position = target + distance * direction
    return look_at(position, target, bounds.up, fov=FIELD_OF_VIEW, width=width, height=height)


def reversed_camera(camera: Camera) -> Camera:
    """Return the camera at the same position that looks in the opposite direction."""
    viewmat = np.diag([-1.0, 1, -1, 1]) @ camera.viewmat
    return Camera(viewmat, camera.K, camera.width, camera.height)


# Which candidates suit depends on the kind of scene. Inside a room or under a sky, cameras must stay within what
# encloses them; before a background, the image should be full; an object that stands alone is framed from all sides.

THUMBNAIL_SIZE = 64  # longer side of a thumbnail, pixels
FULL_ALPHA = 0.85  # an image is full if its mean alpha is above this
SCORE_MARGIN = 0.3  # how much lower than the best a camera may score to be chosen
MAX_REFINEMENTS = 3  # largest number of times that cameras between good ones are added where good ones are few
NEIGHBOURS = 4  # number of the nearest good cameras towards each of which a camera is added

SceneKind = Literal["enclosed", "background", "object"]
"""A room or a scene under a sky, seen from inside; a scene before a background; an object that stands alone."""


@dataclass(frozen=True, slots=True, eq=False)
class ScoredCandidates:
    """Candidate cameras with what is needed to compare their views."""

    scorer: ViewScorer  # measures further views on the same scale
    kind: SceneKind
    cameras: list[Camera]  # one or more, with the size of thumbnails
    stats: list[ViewStats]
    outside_penalty: Float64[np.ndarray, " n"]  # 1 for cameras outside of what encloses the scene, else 0

    @property
    def bounds(self) -> SceneBounds:
        """Bounds of the scene, or of the region."""
        return self.scorer.bounds

    @property
    def scores(self) -> Float64[np.ndarray, " n"]:
        """View scores, at most 1."""
        return view_scores(self.stats, fills_image=self.kind != "object") - self.outside_penalty

    def good(self) -> Int[np.ndarray, " good"]:
        """Return the indices of the cameras that score at most :data:`SCORE_MARGIN` less than the best."""
        scores = self.scores
        return np.flatnonzero(scores >= scores.max() - SCORE_MARGIN)

    def scores_of(self, cameras: list[Camera]) -> Float64[np.ndarray, " more"]:
        """Return the view scores of other cameras, on the same scale."""
        penalty = _outside_penalty(cameras, self.scorer) if self.kind == "enclosed" else np.zeros(len(cameras))
        stats = [*self.stats, *self.scorer.measure(cameras)]
        return view_scores(stats, fills_image=self.kind != "object")[len(self.stats) :] - penalty

    def refined(self, count: int) -> ScoredCandidates:
        """Return the candidates with cameras between good ones added, until twice ``count`` are good, if possible."""
        candidates = self
        for _ in range(MAX_REFINEMENTS):
            if len(candidates.good()) >= 2 * count:
                break
            candidates = candidates._with_midpoints()
        return candidates

    def _with_midpoints(self) -> ScoredCandidates:
        """Return the candidates with one more half-way between each good camera and its nearest good neighbours."""
        good = self.good()
        positions, forward = normalized_poses([self.cameras[n] for n in good], self.bounds)
        pairs = set()
        for n in range(len(good)):
            nearest = np.argsort(pose_distances(positions, forward, n), kind="stable")[1 : NEIGHBOURS + 1]
            pairs |= {(min(n, int(other)), max(n, int(other))) for other in nearest}
        width, height = self.cameras[0].width, self.cameras[0].height
        added = []
        for one, other in sorted(pairs):
            position = 0.5 * (positions[one] + positions[other]) * self.bounds.radius
            target = position + forward[one] + forward[other]
            added.append(look_at(position, target, self.bounds.up, fov=FIELD_OF_VIEW, width=width, height=height))
        return ScoredCandidates(
            self.scorer,
            self.kind,
            [*self.cameras, *added],
            [*self.stats, *self.scorer.measure(added)],
            np.concatenate([self.outside_penalty, np.zeros(len(added))]),
        )


def score_candidates(splats: Splats, size: tuple[int, int], pool: Workers, progress: Progress) -> ScoredCandidates:
    """Return some hundred candidate cameras of a scene, with their view scores."""
    check_images(1, *size)
    proxy = proxy_scene(splats)
    bounds = scene_bounds(proxy)
    scale = THUMBNAIL_SIZE / max(size)
    thumbnail_size = max(1, round(size[0] * scale)), max(1, round(size[1] * scale))
    scorer = ViewScorer(proxy, bounds, pool, progress)
    inside, orbits = list(inside_cameras(bounds, thumbnail_size)), list(orbit_cameras(bounds, thumbnail_size))
    cameras = [*inside, *orbits]
    stats = scorer.measure(cameras)
    # Enclosed if images are full in all directions from three or more positions inside the scene.
    clear = np.reshape([view.alpha - view.near for view in stats[: len(inside)]], (-1, INSIDE_DIRECTIONS)).mean(axis=1)
    if (clear > FULL_ALPHA).sum() >= 3:
        return ScoredCandidates(scorer, "enclosed", cameras, stats, _outside_penalty(cameras, scorer))
    if _has_background(stats[len(inside) :], thumbnail_size, scorer):
        return ScoredCandidates(scorer, "background", cameras, stats, np.zeros(len(cameras)))
    cameras = list(object_cameras(proxy, bounds, thumbnail_size))
    return ScoredCandidates(scorer, "object", cameras, scorer.measure(cameras), np.zeros(len(cameras)))


def _has_background(orbits: list[ViewStats], size: tuple[int, int], scorer: ViewScorer) -> bool:
    """Whether a tenth of the images from the largest orbit are full; an object may fill portrait images alone."""

    def fills(stats: list[ViewStats]) -> bool:
        return bool(np.quantile([view.alpha for view in stats], 0.9) > FULL_ALPHA)

    outermost = len(orbits) // len(ORBIT_RADII)
    if not fills(orbits[-outermost:]) or size[0] >= size[1]:
        return fills(orbits[-outermost:])
    landscape = list(orbit_cameras(scorer.bounds, (size[1], size[0])))
    return fills(scorer.measure(landscape[-outermost:]))


def _outside_penalty(cameras: list[Camera], scorer: ViewScorer) -> Float64[np.ndarray, " n"]:
    """Return 1 for each camera that sees a gap when it is turned around: it is outside the enclosing scene; else 0."""
    behind = scorer.measure([reversed_camera(camera) for camera in cameras])
    return np.array([float(view.alpha < FULL_ALPHA) for view in behind])


def normalized_poses(
    cameras: list[Camera], bounds: SceneBounds
) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3"]]:
    """Return positions in radii of the scene and unit viewing directions of cameras."""
    positions = np.array([camera.position for camera in cameras]) / bounds.radius
    return positions, np.array([camera.viewmat[2, :3] for camera in cameras])


def pose_distances(
    positions: Float64[np.ndarray, "n 3"], forward: Float64[np.ndarray, "n 3"], index: int
) -> Float64[np.ndarray, " n"]:
    """Return how far each of :func:`normalized_poses` is from one of them: radii plus change of direction."""
    to_position = np.linalg.norm(positions - positions[index], axis=1)
    return np.asarray(to_position + np.linalg.norm(forward - forward[index], axis=1))


# Candidates are scored by thumbnails. A trained scene is sharp from where it was photographed and dissolves elsewhere,
# so the good ones lie on the side that was captured. Among these, cameras far from each other are chosen.

HOLD_OUT = 8  # one in this many virtual views is held out, starting with the first
OVERVIEW_BONUS = 0.5  # of being e times as far from the centre, where one view or orbit stands for the scene
MIN_OVERVIEW_RADII = 0.5  # distance in radii of the scene below which the overview bonus does not fall further


def virtual_views(
    splats: Splats,
    *,
    width: int = 640,
    height: int = 480,
    count: int = 32,
    threads: int = 0,
    progress: Progress = silent,
) -> Views:
    """Return views around or inside a scene; every 8th in the order of names is held out.

    The result is the same for any number of threads.

    Args:
        splats: the scene, finite (:func:`kissgs.clean`).
        width: of the images, pixels.
        height: of the images, pixels.
        count: number of views, 1 or more. A scene with fewer good candidates has some cameras several times.
        threads: number of threads; 0 means one per processor.
        progress: receives the stage ``"cameras"``.

    Raises:
        InvalidViewsError: ``count``, ``width`` or ``height`` is less than 1.
    """
    _, _, views = _select(splats, (width, height), count, Context(threads, progress=progress))
    return replace(views, origin=splats.origin)


def best_view(splats: Splats, context: Context = DEFAULT_CONTEXT, *, width: int, height: int) -> View:
    """Return the one of :func:`virtual_views` that represents the scene best, by view score and distance."""
    candidates, selected, views = _select(splats, (width, height), 32, context)
    bounds = candidates.bounds
    distances = [float(np.linalg.norm(candidates.cameras[n].position - bounds.centre)) for n in selected]
    scores = candidates.scores[selected] + [overview_bonus(distance / bounds.radius) for distance in distances]
    return views.all[int(scores.argmax())]


def overview_bonus(radii: float) -> float:
    """Return what a distance from the centre, in radii of the scene, adds to a view score where few views are shown."""
    return OVERVIEW_BONUS * float(np.log(max(radii, MIN_OVERVIEW_RADII)))


def select_diverse(candidates: ScoredCandidates, count: int) -> list[int]:
    """Return the indices of ``count`` good candidates that are far from each other, in order of azimuth. Starting with
    the best, each further one is the farthest from all that are selected, where distance counts less for lower scores.
    Of fewer than ``count``, some are returned repeatedly."""
    scores, good = candidates.scores, candidates.good()
    if len(good) < count:
        good = np.argsort(-scores, kind="stable")[:count]
    positions, forward = normalized_poses([candidates.cameras[n] for n in good], candidates.bounds)
    selected = [int(scores[good].argmax())]
    nearest_selected = np.full(len(good), np.inf)
    while len(selected) < min(count, len(good)):
        nearest_selected = np.minimum(nearest_selected, pose_distances(positions, forward, selected[-1]))
        selected.append(int((nearest_selected * (1 + scores[good] - scores.max())).argmax()))
    east, north = horizontal_axes(candidates.bounds.up)
    azimuths = [float(np.arctan2(forward[n] @ north, forward[n] @ east)) for n in selected]
    ordered = [int(good[selected[n]]) for n in np.argsort(azimuths, kind="stable")]
    return [ordered[n % len(ordered)] for n in range(count)]


def with_size(cameras: list[Camera], width: int, height: int) -> list[Camera]:
    """Return cameras at the same poses with images of ``width`` x ``height`` pixels, and the default field of view."""
    K = pinhole(FIELD_OF_VIEW, width, height)
    return [Camera(camera.viewmat, K, width, height) for camera in cameras]


def split_views(cameras: list[Camera]) -> Views:
    """Return numbered views over black, at least one; every 8th is held out, unless it is the only one."""
    digits = len(str(len(cameras) - 1))
    views = [View(f"virtual_{n:0{digits}}", camera) for n, camera in enumerate(cameras)]
    test = tuple(view for n, view in enumerate(views) if n % HOLD_OUT == 0 and len(views) > 1)
    train = tuple(view for view in views if view not in test)
    return Views(train, test, black(), f"{len(cameras)} virtual cameras")


def _select(
    splats: Splats, size: tuple[int, int], count: int, context: Context
) -> tuple[ScoredCandidates, list[int], Views]:
    """Return all scored candidates of a scene, the indices of the selected ones, and their views."""
    check_images(count, *size)
    with Workers(context.threads) as pool:
        candidates = score_candidates(splats, size, pool, context.progress).refined(count)
    context.progress("cameras", 1.0)
    selected = select_diverse(candidates, count)
    return candidates, selected, split_views(with_size([candidates.cameras[n] for n in selected], *size))
