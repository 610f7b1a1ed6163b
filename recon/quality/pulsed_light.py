"""Light that comes in pulses, between which the samples of the detector are dark."""

from __future__ import annotations

import numpy as np

from recon.imaging.gridding import map_samples
from recon.imaging.picture import Grid, Picture
from recon.imaging.wild_samples import usable_samples, wild_limits
from recon.quality.detector_gaps import MAX_SLOPE, MIN_COMMON_PIXELS, QUIET_SD_SHARE
from scanner.arrays import Array, Mask
from scanner.channel import Channel
from scanner.device import AXES
from scanner.motion import Motion

SEARCHED_SAMPLES = 1 << 16
"""Samples, from the start, in which pulses are searched."""

PARTS = 4
"""Parts of these in which the same samples have to be dark: in a scene of few bright places other ones are in each."""

MAX_PULSE_SAMPLES = 64
"""Longest period of the pulses that is searched: each of its samples then comes 256 times in a part."""

MIN_CONTRAST = 4.0
"""Variance of the means of the other samples in the common pixels, over that of their noise, from which the scene has
structure there that the dark samples would show."""


def describe_pulsed_light(beam: Motion, intensity: Channel, grid: Grid) -> list[str]:
    """A line if some of every few samples do not show the scene, as between the pulses of a light source.

    Periods in which the motion repeats are left out: a sample of these always shows the same places. Where it repeats
    in a multiple, a sample shows few places, which may be dark: there the other samples have to show a scene.

    Args:
        beam: the motion.
        intensity: of one or several detectors.
        grid: the pixels.
    """
    values = intensity.read(0, min(intensity.size, SEARCHED_SAMPLES))
    usable = usable_samples(values, wild_limits(values))
    values = np.where(usable, values.reshape(len(values), -1), np.nan)
    cycles = np.array([float(np.median(axis.frequency)) for axis in beam.axes.values()]) / intensity.sample_rate
    x, y = (beam.axes[axis].angle.read(0, len(values)) for axis in AXES)
    most, found = 0.0, 0
    for period in range(2, min(MAX_PULSE_SAMPLES, len(values) // (2 * PARTS)) + 1):
        count = len(values) // (PARTS * period)
        turns = period * np.outer(np.arange(1, MAX_PULSE_SAMPLES + 1), cycles)  # in multiples of the period
        repeats = (np.abs(turns - np.round(turns)) * count < 1.0).any(axis=1)
        if repeats[0]:
            continue
        dark = _dark_samples(values[: PARTS * count * period].reshape(PARTS, count, period, -1))
        if not dark.mean() > most:
            continue
        off = dark[np.arange(len(values)) % period]
        pictures = (map_samples(x[part], y[part], values[part], grid) for part in (off, ~off))
        if not repeats.any() or _misses_scene(*pictures):
            most, found = float(dark.mean()), period
    if not found:
        return []
    return [
        f"intensity: {round(most * found)} of every {found} samples do not show the scene that the others show, so "
        "that the picture is wrong: the light is pulsed, and they are taken between its pulses; set these samples to "
        "NaN, which leaves them out"
    ]


def _dark_samples(values: Array) -> Mask:
    """Which samples of a period are dark in all parts, none where others are in each; shape (samples,).

    Samples of which most values are missing do not count as dark.

    Args:
        values: shape (parts, periods, samples, detectors); missing ones are not finite.
    """
    known = np.isfinite(values)
    number = np.maximum(known.sum(axis=1, keepdims=True), 1)
    with np.errstate(over="ignore", invalid="ignore"):  # of damaged samples
        mean = np.where(known, values, 0.0).sum(axis=1, keepdims=True) / number
        squares = np.where(known, values - mean, 0.0) ** 2
        scatter = np.sqrt(squares.sum(axis=1) / number[:, 0]).max(axis=-1)
    mostly_known = (known.mean(axis=1) > 0.5).any(axis=-1)  # the scatter of few samples is small by chance
    dark = mostly_known & (scatter < QUIET_SD_SHARE * scatter.max(axis=1, keepdims=True))
    return np.asarray(dark[0] & (dark == dark[0]).all())


def _misses_scene(off: Picture, on: Picture) -> bool:
    """Whether every detector's structure in ``on`` is missing in ``off``, in the pixels that both visited."""
    both = (off.coverage > 0) & (on.coverage > 1)
    if np.count_nonzero(both) < MIN_COMMON_PIXELS:
        return False
    dark, bright = (picture.image[both].reshape(np.count_nonzero(both), -1).astype(float) for picture in (off, on))
    dark, bright = dark - dark.mean(axis=0), bright - bright.mean(axis=0)
    slope = (dark * bright).sum(axis=0) / np.maximum((bright**2).sum(axis=0), 1e-300)
    neighbours = np.diff(on.image, axis=1).reshape(on.image.shape[0], on.image.shape[1] - 1, -1)
    noise = np.nanmedian(np.abs(neighbours), axis=(0, 1)) ** 2
    return bool((slope < MAX_SLOPE).all() and ((bright**2).mean(axis=0) > MIN_CONTRAST * noise).all())
