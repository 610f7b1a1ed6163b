"""Gradient of a noisy picture as it is expected from its measured value.

The information of a sample on a displacement is proportional to the square of the gradient ∇f. A measured gradient g
has noise, whose square would count as information: in a scene of a few beads most of it is that of the background.
The score of a displacement, in contrast, has the slope g · ∇f, which is that of the scene alone in the mean. Estimates
with too much information take too small steps, so that they stop early, and state too small standard deviations.

Here g is replaced by its regression on ∇f, E[∇f | g] = (P - N) P⁻¹ g (regression calibration; Carroll et al. 2006,
"Measurement error in nonlinear models", ch. 4). P is the mean of g g' nearby, N the part of it that is noise, as
measured from the scatter between pictures of parts of the samples. Square and slope are then equal in the mean.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from recon.imaging.smoothing import REACH

WINDOW_PX = 4.0
"""Standard deviation of the window of the means [px]: that of the widest kernel. With the narrowest it holds 30
independent gradients, so that noise alone has a share of 0.18 (1 sd)."""


def calibrate_gradients(references: NDArray[np.float32]) -> None:
    """Replace the gradients of pictures that each lack one of several equal parts of the samples by expected ones.

    Args:
        references: shape (parts, height, width, 5); the last two values are the gradient, NaN where unknown.
    """
    gradients = references[..., 3:]
    known = np.asarray(np.isfinite(gradients).all(axis=(0, 3)))
    found = np.where(known[..., None], gradients, np.float32(0.0))
    x, y = found[..., 0], found[..., 1]
    # Each picture has (parts - 1) / parts of the samples: this sum, by the jackknife, is the variance of one of them.
    scatter = sum(np.var(each, axis=0) for each in (x, y)) * len(found)
    means = np.mean(x * x, axis=0), np.mean(y * y, axis=0), np.mean(x * y, axis=0), 0.5 * scatter
    xx, yy, xy, noise = (_nearby(np.asarray(each)) for each in means)
    half, difference = 0.5 * (xx + yy), 0.5 * (xx - yy)
    radius = np.hypot(difference, xy)
    large, small = (_share(half + sign * radius, noise) for sign in (1.0, -1.0))
    mean, spread = 0.5 * (large + small), 0.5 * (large - small)
    along, across = (
        spread * np.divide(each, radius, out=np.zeros_like(radius), where=radius > 0.0) for each in (difference, xy)
    )
    gradients[..., 0], gradients[..., 1] = (
        (mean + along) * gradients[..., 0] + across * gradients[..., 1],
        across * gradients[..., 0] + (mean - along) * gradients[..., 1],
    )


def _share(power: NDArray[np.float32], noise: NDArray[np.float32]) -> NDArray[np.float32]:
    """Fraction of a mean square that is not noise."""
    return np.clip(1.0 - np.divide(noise, power, out=np.ones_like(power), where=power > 0.0), 0.0, 1.0)


def _nearby(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """Weighted mean around each pixel; pixels of value 0 beyond the picture cancel in ratios."""
    import cv2

    size = 2 * int(REACH * WINDOW_PX + 0.5) + 1
    return np.asarray(cv2.GaussianBlur(image, (size, size), WINDOW_PX, borderType=cv2.BORDER_CONSTANT))
