"""Notes on the samples of an intensity whose values are doubtful or do not show the scene, a line each."""

from __future__ import annotations

import numpy as np

from estimation.rail import upper_rail
from recon.imaging.picture import Grid, detector_names
from recon.imaging.saturation import COUNT_UNITS, detector_rails
from recon.imaging.wild_samples import MAX_CHECKED_SAMPLES, find_wild_in_place, find_wild_samples, wild_limits
from scanner.arrays import Array
from scanner.channel import Channel
from scanner.device import AXES
from scanner.motion import Motion
from scanner.wording import counted, percent, quantity

LOGARITHMIC_UNIT = "dB"
"""Beginning of the units of logarithms: dB, dBm, dBV."""

MIN_NEGATIVE_SHARE = 0.95
"""Share of negative samples from which a voltage is taken for that of an inverting detector. A detector that is coupled
without its mean has about a half."""

MAX_STEP_OF_FIELD = 0.1
"""Way of the beam between two samples, of the field's width, from which a note says so: ten samples from edge to edge
show no picture if each is an average over the way."""

STEP_QUANTILE = 0.9
"""Quantile of the ways that is compared: the flyback of a raster is left out."""

MIN_RISES = 1000
"""Changes of an intensity, all in one direction, from which it is a running sum: noise alone has as many of either."""


def describe_intensity(beam: Motion, intensity: Channel, grid: Grid) -> list[str]:
    """Lines on the values of an intensity that are doubtful.

    Args:
        beam: motion whose angles are on the intensity's clock.
        intensity: shape (n,) or (n, detectors).
        grid: the pixels.
    """
    return [
        *describe_infinite(intensity),
        *describe_wild_samples(intensity, beam, grid),
        *describe_negative_counts(intensity),
        *describe_polarity(intensity),
        *describe_logarithms(intensity),
    ]


def describe_running_sums(intensity: Channel) -> list[str]:
    """A line for each detector whose samples only rise, or only fall: a counter that is never reset."""
    lines = []
    for name, column in _checked_columns(intensity):
        steps = np.diff(column[np.isfinite(column)])
        rises, falls = int(np.sum(steps > 0.0)), int(np.sum(steps < 0.0))
        if max(rises, falls) >= MIN_RISES and min(rises, falls) == 0:
            lines.append(
                f"{name}: {'rises' if rises else 'falls'} at all of the {max(rises, falls)} samples at which it "
                "changes, so that it is a running sum (a counter or an integrator), and the picture is wrong: record "
                "the difference of successive samples"
            )
    return lines


def describe_saturation(intensity: Channel) -> list[str]:
    """A line for each detector of which many samples stand exactly at the largest value.

    Args:
        intensity: shape (n,) or (n, detectors).
    """
    rails = detector_rails(intensity)
    names = _detector_names(intensity)
    checked = min(intensity.size, MAX_CHECKED_SAMPLES)
    return [
        f"{name}: {rail[1] / checked:.2%} of the samples stand at the largest value, "
        f"{quantity(rail[0], intensity.unit)}: "
        "the detector is saturated there, the picture shows no detail, and its standard deviation is not known; "
        "lower its gain or the light"
        for name, rail in zip(names, rails, strict=True)
        if rail is not None
    ]


def describe_lower_rail(intensity: Channel) -> list[str]:
    """A line for each detector of which many samples stand exactly at the smallest value, which is not 0.

    Samples at 0 are no error: darkness of a detector that counts photons.

    Args:
        intensity: shape (n,) or (n, detectors).
    """
    lines = []
    for name, column in _checked_columns(intensity):
        finite = column[np.isfinite(column)]
        rail = upper_rail(-finite) if finite.size else None
        if rail is not None and rail[0] != 0.0 and -rail[0] >= wild_limits(column).low[0]:
            lines.append(
                f"{name}: {rail[1] / len(column):.2%} of the samples stand at the smallest value, "
                f"{quantity(-rail[0], intensity.unit)}: the signal is clipped there, and dark places appear too "
                "bright; change the offset or the range of the converter"
            )
    return lines


def describe_infinite(intensity: Channel) -> list[str]:
    """A line for infinite samples, which are those of the most light where a type of small range made them."""
    infinite = np.isinf(intensity.read(0, MAX_CHECKED_SAMPLES))
    if not infinite.any():
        return []
    return [
        f"intensity: {percent(infinite.mean())} of the samples are infinite and left out: if they were too large for "
        "their type (float16 ends at 65504), bright places are too dark; store them in another type"
    ]


def describe_wild_samples(intensity: Channel, beam: Motion | None = None, grid: Grid | None = None) -> list[str]:
    """A line for each detector with single samples far from all others; bright points of the scene are none.

    Args:
        intensity: shape (n,) or (n, detectors).
        beam: motion whose angles are on the intensity's clock, grid: the pixels; None where the places of the samples
            are unknown.
    """
    values = intensity.read(0, MAX_CHECKED_SAMPLES)
    limits = wild_limits(values)
    if beam is None or grid is None:
        wild = find_wild_samples(values, limits)
    else:
        wild = find_wild_in_place(values, limits, beam, grid)
    lines = []
    for name, column, own in zip(_detector_names(intensity), values.reshape(len(values), -1).T, wild.T, strict=True):
        if own.any():
            number, share = counted(int(own.sum()), "single sample"), percent(float(own.mean()))
            farthest = column[own][np.argmax(np.abs(column[own] - np.nanmedian(column)))]
            lines.append(
                f"{name}: {number} ({share}) far from all others, "
                f"the farthest {quantity(farthest, intensity.unit)} (median {np.nanmedian(column):.4g}): electric "
                "pulses or errors of a transfer, which make their pixels wrong; replace them by NaN"
            )
    return lines


def describe_negative_counts(intensity: Channel) -> list[str]:
    """A line if samples of an intensity in counts or photons are negative."""
    values = intensity.read(0, MAX_CHECKED_SAMPLES)
    if intensity.unit not in COUNT_UNITS or not (values < 0.0).any():
        return []
    share = percent(float(np.mean(values < 0.0)))
    return [
        f"intensity: {share} of the samples are negative, down to {np.nanmin(values):.4g} "
        f"{intensity.unit}, which counts cannot be: check the offset and whether the integers are unsigned"
    ]


def describe_polarity(intensity: Channel) -> list[str]:
    """A line for each detector of which nearly all samples are negative; counts have ``describe_negative_counts``."""
    if intensity.unit in COUNT_UNITS or intensity.unit.startswith(LOGARITHMIC_UNIT):
        return []
    shares = [(name, float(np.mean(column < 0.0))) for name, column in _checked_columns(intensity)]
    return [
        f"{name}: {share:.0%} of the samples are negative: if the detector's pulses are negative, bright places appear "
        "dark; invert the channel (gain = -1)"
        for name, share in shares
        if share >= MIN_NEGATIVE_SHARE
    ]


def describe_logarithms(intensity: Channel) -> list[str]:
    """A line for an intensity in decibels, whose means are no means of the light."""
    if not intensity.unit.startswith(LOGARITHMIC_UNIT):
        return []
    return [
        f"intensity: is in {intensity.unit}, and a pixel is the mean of logarithms, in which noise makes dark places "
        "darker: convert the samples to a linear unit first"
    ]


def describe_coarse_sampling(beam: Motion, intensity: Channel, grid: Grid) -> list[str]:
    """A line if the beam crosses much of the field between two samples: nothing smaller is resolved along that way."""
    steps = {}
    for axis, half_angle in zip(AXES, (grid.half_angle_x, grid.half_angle_y), strict=True):
        moved = np.abs(np.diff(beam.axes[axis].angle.read(0, min(intensity.size, MAX_CHECKED_SAMPLES))))
        moved = moved[np.isfinite(moved)]
        steps[axis] = float(np.quantile(moved, STEP_QUANTILE)) / (2.0 * half_angle) if moved.size else 0.0
    coarse = [f"{step:.0%} of the field in {axis}" for axis, step in steps.items() if step > MAX_STEP_OF_FIELD]
    if not coarse:
        return []
    return [
        f"intensity: at {intensity.sample_rate:.6g} Hz the beam moves by {' and '.join(coarse)} from one sample to the "
        "next: if the detector averages over that time, the picture shows nothing smaller; record at a higher rate"
    ]


def _checked_columns(intensity: Channel) -> list[tuple[str, Array]]:
    """Name of each detector in messages, and its first ``MAX_CHECKED_SAMPLES`` samples."""
    values = intensity.read(0, MAX_CHECKED_SAMPLES)
    return list(zip(_detector_names(intensity), values.reshape(len(values), -1).T, strict=True))


def _detector_names(intensity: Channel) -> list[str]:
    """Name of each detector in messages."""
    return detector_names(intensity.detectors, intensity.shape[1] if len(intensity.shape) == 2 else 1)
