"""Blur in pixels: by its causes, against the bound p/m, and measured in the picture itself."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon.mapping import Picture
from scanner.errors import BadInput

Array = NDArray[np.float64]


def bound(p: float, m: float) -> float:
    """Largest phase error [rad] that moves no sample by more than ``p`` pixels, 2m across: p/m (chen2020 eq 7)."""
    return p / m


def within_bound(limit: float, error: Array | None = None, sd: Array | None = None) -> float:
    """Fraction of the scan in which the phase is within ``limit`` [rad].

    Args:
        error: phase errors [rad] where the truth is known: counted.
        sd: else standard deviations [rad]: the probability by the normal law, averaged.

    Raises:
        ValueError: neither is given.
    """
    if error is not None:
        return float(np.mean(np.abs(error) <= limit))
    if sd is None:
        raise ValueError("give errors or standard deviations")
    return float(np.mean([math.erf(limit / (math.sqrt(2.0) * s)) if s > 0.0 else 1.0 for s in sd]))


def parts(
    amplitude: float,
    half_angle: float,
    pixels: int,
    phase: Array,
    swing: Array,
    optics_px: float = 0.0,
) -> dict[str, float]:
    """Displacement of samples along one axis by cause, rms over the scan [px]; the causes add in quadrature.

    theta = A sin(alpha) is moved by A cos(alpha) dphi + dA sin(alpha): over a period the two are uncorrelated and each
    counts half. The law of the pixels (ceil, chen2020 eq 2) spreads a sample evenly over one pixel: variance 1/12.
    The detector is taken to sample instants; one that integrates belongs to the optics.

    Args:
        amplitude: of the motion [rad]. half_angle: of the field [rad]. pixels: across it.
        phase: phase errors, or their standard deviations, any shape [rad].
        swing: relative errors of the amplitude about its mean, any shape; a uniform one is magnification, no blur.
        optics_px: standard deviation of the spot [px].
    """
    scale = 0.5 * pixels * amplitude / half_angle
    found = {
        "phase": scale * math.sqrt(0.5 * float(np.mean(np.square(phase)))),
        "amplitude": scale * math.sqrt(0.5 * float(np.mean(np.square(swing)))),
        "sampling": math.sqrt(1.0 / 12.0),
        "optics": optics_px,
    }
    return found | {"total": math.sqrt(sum(value**2 for value in found.values()))}


@dataclass(frozen=True)
class PictureError:
    """A picture against the scene it shows.

    Attributes:
        rms: over visited pixels, in units of the scene's own standard deviation, gain and offset fitted.
        magnification_x, magnification_y: of the picture: a feature at s of the scene stands at magnification * s.
    """

    rms: float
    magnification_x: float
    magnification_y: float


def picture_error(picture: Picture, scene: Array, flip_x: bool = False, flip_y: bool = False) -> PictureError:
    """How far a picture is from the scene, once gain, offset and a uniform magnification of each axis are taken out.

    An amplitude that is off by 1 % moves the edge of a 400 pixel picture by 2 pixels and blurs nothing; so scale is
    fitted, within 5 % of 1, and told apart.

    Args:
        picture: one detector, or the mean of several.
        scene: noiseless, shape (H, W) of any resolution, covering the same field.
        flip_x, flip_y: the picture is mirrored.

    Raises:
        BadInput: no pixel was visited.
    """
    from scipy.ndimage import map_coordinates

    image = np.asarray(picture.image if picture.image.ndim == 2 else picture.image.mean(-1), np.float64)
    image = image[:: -1 if flip_y else 1, :: -1 if flip_x else 1]
    count = picture.coverage[:: -1 if flip_y else 1, :: -1 if flip_x else 1]
    rows, columns = np.nonzero(count)
    if not rows.size:
        raise BadInput("no pixel of the picture was visited")
    seen, weight = image[rows, columns], np.ones(rows.size)
    y = 2.0 * (rows + 0.5) / image.shape[0] - 1.0
    x = 2.0 * (columns + 0.5) / image.shape[1] - 1.0
    # A pixel is a mean over its area: the scene is averaged to the picture's own resolution first.
    smooth = _averaged(scene, image.shape)

    def looked_up(scale: Array, of: Array = smooth, step: int = 1) -> Array:
        row = (y[::step] / scale[1] + 1.0) * of.shape[0] / 2.0 - 0.5
        column = (x[::step] / scale[0] + 1.0) * of.shape[1] / 2.0 - 0.5
        return np.asarray(map_coordinates(of, [row, column], order=1, mode="nearest"), np.float64)

    # Fine texture has many local minima; over coarse texture a few scales tell which one it is.
    coarse, step = _averaged(scene, np.array(image.shape) / 8.0), max(1, seen.size // 10_000)
    trials = 1.0 + 0.01 * np.mgrid[-5:6, -5:6].reshape(2, -1).T
    scale = trials[int(np.argmax([_correlation(looked_up(t, coarse, step), seen[::step]) for t in trials]))]
    for _ in range(8):
        model = looked_up(scale)
        slopes = [(looked_up(scale + d) - looked_up(scale - d)) / 4e-3 for d in 2e-3 * np.eye(2)]
        gain = _fit([model, weight], seen)[0]
        fitted = _fit([model, weight, gain * slopes[0], gain * slopes[1]], seen)
        scale = scale + np.clip(fitted[2:], -0.02, 0.02)
        if np.abs(fitted[2:]).max() < 1e-6:
            break
    model = looked_up(scale)
    gain, offset = _fit([model, weight], seen)
    residual = float(np.sqrt(np.mean((seen - gain * model - offset) ** 2)))
    contrast = abs(float(gain)) * float(np.std(model))
    return PictureError(residual / max(contrast, 1e-300), float(scale[0]), float(scale[1]))


def _fit(basis: list[Array], values: Array) -> Array:
    """Least squares by the normal equations: a handful of long columns is no work for a threaded decomposition."""
    gram = np.array([[np.sum(a * b) for b in basis] for a in basis])
    return np.asarray(np.linalg.lstsq(gram, np.array([np.sum(a * values) for a in basis]), rcond=None)[0])


def _correlation(a: Array, b: Array) -> float:
    from_a, from_b = a - np.mean(a), b - np.mean(b)
    return float(np.sum(from_a * from_b) / max(math.sqrt(np.sum(from_a**2) * np.sum(from_b**2)), 1e-300))


def _averaged(scene: Array, shape: tuple[int, ...] | Array) -> Array:
    """What a picture of the given shape can show of a scene: smoothed to the variance of a mean over its pixels."""
    import cv2
    from scipy.ndimage import gaussian_filter

    # What is far finer than the picture is averaged in blocks first: a filter as wide as a coarse pixel takes seconds.
    height, width = np.minimum(scene.shape, np.ceil(4.0 * np.asarray(shape))).astype(int)
    size = int(width), int(height)
    scene = np.asarray(cv2.resize(np.asarray(scene, np.float64), size, interpolation=cv2.INTER_AREA), np.float64)
    # A box of k points has the variance (k² - 1) / 12; itself it would have no middle where k is even.
    finer = np.array(scene.shape) / np.asarray(shape)
    return np.asarray(gaussian_filter(scene, np.sqrt(np.maximum(finer**2 - 1.0, 0.0) / 12.0), mode="nearest"))
