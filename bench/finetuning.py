"""Bytes and quality at several quality offsets, with and without fine-tuning, and the bytes that it saves.

python bench/finetuning.py fox.ply --views fox
"""

from __future__ import annotations

from bench.common import arguments, at_quality_offset, fraction, head, row, run, saving, training_views, write
from kissgs import Settings, compact, compress, decompress, evaluate, load
from kissgs.cli.options import chosen

METRICS = "PSNR", "SSIM", "PSNR to the original"
VARIANTS = "not fine-tuned", "fine-tuned"


def main() -> None:
    """Print a row for each share, offset and variant, and the share of bytes saved at equal quality, on average."""
    parser = arguments(__doc__)
    parser.add_argument("-p", "--preset", default="balanced")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="setting of fine-tuning")
    parser.add_argument("--offsets", nargs="+", type=float, default=[-8, -5, -2, 1], metavar="DB")
    parser.add_argument("--ratios", nargs="+", type=fraction, default=[1.0], help="compact to these shares first")
    parser.add_argument("--supervision", default="photos", choices=["photos", "cameras", "scene"])
    given = parser.parse_args()
    settings = chosen(given.preset, given.set, group="finetune")
    scene = load(given.scene)
    by_scene = given.views is None or given.supervision == "scene"
    training = None if by_scene else training_views(given.views, given.supervision)
    head("variant", "Gaussians", "offset, dB", "bytes", *METRICS, "CPU s", "peak MB so far")
    curves: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for ratio in given.ratios:
        reduced = scene
        if ratio < 1:
            budget = settings.compact.model_copy(update={"ratio": ratio})
            reduced = compact(scene, settings=settings.model_copy(update={"compact": budget}), views=training).splats
        for offset in given.offsets:
            for variant in VARIANTS:
                tuned = with_finetuning(at_quality_offset(settings, offset), variant == VARIANTS[1])
                result = compress(reduced, settings=tuned, views=training)
                mean = evaluate(scene, decompress(result.files), given.views).mean
                found = mean.candidate.psnr, mean.candidate.ssim, mean.candidate_vs_reference.psnr
                for metric, value in zip(METRICS, found, strict=True):
                    curves.setdefault((variant, metric), []).append((value, result.report.container_bytes))
                quality = f"{found[0]:.2f}", f"{found[1]:.4f}", f"{found[2]:.2f}"
                used = f"{result.report.cpu_seconds:.1f}", f"{result.report.peak_memory / 1e6:.0f}"
                row(variant, len(reduced), f"{offset:g}", result.report.container_bytes, *quality, *used)
    for metric in METRICS:
        share = saving(curves[VARIANTS[0], metric], curves[VARIANTS[1], metric])
        if share is not None:
            write(f"{100 * share:.1f} % fewer bytes at equal {metric}, on average")


def with_finetuning(settings: Settings, enabled: bool) -> Settings:
    """Return settings with or without fine-tuning."""
    return settings.model_copy(update={"finetune": settings.finetune.model_copy(update={"enabled": enabled})})


if __name__ == "__main__":
    run(main)
