"""Supervision views: photographs or renderings that train, score and evaluate a scene."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from kissgs.cameras.views import View, Views, black
from kissgs.cameras.virtual.samples import close_ups, random_poses, scattered_cameras, scene_views
from kissgs.core.array_types import Float32, Shaped
from kissgs.core.context import DEFAULT_CONTEXT, Context
from kissgs.core.splats import Splats
from kissgs.rendering.camera import Camera
from kissgs.rendering.rasterizer import ImageRenderer, image_renderer, render
from kissgs.settings import TrainingViewSettings

SCORING_STRIDE = 4  # one in this many virtual training cameras scores Gaussians
CLOSE_UPS, CLOSE_UP_SHRINK = 4, 4  # per virtual scoring camera, and by how much their sides are shorter
BACKGROUNDS = (0.0, 0.5, 1.0)  # grey levels, in turn, of virtual cameras that score or stand beside a capture
MIN_SYNTHETIC_VIEWS = 64  # smallest number of synthetic views beside those of a capture; fewer are overfitted
SCORING_SHARE = 0.25  # number of these that score Gaussians, as a share of the number of the capture's training views
MAX_EVAL_VIEWS = 16  # largest number of evaluation views


@dataclass(frozen=True, slots=True, eq=False)
class SupervisionViews:
    """Views by their role."""

    train: tuple[View, ...]  # samples of larger photographs; none if nothing is trained
    # A capture's training views and some synthetic ones, or some virtual cameras and close-ups. Virtual ones have the
    # usual dilation, so that Gaussians between the sampled pixels of photographs count too.
    score: tuple[View, ...]
    test: tuple[View, ...]  # held-out views, or some training views, whole; all have photographs or none
    background: Float32[np.ndarray, "3"]
    source: str  # of the training views, in words
    captured: bool = False  # whether the training views are those of a capture
    note: str = ""
    synthetic: int = 0  # number of the last training views, virtual ones beside a capture, which take turns
    synthetic_per_epoch: int = 0

    def with_scoring(self, most: int) -> SupervisionViews:
        """Return these views, of which at most ``most`` score: every so many-th."""
        return replace(self, score=_evenly_selected(self.score, min(most, len(self.score))))

    @property
    def eval_views(self) -> Views:
        """Evaluation views, for :func:`kissgs.evaluate`."""
        return Views((), self.test, self.background, self.source)


def supervision_views(
    splats: Splats,
    views: Views | None,
    settings: TrainingViewSettings,
    context: Context = DEFAULT_CONTEXT,
    *,
    scoring_stride: int = SCORING_STRIDE,
) -> SupervisionViews:
    """Return a capture's training views with virtual ones of the whole scene, or virtual views alone. Every
    ``scoring_stride``-th virtual view scores. 1: no view trains, so that :data:`SCORING_STRIDE` times fewer are drawn;
    0: none scores."""
    if views is None or not views.train:
        virtual = _virtual_views(splats, settings, scoring_stride, context)
        if views is None or not views.test:
            return virtual
        return replace(virtual, test=_evaluation_views(views), background=views.background)
    train = tuple(_thinned(view, number, settings.photo_size) for number, view in enumerate(views.train))
    synthetic, per_epoch = _synthetic_views(splats, views.train, settings, context)
    side = settings.view_size * 3 // 5  # of virtual cameras
    scoring = math.ceil(SCORING_SHARE * len(train)) if scoring_stride else 0
    source = f"{len(synthetic)} virtual cameras" if synthetic else ""
    if synthetic and scoring:
        source += f", of which {min(scoring, len(synthetic))} score"
    return SupervisionViews(
        train=(*train, *(replace(view, camera=view.camera.sampled_at_most(side)) for view in synthetic)),
        score=(*train, *(replace(view, camera=view.camera.at_most(side)) for view in synthetic[:scoring])),
        test=_evaluation_views(views),
        background=views.background,
        source=", and ".join(filter(None, [views.source, source])),
        captured=True,
        note=_note(views),
        synthetic=len(synthetic),
        synthetic_per_epoch=per_epoch,
    )


def _synthetic_views(
    splats: Splats, train: Sequence[View], settings: TrainingViewSettings, context: Context
) -> tuple[tuple[View, ...], int]:
    """Return virtual views of all that a capture may not show, in random order, and their number in each epoch. A
    quarter of them together see all regions. Images are square and have the area of the photographs."""
    share, camera = settings.synthetic_view_share, train[0].camera
    if share == 0:
        return (), 0
    per_epoch = max(1, round(len(train) * share / (1 - share)))
    side = max(1, round(math.sqrt(camera.width * camera.height)))
    count = max(per_epoch, MIN_SYNTHETIC_VIEWS)
    regions = scene_views(splats, context, width=side, height=side, count=count // 4)
    cameras, threads = [view.camera for view in regions.all], context.threads
    cameras += scattered_cameras(splats, side=side, count=count - len(cameras), seed=settings.seed, threads=threads)
    order = np.random.default_rng(settings.seed).permutation(len(cameras))
    views = [View(f"synthetic {n}", cameras[index], background=_background(n)) for n, index in enumerate(order)]
    return tuple(views), min(per_epoch, len(views))


def _background(n: int) -> Float32[np.ndarray, "3"]:
    return np.full(3, BACKGROUNDS[n % len(BACKGROUNDS)], np.float32)


def evaluation_only(views: Views | None) -> SupervisionViews:
    """Return the evaluation views of a capture, if there is one, and none that trains or scores."""
    nothing = SupervisionViews(train=(), score=(), test=(), background=black(), source="")
    if views is None:
        return nothing
    test, note = _evaluation_views(views), _note(views)
    return replace(nothing, test=test, background=views.background, source=views.source, captured=True, note=note)


def _note(views: Views) -> str:
    """Return the note on a capture, and whether its training views evaluate."""
    note = "" if views.test else "no view is held out: training views are used for evaluation too"
    return "; ".join(filter(None, [views.note, note]))


def _evaluation_views(views: Views) -> tuple[View, ...]:
    """Return the evaluation views of a capture: all with photographs, or none."""
    chosen = views.test or views.train
    return _evenly_selected([view for view in chosen if view.photo is not None] or chosen)


def _virtual_views(splats: Splats, settings: TrainingViewSettings, stride: int, context: Context) -> SupervisionViews:
    """Return virtual views only; their targets are renderings of the scene."""
    side = settings.view_size * 3 // 5
    count = max(1, settings.views * (stride or SCORING_STRIDE) // SCORING_STRIDE)
    drawn = random_poses(splats, context, side=side, count=count, seed=settings.seed)
    scoring = _scoring_views(splats, drawn.train[::stride], side, settings.seed) if stride else ()
    close_up_count = len(scoring) - len(drawn.train[::stride]) if stride else 0
    return SupervisionViews(
        train=drawn.train,
        score=scoring,
        test=_evenly_selected(drawn.test or drawn.train),
        background=drawn.background,
        source=f"{len(drawn.train)} virtual camera{'' if len(drawn.train) == 1 else 's'}"
        + (f", and {close_up_count} close-ups that score" if close_up_count else ""),
    )


def _scoring_views(splats: Splats, views: Sequence[View], side: int, seed: int) -> tuple[View, ...]:
    """Return ``views`` and close-ups with black, grey and white backgrounds in turn: on black, dark parts do not show.
    ``side`` is that of the views, pixels."""
    cameras = close_ups(splats, side=max(1, side // CLOSE_UP_SHRINK), count=CLOSE_UPS * len(views), seed=seed)
    added = [View(f"close-up {n}", camera) for n, camera in enumerate(cameras)]
    return tuple(replace(view, background=_background(n)) for group in (views, added) for n, view in enumerate(group))


def _thinned(view: View, number: int, size: int) -> View:
    """Return every n-th pixel and row of a view, so that the longer side has at most ``size`` pixels. Views of
    different numbers begin at different pixels. A scene that is trained on reduced photographs renders worse at
    their own size, because footprints are dilated to a pixel (docs/method/research-log.md, "Size of the training
    images")."""
    width, height = view.camera.width, view.camera.height
    stride = math.ceil(max(width, height) / size)
    if stride == 1:
        return view
    return view.sampled(stride, (min(number % stride, width - 1), min(number // stride % stride, height - 1)))


def _evenly_selected(views: Sequence[View], most: int = MAX_EVAL_VIEWS) -> tuple[View, ...]:
    selected = np.unique(np.linspace(0, len(views) - 1, most).astype(int))
    return tuple(views[n] for n in selected)


# Training targets: cameras with photographs, or with renderings of the original scene.

NEAREST_CAMERAS, EXTENT_RATIO = 4, 4.0  # local extent: 4 times the distance to the 4th nearest camera


@dataclass(frozen=True, slots=True, eq=False)
class TrainingTargets:
    """Cameras and their target images."""

    cameras: tuple[Camera, ...]
    images: tuple[Shaped[np.ndarray, "H W 3"], ...]  # photographs in uint8, renderings in float16 from 0 to 1
    backgrounds: tuple[Float32[np.ndarray, "3"], ...]
    target_source: Literal["photos", "renderings"]  # "photos" if any is
    synthetic: int = 0  # see SupervisionViews
    synthetic_per_epoch: int = 0

    def __len__(self) -> int:
        return len(self.cameras)

    def image(self, n: int) -> Float32[np.ndarray, "H W 3"]:
        """Return the target image of camera ``n``, values from 0 to 1."""
        image = self.images[n]
        return image.astype(np.float32) / np.float32(255 if image.dtype == np.uint8 else 1)

    def order(self, seed: Sequence[int], first: int = 0) -> Iterator[int]:
        """Yield the index of the target for step ``first`` and each later one. Each epoch has all targets but the
        synthetic ones, and the next few of these, in random order. The order depends on the seed and the step only, so
        that training can be resumed at any step."""
        always, some = len(self) - self.synthetic, self.synthetic_per_epoch
        turns = np.random.default_rng(seed).permutation(self.synthetic)
        count = always + some
        while True:
            epoch, begin = divmod(first, count)
            turn = turns.take(range(epoch * some, (epoch + 1) * some), mode="wrap")
            targets = np.concatenate([np.arange(always), always + turn])
            yield from np.random.default_rng([*seed, epoch]).permutation(targets)[begin:].tolist()
            first += count - begin

    @property
    def extent(self) -> float:
        """Extent of the cameras, world units: 1.1 times the largest distance to their mean position, as in 3DGS. 0 if
        all cameras are at one position. Synthetic ones do not count."""
        cameras = self.cameras[: len(self) - self.synthetic]
        positions = np.array([camera.position for camera in cameras])
        return 1.1 * float(np.linalg.norm(positions - positions.mean(axis=0), axis=1).max())

    def local_extents(self, means: Float32[np.ndarray, "N 3"], largest: float) -> Float32[np.ndarray, " N"]:
        """Return the extent of the cameras around each of these points, world units, above 0 and at most ``largest``.
        If a scene has several objects with cameras around each, the extent of all cameras does not represent the size
        of one object. For a scene of one object, most points get ``largest``. Synthetic cameras count: an object that
        was not photographed has no others."""
        positions = np.array([camera.position for camera in self.cameras])
        nearest = np.full((len(means), min(NEAREST_CAMERAS, len(positions))), np.inf)
        for position in positions:
            distance = np.linalg.norm(means - position, axis=1)
            for rank in range(nearest.shape[1]):
                nearest[:, rank], distance = (
                    np.minimum(nearest[:, rank], distance),
                    np.maximum(nearest[:, rank], distance),
                )
        return np.clip(EXTENT_RATIO * nearest[:, -1], 1e-6 * largest, largest).astype(np.float32)


def training_targets(
    reference: Splats, supervision: SupervisionViews, context: Context = DEFAULT_CONTEXT
) -> TrainingTargets:
    """Load the photographs of the training views, and render ``reference`` for those that have none."""
    views, background = supervision.train, supervision.background
    renderer, images = _renderer(reference, context), []
    backgrounds = tuple(background if view.background is None else view.background for view in views)
    for done, view in enumerate(views):
        context.progress("targets", done / len(views))
        if view.photo is not None:
            images.append(view.load_photo())
        else:
            images.append(np.clip(renderer(view.camera, backgrounds[done].tolist())[0], 0, 1).astype(np.float16))
    context.progress("targets", 1.0)
    return TrainingTargets(
        cameras=tuple(view.camera for view in views),
        images=tuple(images),
        backgrounds=backgrounds,
        target_source="photos" if any(view.photo is not None for view in views) else "renderings",
        synthetic=supervision.synthetic,
        synthetic_per_epoch=supervision.synthetic_per_epoch,
    )


def _renderer(reference: Splats, context: Context) -> ImageRenderer:
    if context.device == "cuda":
        return image_renderer(reference)
    return lambda camera, background: render(reference, camera, background=background, threads=context.threads)
