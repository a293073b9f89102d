"""Oracles in float64: cleaning, images with gradients, removal, effective rank, training.

Images are gsplat's, pixel by pixel, and share no code with the renderer under test; torch differentiates them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from threadpoolctl import threadpool_limits

from kissgs.core.splats import ATTRIBUTES

C0 = 0.28209479177387814
LOGIT = float(np.log(1e-6) - np.log1p(-1e-6))


def cleaned(arrays):
    """Return the cleaned scene, Gaussian by Gaussian, opacities instead of logits, and the expected counts."""
    counts = dict.fromkeys(("non_finite", "far_away", "infinite_opacities", "saturated_opacities"), 0)
    counts |= dict.fromkeys(("zero_quats", "unnormalised_quats", "clamped_scales", "clamped_sh"), 0)
    rows = []
    for n in range(len(arrays["means"])):
        with np.errstate(over="ignore", under="ignore"):
            row = {name: arrays[name][n].astype(np.float32).astype(np.float64) for name in ATTRIBUTES}
        strict = [row[name].ravel() for name in ("means", "quats", "sh0", "shN")]
        loose = [row["scales"], row["opacities"][None]]
        if not np.isfinite(np.concatenate(strict)).all() or np.isnan(np.concatenate(loose)).any():
            counts["non_finite"] += 1
            continue
        if np.abs(row["means"]).max() > 1e15:
            counts["far_away"] += 1
            continue
        largest = np.abs(row["quats"]).max()
        length = largest * np.linalg.norm(row["quats"] / largest) if largest else 0.0
        counts["zero_quats"] += length == 0
        counts["unnormalised_quats"] += bool(length) and abs(length - 1) > 1e-3
        logit, sh = row["opacities"], np.concatenate([row["sh0"].ravel(), row["shN"].ravel()])
        counts["infinite_opacities"] += np.isinf(logit)
        counts["saturated_opacities"] += np.isfinite(logit) and not LOGIT <= logit <= 13.8024
        counts["clamped_scales"] += np.abs(row["scales"]).max() > 30
        counts["clamped_sh"] += np.abs(sh).max() > 1e6
        row["quats"] = row["quats"] / largest / np.linalg.norm(row["quats"] / largest) if largest else [1.0, 0, 0, 0]
        row["opacities"] = 1 / (1 + np.exp(-np.clip(logit, -700, 700)))
        row["scales"] = row["scales"].clip(-30, 30)
        rows.append(row | {name: row[name].clip(-1e6, 1e6) for name in ("sh0", "shN")})
    return rows, {name: int(count) for name, count in counts.items()}


@dataclass
class Rendering:
    image: torch.Tensor  # (H, W, 3)
    alpha: torch.Tensor  # (H, W)
    sure: np.ndarray  # (H, W): no decision depends on less than float32 can resolve
    order: np.ndarray  # (M,) front to back
    alphas: torch.Tensor  # (M, H W), 0 where not drawn
    colours: torch.Tensor  # (M, 3)
    ended: np.ndarray  # (H, W): blending ended before the last Gaussian

    def weights(self, count):
        """Return alpha times the transmittance before, ``(count, H W)``, of all Gaussians of the scene."""
        alphas, found = self.alphas.detach().numpy(), np.zeros((count, self.alphas.shape[1]))
        before = np.cumprod(np.concatenate([np.ones_like(alphas[:1]), 1 - alphas[:-1]]), axis=0)
        found[self.order] = alphas * before
        return found


def harmonics(x, y, z):
    """Return the real spherical harmonics of bands 1 to 3."""
    xx, yy, zz = x * x, y * y, z * z
    return [
        -0.4886025119029199 * y,
        0.4886025119029199 * z,
        -0.4886025119029199 * x,
        1.0925484305920792 * x * y,
        -1.0925484305920792 * y * z,
        0.31539156525252005 * (2 * zz - xx - yy),
        -1.0925484305920792 * x * z,
        0.5462742152960396 * (xx - yy),
        -0.5900435899266435 * y * (3 * xx - yy),
        2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (4 * zz - xx - yy),
        0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
        -0.4570457994644658 * x * (4 * zz - xx - yy),
        1.445305721320277 * z * (xx - yy),
        -0.5900435899266435 * x * (xx - 3 * yy),
    ]


def tensors(splats, *, leaf=False):
    return {name: torch.tensor(getattr(splats, name), dtype=torch.float64, requires_grad=leaf) for name in ATTRIBUTES}


def rotations(quats):
    w, x, y, z = (quats / quats.norm(dim=1, keepdim=True)).T
    rows = [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]
    rows += [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]
    rows += [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]
    return torch.stack(rows, dim=1).reshape(-1, 3, 3)


def exponents(params, camera, W, t):
    """Return ``(N, H W)`` half squared Mahalanobis distances, as sums of squares, which are accurate for needles.

    And ``(N,)`` the ratio of the determinants of the covariance before and after dilation.
    """
    K, width, height = camera.K, camera.width, camera.height
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    x, y, z = (params["means"] @ W.T + t).T
    near_x = (x / z).clamp(-cx / fx - 0.15 * width / fx, (width - cx) / fx + 0.15 * width / fx)
    near_y = (y / z).clamp(-cy / fy - 0.15 * height / fy, (height - cy) / fy + 0.15 * height / fy)
    p = fx / z[:, None] * (W[0] - near_x[:, None] * W[2])
    q = fy / z[:, None] * (W[1] - near_y[:, None] * W[2])
    R, s = rotations(params["quats"]), params["scales"].exp()
    p, q = ((row[:, None] @ R)[:, 0] * s for row in (p, q))
    before = torch.linalg.cross(p, q).square().sum(1)
    det = 0.3 * ((p * p).sum(1) + (q * q).sum(1) + 0.3) + before
    ys, xs = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    dx = xs.reshape(-1).double() - (fx * x / z + cx)[:, None]
    dy = ys.reshape(-1).double() - (fy * y / z + cy)[:, None]
    squares = 0.3 * (dx * dx + dy * dy)
    for k in range(3):
        squares = squares + (p[:, k, None] * dy - q[:, k, None] * dx).square()
    return squares / (2 * det[:, None]), before / det


def decisions(raw, alpha_max):
    """Return masks of drawn Gaussians, clamped alphas, pixels that are not doubtful, and pixels that ended early."""
    raw = raw.detach().numpy()
    left, ended, doubtful = np.ones(raw.shape[1]), np.zeros(raw.shape[1], bool), np.zeros(raw.shape[1], bool)
    drawn = np.zeros(raw.shape, bool)
    for n, row in enumerate(raw):
        alpha = np.minimum(row, alpha_max)
        seen = (alpha >= 1 / 255) & ~ended
        after = left * (1 - alpha)
        drawn[n] = seen & (after > 1e-4)
        doubtful |= ~ended & (np.abs(alpha * 255 - 1) < 2e-4)
        doubtful |= seen & ((np.abs(after / 1e-4 - 1) < 2e-3) | (np.abs(row / alpha_max - 1) < 2e-5))
        ended |= seen & ~drawn[n]
        left = np.where(drawn[n], after, left)
    return drawn, raw > alpha_max, ~doubtful, ended


@threadpool_limits.wrap(limits=1)  # more threads take ten times as long for images so small
def draw(params, camera, background, antialiased=False, alpha_max=0.99):
    """Render an image from float64 tensors; ``alpha_max`` differs between releases of gsplat."""
    W, t = torch.from_numpy(camera.viewmat[:3, :3]), torch.from_numpy(camera.viewmat[:3, 3])
    depth = (params["means"].detach() @ W.T + t)[:, 2].numpy()
    order = np.argsort(depth.astype(np.float32), kind="stable")
    order = order[(depth[order] >= 0.01) & (depth[order] <= 1e10)]
    params = {name: values[torch.from_numpy(order)] for name, values in params.items()}
    exponent, ratio = exponents(params, camera, W, t)
    opacities = torch.sigmoid(params["opacities"]) * (ratio.sqrt() if antialiased else 1)
    raw = opacities[:, None] * torch.exp(-exponent)
    drawn, clamped, sure, ended = decisions(raw, alpha_max)
    alphas = torch.where(torch.from_numpy(drawn), torch.where(torch.from_numpy(clamped), alpha_max, raw), 0.0)
    sight = params["means"] + W.T @ t
    values = torch.stack(harmonics(*(sight / sight.norm(dim=1, keepdim=True)).T), dim=1)[:, : params["shN"].shape[1]]
    colours = (0.5 + C0 * params["sh0"] + (values[:, :, None] * params["shN"]).sum(1)).clamp_min(0)
    image, left = composed(alphas, colours, torch.as_tensor(background, dtype=torch.float64))
    shape = camera.height, camera.width
    return Rendering(
        image.reshape(*shape, 3),
        (1 - left).reshape(shape),
        sure.reshape(shape),
        order,
        alphas,
        colours,
        ended.reshape(shape),
    )


def composed(alphas, colours, background):
    """Blend front to back; return colours ``(P, 3)`` and remaining transmittance ``(P,)`` of the pixels."""
    through = torch.cat([torch.ones_like(alphas[:1]), torch.cumprod(1 - alphas, dim=0)])
    if not len(alphas):
        through = torch.ones(1, alphas.shape[1], dtype=torch.float64)
    return (through[:-1] * alphas).T @ colours + through[-1][:, None] * background, through[-1]


def removed(rendering, count, background):
    """Return the squared change of the image by the removal of each Gaussian, with unchanged lists of the pixels."""
    alphas, colours = rendering.alphas.detach(), rendering.colours.detach()
    background = torch.as_tensor(background, dtype=torch.float64)
    whole, _ = composed(alphas, colours, background)
    scores = np.zeros(count)
    for place, n in enumerate(rendering.order):
        others = torch.arange(len(alphas)) != place
        without, _ = composed(alphas[others], colours[others], background)
        scores[n] = float((without - whole).square().sum())
    return scores


def erank_loss(scales):
    """Return the paper's loss max(-ln(erank - 1 + 1e-7), 0), ``(N,)``, and its gradient ``(N, 3)``."""
    scales = np.asarray(scales, np.float64)
    squares = np.exp(2 * scales)
    share = squares / squares.sum(1, keepdims=True)
    logs = np.log(share)
    entropy = -(share * logs).sum(1, keepdims=True)
    excess = np.expm1(entropy) + 1e-7
    loss = -np.log(excess)
    gradient = np.exp(entropy) / excess * 2 * share * (logs + entropy)
    return np.maximum(loss, 0)[:, 0], np.where(loss > 0, gradient, 0)
