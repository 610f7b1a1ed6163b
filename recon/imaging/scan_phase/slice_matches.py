"""Correlations of the samples of one place, over the phases of the motion, in slices of a scan."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from recon.imaging.scan_phase.bidirectional_phase import quadrature, slow_period
from recon.imaging.scan_phase.phase_search import PhaseMatches, match_phases
from scanner.arrays import Array
from scanner.channel import Channel
from scanner.device import AXES
from scanner.motion import Motion

PERIODS_PER_SLICE = 25
"""Periods of the slower axis whose samples are compared: they cover the field, and clocks hardly run apart in them."""

MIN_SLICE_SAMPLES = 10_000
"""Samples of a slice, if the scan has as many: a slow channel, such as the shots of a range finder at 100 kHz, visits a
half of the 16 384 cells of phase by them, so that more than 1000 are visited in both directions."""

MAX_SLICES = 8
"""Slices, spread over the scan, that are compared: 0.02 s of computing time each at 1e5 samples."""

MIN_PERIODS = 3
"""Periods of the slower axis from which a scan is compared: it then passes most places in both directions."""

NEARBY_PERIODS = 1.0 / 16.0
"""Distance in periods of the faster axis of samples whose correlation shows that the intensity holds more than noise:
eight cells of phase, so that coarse detail alone keeps them alike."""


class SliceMatches(NamedTuple):
    """Correlations of one slice.

    Attributes:
        axes: over the phases of x and y.
        persistence: of samples a period of the faster axis apart.
        nearby: of samples ``NEARBY_PERIODS`` apart.
    """

    axes: tuple[PhaseMatches, PhaseMatches]
    persistence: float
    nearby: float


def match_slices(beam: Motion, intensity: Channel) -> list[SliceMatches]:
    """Return the correlations of all slices that hold samples that differ.

    Args:
        beam: motion whose angles are on the intensity's clock.
        intensity: shape (n,) or (n, detectors); detectors are averaged.
    """
    found = (_match_slice(beam, intensity, *part) for part in _slices(beam, intensity))
    return [match for match in found if match is not None]


def _slices(beam: Motion, intensity: Channel) -> list[tuple[int, int]]:
    """Samples (first, stop) of the slices whose samples are compared; none of a scan that is too short."""
    period = slow_period(beam) * intensity.sample_rate
    if not period * MIN_PERIODS <= intensity.size:
        return []
    length = min(max(round(PERIODS_PER_SLICE * period), MIN_SLICE_SAMPLES), intensity.size)
    count = min(max(intensity.size // max(length, 1), 1), MAX_SLICES)
    firsts = np.linspace(0, intensity.size - length, count).astype(int).tolist()
    return [(first, first + length) for first in firsts]


def axis_phases(beam: Motion, intensity: Channel, first: int, stop: int) -> tuple[tuple[Array, Array], Array] | None:
    """Phases of both axes [rad] and intensity of a slice, each of shape (n,); None without samples that differ."""
    values = intensity.read(first, stop)
    values = values.mean(axis=1) if values.ndim == 2 else values
    angles = [beam.axes[name].angle.read(first, stop) for name in AXES]
    known = np.all([np.isfinite(each) for each in (values, *angles)], axis=0)
    if known.sum() < 2 or np.ptp(values[known]) == 0.0:
        return None
    # The largest angle as amplitude makes a phase a matter of place and direction alone, in a spiral too.
    x, y = (np.arctan2(angle, quadrature(angle, float(np.abs(angle[known]).max()))) for angle in angles)
    known &= np.isfinite(x) & np.isfinite(y)  # the quadrature is not known next to an unknown angle
    if known.sum() < 2:
        return None
    return (x[known], y[known]), values[known]


def _match_slice(beam: Motion, intensity: Channel, first: int, stop: int) -> SliceMatches | None:
    """Correlations of one slice; None without samples that differ."""
    found = axis_phases(beam, intensity, first, stop)
    if found is None:
        return None
    phases, values = found
    period = intensity.sample_rate / max(float(np.median(beam.axes[name].frequency)) for name in AXES)
    persistence, nearby = (_autocorrelation(values, max(1, round(each * period))) for each in (1.0, NEARBY_PERIODS))
    return SliceMatches(match_phases(*phases, values), persistence, nearby)


def _autocorrelation(values: Array, lag: int) -> float:
    """Correlation of samples ``lag`` apart; 0 if there are none that differ."""
    first, second = values[:-lag], values[lag:]
    if first.size < 2 or min(np.ptp(first), np.ptp(second)) == 0.0:
        return 0.0
    return float(np.corrcoef(first, second)[0, 1])
