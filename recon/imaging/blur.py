"""Blur of a picture in pixels: by cause, against the bound p/m, and by comparison with a known scene."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from recon.imaging.picture import Picture
from scanner.arguments import check_flags, check_numbers
from scanner.arrays import Array
from scanner.errors import BadInput

SHARP_FRACTION = 0.99
"""Fraction of the scan within the bound p/m from which a picture is called sharp: blur in the remaining hundredth of
the samples is not visible."""

MAX_MAGNIFICATION_ERROR = 0.1
"""Largest deviation from 1 of the magnification that is fitted when a picture is compared with its scene. A device that
is off by its tolerances magnifies by 6 % (docs/explanation/image_phase.md). Without a bound the fit stretches a scene
that the picture does not show."""


def phase_bound(p: float, m: float) -> float:
    """Return p/m: the phase error [rad] that displaces no sample by more than ``p`` pixels.

    Args:
        p: tolerated displacement [px].
        m: half the number of pixels across.

    Raises:
        BadInput: one of them is no positive number.

    Source:
        Chen et al. (2020), eq (7).
    """
    check_numbers(p=p, m=m)
    if not (p > 0.0 and m > 0.0):
        raise BadInput(f"p = {p} and m = {m}", hint="give positive numbers of pixels")
    return p / m


def within_bound(limit: float, error: Array | None = None, sd: Array | None = None, noise_sd: float = 0.0) -> float:
    """Return the fraction of the scan in which the phase error is within ``limit``.

    Args:
        limit: of the phase error [rad].
        error: phase errors, shape (n,) [rad], where the truth is known; those within the limit are counted.
        sd: otherwise standard deviations, shape (n,) [rad]; the normal probability of the limit is averaged.
        noise_sd: standard deviation of noise that is added to either [rad].

    Raises:
        ValueError: neither ``error`` nor ``sd`` is given.
    """
    if error is not None and noise_sd == 0.0:
        return float(np.mean(np.abs(error) <= limit))
    if error is None and sd is None:
        raise ValueError("give errors or standard deviations")
    middle = np.zeros(1) if error is None else np.abs(error)
    spread = math.sqrt(2.0) * np.hypot(np.zeros(1) if sd is None else sd, noise_sd)
    return float(np.mean([_central_probability(limit, m, s) for m, s in np.broadcast(middle, spread)]))


def _central_probability(limit: float, middle: float, spread: float) -> float:
    """Probability that a normal value around ``middle`` is within ±limit; spread: √2 standard deviations."""
    if spread == 0.0:
        return float(abs(middle) <= limit)
    return 0.5 * (math.erf((limit - middle) / spread) + math.erf((limit + middle) / spread))


def blur_by_cause(
    amplitude: float,
    half_angle: float,
    pixels: int,
    phase: Array,
    amplitude_error: Array,
    optics_px: float = 0.0,
    sample_px: float = 0.0,
    sensor_px: float = 0.0,
) -> dict[str, float]:
    """Return the displacement of samples along one axis by cause, rms over the scan [px].

    A sample at theta = A sin(alpha) is displaced by A cos(alpha) dphi + dA sin(alpha). Over a period the two terms are
    uncorrelated and each has half its peak power. Gridding places a sample uniformly within one pixel: variance 1/12.
    The detector is assumed to sample instants; the blur of an integrating detector belongs to ``optics_px``.

    Args:
        amplitude: of the motion [rad].
        half_angle: of the field [rad].
        pixels: across the field.
        phase: phase errors, or their standard deviations, any shape [rad].
        amplitude_error: relative errors of the amplitude about their mean, any shape. A uniform error is a
            magnification and no blur.
        optics_px: standard deviation of the spot [px].
        sample_px: standard deviation of the position of the sample, rms over the scan [px].
        sensor_px: standard deviation of the noise in single samples of the angle [px].

    Returns:
        ``phase``, ``amplitude``, ``sampling``, ``optics``, ``sample``, ``sensor``, and ``total``, their sum in
        quadrature.
    """
    scale = 0.5 * pixels * amplitude / half_angle
    causes = {
        "phase": scale * math.sqrt(0.5 * float(np.mean(np.square(phase)))),
        "amplitude": scale * math.sqrt(0.5 * float(np.mean(np.square(amplitude_error)))),
        "sampling": math.sqrt(1.0 / 12.0),
        "optics": optics_px,
        "sample": sample_px,
        "sensor": sensor_px,
    }
    return causes | {"total": math.sqrt(sum(value**2 for value in causes.values()))}


@dataclass(frozen=True)
class SceneComparison:
    """Difference of a picture from the scene it shows.

    Attributes:
        rms: over visited pixels after a fit of gain and offset, in standard deviations of the scene.
        magnification_x, magnification_y: a feature at s of the scene appears at magnification * s in the picture;
            within MAX_MAGNIFICATION_ERROR of 1.
    """

    rms: float
    magnification_x: float
    magnification_y: float


def compare_with_scene(picture: Picture, scene: Array, flip_x: bool = False, flip_y: bool = False) -> SceneComparison:
    """Compare a picture with the scene, after a fit of gain, offset and a magnification of each axis.

    An amplitude error of 1 % displaces the edge of a 400 pixel picture by 2 pixels and blurs nothing. The magnification
    is therefore fitted, within 10 % of 1, and reported separately. Visited pixels whose value is not finite are left
    out.

    Args:
        picture: of one detector; several are averaged.
        scene: noiseless, shape (H, W) of any resolution, over the same field.
        flip_x, flip_y: whether the picture is mirrored.

    Raises:
        BadInput: an argument is of a wrong type or shape, no visited pixel is finite, or picture or scene have one
            value only.
    """
    from scipy.ndimage import map_coordinates

    scene = _checked_scene(picture, scene)
    check_flags(flip_x=flip_x, flip_y=flip_y)
    image = np.asarray(picture.image if picture.image.ndim == 2 else picture.image.mean(-1), np.float64)
    image = image[:: -1 if flip_y else 1, :: -1 if flip_x else 1]
    count = picture.coverage[:: -1 if flip_y else 1, :: -1 if flip_x else 1]
    rows, columns = np.nonzero((count > 0) & np.isfinite(image))
    if not rows.size:
        raise BadInput("no pixel of the picture was visited and is finite")
    values, weight = image[rows, columns], np.ones(rows.size)
    for name, compared in (("picture", values), ("scene", scene)):
        if np.ptp(compared) == 0.0:
            raise BadInput("has no contrast: all its values are equal", channel=name, hint="compare where it has some")
    y = 2.0 * (rows + 0.5) / image.shape[0] - 1.0
    x = 2.0 * (columns + 0.5) / image.shape[1] - 1.0
    # A pixel is a mean over its area, so the scene is first averaged to the resolution of the picture.
    smooth = _resample_scene(scene, image.shape)

    def sample_scene(scale: Array, of: Array = smooth, step: int = 1) -> Array:
        row = (y[::step] / scale[1] + 1.0) * of.shape[0] / 2.0 - 0.5
        column = (x[::step] / scale[0] + 1.0) * of.shape[1] / 2.0 - 0.5
        return np.asarray(map_coordinates(of, [row, column], order=1, mode="nearest"), np.float64)

    # Fine texture has many local minima. A grid of scales over coarse texture selects the right one.
    coarse, step = _resample_scene(scene, np.array(image.shape) / 8.0), max(1, values.size // 10_000)
    trials = 1.0 + MAX_MAGNIFICATION_ERROR * np.mgrid[-5:6, -5:6].reshape(2, -1).T / 5.0
    scale = trials[int(np.argmax([_correlation(sample_scene(t, coarse, step), values[::step]) for t in trials]))]
    for _ in range(8):
        model = sample_scene(scale)
        slopes = [(sample_scene(scale + d) - sample_scene(scale - d)) / 4e-3 for d in 2e-3 * np.eye(2)]
        gain = _fit_linear([model, weight], values)[0]
        fitted = _fit_linear([model, weight, gain * slopes[0], gain * slopes[1]], values)
        before, scale = scale, scale + np.clip(fitted[2:], -0.02, 0.02)
        scale = np.clip(scale, 1.0 - MAX_MAGNIFICATION_ERROR, 1.0 + MAX_MAGNIFICATION_ERROR)
        if np.abs(scale - before).max() < 1e-6:
            break
    model = sample_scene(scale)
    gain, offset = _fit_linear([model, weight], values)
    residual = float(np.sqrt(np.mean((values - gain * model - offset) ** 2)))
    contrast = abs(float(gain)) * float(np.std(model))
    return SceneComparison(residual / max(contrast, 1e-300), float(scale[0]), float(scale[1]))


def _checked_scene(picture: object, scene: object) -> Array:
    """The scene as float64, shape (H, W), after a check of the type of both."""
    if not isinstance(picture, Picture):
        hint = "give a Picture, such as lissajous.map_samples returns"
        raise BadInput(f"is a {type(picture).__name__}, no picture", channel="picture", hint=hint)
    numbers = np.asarray(scene)
    if numbers.dtype.kind not in "biuf" or numbers.ndim != 2 or not np.isfinite(numbers).all():
        what = f"is an array of {numbers.dtype} of shape {numbers.shape}"
        raise BadInput(what, channel="scene", hint="give finite real numbers of shape (height, width)")
    return np.asarray(numbers, np.float64)


def _fit_linear(basis: list[Array], values: Array) -> Array:
    """Least squares by the normal equations, which for few long columns are faster than a decomposition."""
    gram = np.array([[np.sum(a * b) for b in basis] for a in basis])
    return np.asarray(np.linalg.lstsq(gram, np.array([np.sum(a * values) for a in basis]), rcond=None)[0])


def _correlation(a: Array, b: Array) -> float:
    from_a, from_b = a - np.mean(a), b - np.mean(b)
    return float(np.sum(from_a * from_b) / max(math.sqrt(np.sum(from_a**2) * np.sum(from_b**2)), 1e-300))


def _resample_scene(scene: Array, shape: tuple[int, ...] | Array) -> Array:
    """The scene smoothed as by a mean over the pixels of a picture of the given shape."""
    import cv2
    from scipy.ndimage import gaussian_filter

    # A much finer scene is averaged in blocks first, because a filter as wide as a coarse pixel takes seconds.
    height, width = np.minimum(scene.shape, np.ceil(4.0 * np.asarray(shape))).astype(int)
    size = int(width), int(height)
    scene = np.asarray(cv2.resize(np.asarray(scene, np.float64), size, interpolation=cv2.INTER_AREA), np.float64)
    # A Gaussian with the variance of a box of k points, (k² - 1) / 12. A box of even k would shift by half a point.
    finer = np.array(scene.shape) / np.asarray(shape)
    return np.asarray(gaussian_filter(scene, np.sqrt(np.maximum(finer**2 - 1.0, 0.0) / 12.0), mode="nearest"))
