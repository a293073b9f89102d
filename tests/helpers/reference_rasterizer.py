"""Oracle of rendering: gsplat's modes in float64, pixel by pixel, with full covariance matrices.

It shares no code with the renderer under test.
"""

from dataclasses import dataclass
from decimal import Decimal, localcontext

import numpy as np

C0 = 0.28209479177387814


@dataclass
class Drawn:
    image: np.ndarray  # (H, W, 3)
    alpha: np.ndarray  # (H, W)
    decisions: list  # per Gaussian, front to back: its number, where it was drawn, where its alpha was clamped
    doubtful: np.ndarray  # (H, W): a decision depends on less than float32 can resolve
    layers: list  # per Gaussian, front to back: its number, alphas, transmittances before it, colour


def rotation(quat):
    w, x, y, z = quat / np.linalg.norm(quat)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def inverse(covariance, transform, R, scales):
    """Return the inverse of a footprint's covariance, and the ratio of its determinants before and after dilation.

    With 120 digits where float64 is not exact enough.
    """
    if scales.max() - scales.min() < 7 and scales.max() < 7:
        before = np.linalg.det(covariance - 0.3 * np.eye(2))
        return np.linalg.inv(covariance), max(before / np.linalg.det(covariance), 0)
    with localcontext() as context:
        context.prec = 120
        exact = np.vectorize(lambda value: Decimal(float(value)), otypes=[object])
        turned = exact(transform) @ exact(R)
        squares = np.array([(2 * Decimal(float(scale))).exp() for scale in scales])
        dilation = Decimal("0.3")
        a, b, d = ((turned[i] * turned[j] * squares).sum() + dilation * (i == j) for i, j in ((0, 0), (0, 1), (1, 1)))
        det = a * d - b * b
        before = (a - dilation) * (d - dilation) - b * b
        return np.array([[d / det, -b / det], [-b / det, a / det]], np.float64), float(max(before / det, 0))


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


def sh_values(direction, count):
    return np.array(harmonics(*direction)[:count])


def draw(params, camera, background, frozen=None, removed=None, alpha_max=0.99, antialiased=False):
    """Render an image.

    Args:
        params: float64 arrays by name, as in ``Splats``.
        camera: camera.
        background: RGB.
        frozen: decisions of an earlier image to keep.
        removed: a Gaussian to leave out.
        alpha_max: largest alpha, which differs between releases of gsplat.
        antialiased: whether opacities are compensated for the dilation.
    """
    means, quats, scales, opacities, sh0, shN = (
        params[name] for name in ("means", "quats", "scales", "opacities", "sh0", "shN")
    )
    W, t, K = camera.viewmat[:3, :3], camera.viewmat[:3, 3], camera.K
    eye = -W.T @ t
    height, width = camera.height, camera.width
    ys, xs = np.mgrid[0:height, 0:width] + 0.5
    in_camera = means @ W.T + t
    order = (
        [entry[0] for entry in frozen]
        if frozen is not None
        else np.argsort(in_camera[:, 2].astype(np.float32), kind="stable")
    )
    image = np.zeros((height, width, 3))
    left = np.ones((height, width))
    ended = np.zeros((height, width), bool)
    doubtful = np.zeros((height, width), bool)
    decisions, layers = [], []
    for place, n in enumerate(order):
        x, y, z = in_camera[n]
        if n == removed or z < 0.01 or z > 1e10:
            continue
        opacity = 1 / (1 + np.exp(-opacities[n]))
        fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
        near_x = np.clip(x / z, -cx / fx - 0.15 * width / fx, (width - cx) / fx + 0.15 * width / fx)
        near_y = np.clip(y / z, -cy / fy - 0.15 * height / fy, (height - cy) / fy + 0.15 * height / fy)
        J = np.array([[fx / z, 0, -fx * near_x / z], [0, fy / z, -fy * near_y / z]])
        R = rotation(quats[n])
        covariance = R @ np.diag(np.exp(2 * scales[n])) @ R.T
        flat = J @ W @ covariance @ W.T @ J.T + 0.3 * np.eye(2)
        conic, ratio = inverse(flat, J @ W, R, scales[n])
        opacity *= np.sqrt(ratio) if antialiased else 1
        dx, dy = xs - (fx * x / z + cx), ys - (fy * y / z + cy)
        exponent = 0.5 * (conic[0, 0] * dx * dx + conic[1, 1] * dy * dy) + conic[0, 1] * dx * dy
        raw = opacity * np.exp(-exponent)
        if frozen is None:
            clamped = raw > alpha_max
            alpha = np.minimum(raw, alpha_max)
            seen = (alpha >= 1 / 255) & ~ended
            after = left * (1 - alpha)
            drawn = seen & (after > 1e-4)
            doubtful |= ~ended & (np.abs(alpha * 255 - 1) < 2e-4)
            doubtful |= seen & (np.abs(after / 1e-4 - 1) < 2e-3)
            doubtful |= seen & (np.abs(raw / alpha_max - 1) < 2e-5)
            ended |= seen & ~drawn
            decisions.append((n, drawn, clamped))
        else:
            _, drawn, clamped = frozen[place]
            alpha = np.where(clamped, alpha_max, raw)
            after = left * (1 - alpha)
        direction = (means[n] - eye) / np.linalg.norm(means[n] - eye)
        colour = 0.5 + C0 * sh0[n] + sh_values(direction, shN.shape[1]) @ shN[n]
        weight = np.where(drawn, left * alpha, 0)
        image += weight[:, :, None] * np.maximum(colour, 0)
        layers.append((n, np.where(drawn, alpha, 0), left, np.maximum(colour, 0)))
        left = np.where(drawn, after, left)
    return Drawn(image + left[:, :, None] * background, 1 - left, decisions, doubtful, layers)


def gradient_by_differences(params, camera, background, v_image, v_alpha, step=1e-5, alpha_max=0.99, antialiased=False):
    """Return central differences of sum(image * v_image) + sum(alpha * v_alpha), with frozen decisions."""
    frozen = draw(params, camera, background, alpha_max=alpha_max, antialiased=antialiased).decisions

    def loss(changed):
        drawn = draw(changed, camera, background, frozen=frozen, alpha_max=alpha_max, antialiased=antialiased)
        return (drawn.image * v_image).sum() + (drawn.alpha * v_alpha).sum()

    gradients = {}
    for name, values in params.items():
        gradient = np.zeros_like(values)
        for index in np.ndindex(values.shape):
            size = step * max(1.0, abs(values[index]))
            both = []
            for sign in (1, -1):
                changed = values.copy()
                changed[index] += sign * size
                both.append(loss({**params, name: changed}))
            gradient[index] = (both[0] - both[1]) / (2 * size)
        gradients[name] = gradient
    return gradients
