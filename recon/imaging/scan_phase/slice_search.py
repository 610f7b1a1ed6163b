"""The search over half a turn (``phase_search``) in slices of a scan whose motion is known except for its phase."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from recon.imaging.scan_phase.bidirectional_phase import slow_period
from recon.imaging.scan_phase.phase_search import (
    PERIODS_PER_SEARCH,
    PHASE_CELLS,
    PhaseFound,
    PhaseMatches,
    best_reflection,
    cut_slices,
    match_phases,
)
from recon.imaging.scan_phase.slice_matches import axis_phases
from scanner.channel import Channel
from scanner.device import AXES
from scanner.motion import Motion

MAX_SEARCHED_SLICES = 64
"""Slices, spread over the scan, that are searched: 0.02 s of computing time each at 1e5 samples."""

SEARCH_ROUNDING_SD_RAD = np.pi / PHASE_CELLS / np.sqrt(12.0)
"""Standard deviation of a phase found by the rounding to a cell of the search, 0.4 degrees [rad]: the least it has."""


class SearchedSlice(NamedTuple):
    """Correlations over all phases of one slice.

    Attributes:
        time: of its middle, after the first sample of the intensity [s].
        matches: by axis.
    """

    time: float
    matches: dict[str, PhaseMatches]

    def phase(self, axis: str) -> PhaseFound:
        """Phase of one axis for which the samples of opposite directions agree best."""
        return best_reflection(self.matches[axis])


def searched_slices(beam: Motion, intensity: Channel) -> list[tuple[int, int]]:
    """Samples (first, stop) of the slices of a scan that are searched."""
    slices = cut_slices(intensity, PERIODS_PER_SEARCH * slow_period(beam))
    return slices[:: -(-len(slices) // MAX_SEARCHED_SLICES)]


def search_slices(beam: Motion, intensity: Channel, slices: list[tuple[int, int]]) -> list[SearchedSlice]:
    """Search the slices that hold samples that differ.

    Args:
        beam: motion whose angles are on the intensity's clock.
        intensity: shape (n,) or (n, detectors); detectors are averaged.
        slices: samples (first, stop) of each.
    """
    found = []
    for first, stop in slices:
        samples = axis_phases(beam, intensity, first, stop)
        if samples is not None:
            (x, y), values = samples
            matches = dict(zip(AXES, match_phases(x, y, values), strict=True))
            found.append(SearchedSlice(0.5 * (first + stop - 1) / intensity.sample_rate, matches))
    return found
