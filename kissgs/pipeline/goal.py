"""``Goal``: what a search for a container is to meet; ``Attempt``: a container, with its size and quality."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from decimal import ROUND_CEILING, Context
from functools import partial
from typing import TYPE_CHECKING, Any

from kissgs.evaluation.results import MAX_VIEW_PSNR, Detail, as_json, drop_of, over_scene, psnr_of, ssim_drop_of
from kissgs.settings import QUALITIES, EncodeSettings

if TYPE_CHECKING:
    from kissgs.evaluation.results import Evaluation
    from kissgs.pipeline.encoding import Container


@dataclass(frozen=True, slots=True)
class Attempt:
    """One container, or a scene before any encoding (0 bytes)."""

    count: int  # Gaussians of the scene that was encoded
    rd_lambda: float | None  # squared error per bit; None if no Gaussian is visible
    bytes: int  # of the zip, or of all files in the folder
    # Where the goal is a size, figures of quality are known of the kept one only. PSNR is to renderings of the scene,
    # as goals count it: without a capture in the views of worst and fifth_percentile, others than those of the drops.
    psnr: float | None = None  # decibels, as all but those of SSIM
    drop: float | None = None  # of PSNR, see kissgs.evaluation.results.drop_of
    ssim_drop: float | None = None
    detail: Detail | None = None  # losses of SSIM in patches, in the views of drop
    worst: float | None = None  # PSNR of the worst view
    fifth_percentile: float | None = None  # of the views' PSNR
    against: str | None = None  # of drop: "photos", or "renderings", from which it is estimated
    container: Container | None = field(default=None, repr=False, compare=False)  # None in reports

    @property
    def made(self) -> Container:
        """The container, of an attempt that has one."""
        assert self.container is not None  # noqa: S101  attempts in reports are not encoded again
        return self.container

    @property
    def trained(self) -> bool:
        """Whether its levels were fine-tuned."""
        return self.container is not None and self.container.finetuning is not None

    def with_evaluation(self, evaluation: Evaluation) -> Attempt:
        """Return a copy with the figures of an evaluation."""
        scene = over_scene(evaluation)
        return replace(
            self,
            psnr=psnr_of(evaluation),
            drop=drop_of(evaluation),
            ssim_drop=ssim_drop_of(evaluation),
            detail=evaluation.detail,
            worst=scene.worst.comparison.candidate_vs_reference.psnr,
            fifth_percentile=scene.fifth_percentile,
            against=evaluation.against,
        )

    def summary(self) -> str:
        """Return size and quality in one phrase: "812 kB at 41.20 dB, drop 0.120 dB, worst view 35.1 dB"."""
        quality = self.quality()
        return f"{self.bytes / 1000:,.0f} kB{quality and f' at {quality}'}"

    def quality(self) -> str:
        """Return the figures of quality in one phrase, empty where they are unknown."""
        against = {"photos": " to photographs", "renderings": " by its renderings"}.get(self.against or "", "")
        parts = [
            None if self.psnr is None else f"{self.psnr:.2f} dB",
            None if self.drop is None else f"drop {self.drop:.3f} dB{against}",
            None if self.ssim_drop is None else f"SSIM drop {self.ssim_drop:.3g}",
            None if self.detail is None else f"in the worst 1 % of patches {0 - self.detail.worst_percent:.3g}",
            None if self.worst is None else f"worst view {self.worst:.1f} dB",
        ]
        return ", ".join(filter(None, parts))

    def as_dict(self) -> dict[str, Any]:
        """Return all figures for JSON: infinity as null, NaN (a failed rendering) as the string ``"NaN"``."""
        values = {name: getattr(self, name) for name in self.__slots__ if name not in ("container", "detail")}
        numbers = {name: as_json(value) if isinstance(value, float) else value for name, value in values.items()}
        detail = None if self.detail is None else {name: as_json(each) for name, each in asdict(self.detail).items()}
        return {**numbers, "detail": detail}


TRAINED_NEAR, TRAINED_SIZE_NEAR, MOST_NEAR = 4.0, 2.5, 0.4
"""Factors on the margin that ends a search where each container takes a training, the second for a size, and the
largest such margin: with it, three quarters of an allowed drop are used. Another container would save some 7 % of the
bytes."""


LOSSES = {
    "max_psnr_drop": ("{:.3f}", " dB"),
    "max_ssim_drop": ("{:.3g}", " of SSIM"),
    "detail": ("{:.3g}", " of SSIM in the worst 1 % of patches"),
    "patch": ("{:.3g}", " of SSIM in the worst patch"),
}
"""Limits of losses, with the format of the number in a sentence, and what follows it."""


@dataclass(frozen=True, slots=True)
class Limit:
    """A limit of one figure."""

    name: str  # of the setting; "detail" or "patch" for losses that a quality alone limits
    value: float  # bytes, decibels, or a difference of SSIM
    slope: float  # typical change of the margin per doubling of lambda
    near: float  # margin that is small enough to end a search
    per_halving: float  # typical change of the figure by half as many Gaussians, of a size that of its log2
    quarter_loss: float | None = None  # loss expected with a quarter of the Gaussians and training, on the safe side
    quality: str = ""  # that it belongs to; empty if the user has named the limit itself

    @property
    def wanted(self) -> str:
        """The words of the user: "max_psnr_drop 0.1 dB" or "quality same"."""
        unit = " dB" if self.name in ("psnr", "max_psnr_drop") else ""
        return f"quality {self.quality}" if self.quality else f"{self.name} {self.value:g}{unit}"

    def figure(self, attempt: Attempt) -> float | None:
        """Return what is limited of an attempt, in the unit of ``value``; None if it is unknown."""
        if self.name in ("detail", "patch"):
            detail = attempt.detail
            return None if detail is None else -(detail.worst if self.name == "patch" else detail.worst_percent)
        figures = {
            "target_size": attempt.bytes,
            "psnr": attempt.psnr,
            "max_psnr_drop": attempt.drop,
            "max_ssim_drop": attempt.ssim_drop,
        }
        return figures[self.name]

    def loss(self, attempt: Attempt, digits: Callable[[float], str] | None = None) -> str:
        """Return what is limited of an attempt in words, such as "0.003 of SSIM"; empty for bytes and a PSNR."""
        found = self.figure(attempt)
        if found is None or self.name not in LOSSES:
            return ""
        form, unit = LOSSES[self.name]
        return (digits or form.format)(found) + unit

    def margin(self, attempt: Attempt) -> float:
        """Return by how much an attempt stays within the limit: at least 0 where it is met. The unit is log2 of a ratio
        for sizes and drops, and decibels for a PSNR. Infinite where nothing is lost at all: then the distance to the
        limit is unknown. -∞ where the figure is unknown or not a number."""
        found = self.figure(attempt)
        if found is None or math.isnan(found):
            return -math.inf
        if self.name == "psnr":
            return found - self.value
        if found <= 0:  # a container may even be closer to the photographs than the scene
            return math.inf
        # a drop is infinite where the photographs equal the renderings of the scene
        return math.log2(self.value / found) if found < math.inf else -math.inf

    def near_enough(self, *, trained: bool) -> float:
        """Return the margin that is small enough to end a search, more if each container takes a training."""
        factor = TRAINED_SIZE_NEAR if self.name == "target_size" else TRAINED_NEAR
        return max(min(factor * self.near, MOST_NEAR), self.near) if trained else self.near

    def log2_margin(self, attempt: Attempt) -> float:
        """Return the margin as log2 of the number of Gaussians, in which a loss is linear; NaN where unknown."""
        found = self.figure(attempt)
        if found is None:
            return math.nan
        margin = math.log2(self.value / found) if self.name == "target_size" else self.value - found
        return margin / self.per_halving


@dataclass(frozen=True, slots=True)
class Goal:
    """A goal for a container: a size, or the quality that the smallest container must have."""

    limits: tuple[Limit, ...]  # its size, or a PSNR, a drop of PSNR, losses of SSIM, or several of these
    most_bytes: int | None = None  # for a quality: of the smallest container with it

    @classmethod
    def of(cls, settings: EncodeSettings) -> Goal:
        """Return the goal of these settings. Near is 3 % of a size, 0.1 dB of a PSNR, 0.02 dB of a drop of PSNR and 5 %
        of a drop of SSIM, for which a container takes some 3 % of bytes."""
        limits, size, quality = list[Limit](), settings.target_size, QUALITIES.get(settings.quality or "")
        name, of_psnr, of_ssim = settings.quality or "", "", ""
        psnr_drop, ssim_drop = settings.max_psnr_drop, settings.max_ssim_drop
        if quality is not None and psnr_drop is None:
            psnr_drop, of_psnr = quality.psnr, name
        if quality is not None and ssim_drop is None:
            ssim_drop, of_ssim = quality.ssim, name
        if settings.psnr is not None:
            limits.append(Limit("psnr", settings.psnr, slope=-1.5, near=0.1, per_halving=math.nan))
        if psnr_drop is not None:
            near = -math.log2(max(1 - 0.02 / psnr_drop, 0.5))
            psnr = partial(Limit, slope=-0.5, near=near, per_halving=0.32, quarter_loss=0.1)
            limits.append(psnr("max_psnr_drop", psnr_drop, quality=of_psnr))
        ssim = partial(Limit, slope=-0.6, near=-math.log2(0.95))
        if ssim_drop is not None:
            limits.append(ssim("max_ssim_drop", ssim_drop, per_halving=0.01, quarter_loss=0.007, quality=of_ssim))
        if quality is not None:
            limits.append(ssim("detail", quality.detail, per_halving=0.04, quality=name))
            limits.append(ssim("patch", quality.patch, per_halving=0.06, quality=name))
        if not limits and size is not None:
            limits.append(Limit("target_size", size, slope=0.2, near=-math.log2(0.97), per_halving=0.75))
            size = None
        return cls(tuple(limits), size)

    @property
    def by_size(self) -> bool:
        """Whether the goal is a size, so that a search needs no renderings."""
        return self.limits[0].name == "target_size"

    @property
    def psnr_drop(self) -> float | None:
        """The largest drop of PSNR, decibels; None if it is not limited."""
        return next((limit.value for limit in self.limits if limit.name == "max_psnr_drop"), None)

    def decisive(self, attempt: Attempt) -> Limit:
        """Return the limit to which an attempt has the least margin."""
        return min(self.limits, key=lambda limit: limit.margin(attempt))

    def margin(self, attempt: Attempt) -> float:
        """Return the least margin (:meth:`Limit.margin`): at least 0 where all limits are met."""
        return self.decisive(attempt).margin(attempt)

    def log2_margin(self, attempt: Attempt) -> float:
        """Return the least margin as log2 of the number of Gaussians (:meth:`Limit.log2_margin`)."""
        return min(limit.log2_margin(attempt) for limit in self.limits)

    @property
    def allowed_log2(self) -> float:
        """How often the limits on losses typically allow to halve a quarter of the Gaussians, a fraction. Below 0 if
        more than a quarter are needed; 0 if the goal limits no loss."""
        known = [(limit, limit.quarter_loss) for limit in self.limits if limit.quarter_loss is not None]
        return min(((limit.value - expected) / limit.per_halving for limit, expected in known), default=0.0)

    def failure_message(self, attempts: Sequence[Attempt], *, suggest_compaction: bool) -> str:
        """Return why no attempt meets the goal; fewer Gaussians may be suggested where none were tried."""
        if self.by_size:
            smallest, target = min(attempt.bytes for attempt in attempts), int(self.limits[0].value)
            return (
                f"target_size {target:,} byte{'' if target == 1 else 's'} cannot be met: the smallest container found "
                f"has {smallest:,}; ask for at least that"
                + (", or for fewer Gaussians: compact with auto_count" * suggest_compaction)
            )
        finest = max(attempts, key=self.margin)
        missed = {limit: limit.figure(finest) for limit in self.limits if limit.margin(finest) < 0}
        first = next(iter(missed))
        if first.name == "psnr":  # one thing at a time
            missed = {first: missed[first]}
        wanted = " and ".join(dict.fromkeys(limit.wanted for limit in missed))
        found = [math.nan if figure is None else figure for figure in missed.values()]
        failed = f"{wanted} cannot be met: "
        if any(map(math.isnan, found)):
            return f"{failed}a rendering of the finest container found failed, so its quality is unknown"
        if math.inf in found:
            return f"{failed}the scene's renderings equal the photographs, so any loss of PSNR is infinite"
        if first.name == "psnr":
            highest, limit = math.floor(100 * found[0]) / 100, first.value
            most = f"; each view counts for at most {MAX_VIEW_PSNR:g} dB" if limit > MAX_VIEW_PSNR else ""
            return f"{failed}the finest container found has {highest:.2f} dB; ask for at most that{most}"
        losses = " and ".join(limit.loss(finest, _rounded_up) for limit in missed)
        of_quality = all(limit.quality for limit in missed)
        lower = "choose a lower quality, or give max_psnr_drop" if of_quality else "allow at least that"
        return f"{failed}the finest container found loses {losses}; {lower}"


def _rounded_up(value: float) -> str:
    """Return three significant digits of a number that is at least ``value``."""
    digits = Context(prec=3, rounding=ROUND_CEILING).create_decimal_from_float(value)
    return f"{float(digits):.3g}"
