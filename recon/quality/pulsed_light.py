"""Light that comes in pulses, between which the samples of the detector are dark."""

from __future__ import annotations

import numpy as np

from recon.imaging.wild_samples import usable_samples, wild_limits
from recon.quality.detector_gaps import QUIET_SD_SHARE
from scanner.arrays import Array
from scanner.channel import Channel
from scanner.motion import Motion

SEARCHED_SAMPLES = 1 << 16
"""Samples, from the start, in which pulses are searched."""

PARTS = 4
"""Parts of these in which the same samples have to be dark: in a scene of few bright places other ones are in each."""

MAX_PULSE_SAMPLES = 64
"""Longest period of the pulses that is searched: each of its samples then comes 256 times in a part."""


def describe_pulsed_light(beam: Motion, intensity: Channel) -> list[str]:
    """A line if some of every few samples do not show the scene, as between the pulses of a light source.

    Periods in whose multiples the motion repeats are left out: a sample of these always shows the same places.

    Args:
        beam: the motion.
        intensity: of one or several detectors.
    """
    values = intensity.read(0, min(intensity.size, SEARCHED_SAMPLES))
    usable = usable_samples(values, wild_limits(values))
    values = np.where(usable, values.reshape(len(values), -1), np.nan)
    cycles = np.array([float(np.median(axis.frequency)) for axis in beam.axes.values()]) / intensity.sample_rate
    most, found = 0.0, 0
    for period in range(2, min(MAX_PULSE_SAMPLES, len(values) // (2 * PARTS)) + 1):
        count = len(values) // (PARTS * period)
        if (np.abs(cycles * period - np.round(cycles * period)) * count < 1.0).any():
            continue
        share = _dark_share(values[: PARTS * count * period].reshape(PARTS, count, period, -1))
        if share > most:
            most, found = share, period
    if not found:
        return []
    return [
        f"intensity: {round(most * found)} of every {found} samples do not show the scene that the others show, so "
        "that the picture is wrong: the light is pulsed, and they are taken between its pulses; set these samples to "
        "NaN, which leaves them out"
    ]


def _dark_share(values: Array) -> float:
    """Share of the samples of a period that are dark in all parts, 0 where others are in each.

    Args:
        values: shape (parts, periods, samples, detectors).
    """
    with np.errstate(over="ignore", invalid="ignore"):  # of damaged samples
        scatter = values.std(axis=1).max(axis=-1)
    dark = scatter < QUIET_SD_SHARE * scatter.max(axis=1, keepdims=True)  # not where a sample is missing: NaN
    return float(dark[0].mean()) if (dark == dark[0]).all() else 0.0
