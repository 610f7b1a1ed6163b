"""Scans of a sample that moves in a known way."""

import cv2
import numpy as np

from phantoms.optics import sample_scene
from recon.imaging.sample_motion.placed_samples import PlacedSamples
from recon.imaging.sample_motion.rigid_motion import SampleMotion

RATE, PIXELS = 1.5e6, 96
FREQUENCIES = 6700.0, 5450.0
PERIOD = RATE / FREQUENCIES[1]
BLOCKS = 160


def scene() -> np.ndarray:
    """Detail of a few pixels with a standard deviation of a fifth of the mean."""
    noise = np.random.default_rng(0).standard_normal((PIXELS + 64, PIXELS + 64))
    detail = cv2.GaussianBlur(noise, (0, 0), 2.5)
    return np.asarray(1.0 + 0.2 * detail / detail.std())


def scan(
    displacement: np.ndarray, photons: float = 300.0, blocks: int = BLOCKS, picture: np.ndarray | None = None
) -> PlacedSamples:
    """A scan of a sample whose displacement [px] is given at equal times, of :func:`scene` without a picture."""
    time = np.arange(round(blocks * PERIOD)) / RATE
    x, y = (0.5 * PIXELS * (1.0 + np.sin(2.0 * np.pi * f * time + f)) for f in FREQUENCIES)
    at = np.linspace(0.0, len(displacement) - 1.0, time.size)
    u, v = (np.interp(at, np.arange(len(displacement)), each) for each in displacement.T)
    picture = scene() if picture is None else picture
    half = 0.5 * len(picture)
    light = sample_scene(picture, x - u - 0.5 * PIXELS, y - v - 0.5 * PIXELS, half, half)
    counts = np.random.default_rng(1).poisson(photons * np.maximum(light, 0.0))
    return PlacedSamples.from_arrays(x, y, counts)


def error_of(found: SampleMotion, displacement: np.ndarray) -> np.ndarray:
    """Error at the knots of the motion, without its mean."""
    at = (found.sample + 0.5) / (BLOCKS * PERIOD) * (len(displacement) - 1)
    true = np.column_stack([np.interp(at, np.arange(len(displacement)), each) for each in displacement.T])
    error = found.shift - true
    return np.asarray(error - np.median(error, axis=0))


def beads(number: int, sd: float) -> np.ndarray:
    """Beads of a standard deviation [px] before a dark background, some of them outside the field."""
    side = PIXELS + 64
    down, across = np.mgrid[:side, :side].astype(float)
    rng = np.random.default_rng(7)
    places, peaks = rng.uniform(0, side, (number, 2)), rng.uniform(0.3, 1.0, number)
    spots = [
        peak * np.exp(-0.5 * ((across - x) ** 2 + (down - y) ** 2) / sd**2)
        for (x, y), peak in zip(places, peaks, strict=True)
    ]
    return np.asarray(0.02 + np.sum(spots, axis=0))
