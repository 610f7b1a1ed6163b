"""Phase errors beyond the reach of the registration, in slices of the scan.

The registration of forward against backward half-periods reaches 15°. An intensity that is later than that, or whose
clock makes it so during the scan, leaves an axis without a phase. ``phase_search`` compares all phases of a slice, to
1.4°, and finds such an error, up to half a turn.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from math import inf, nan, pi
from typing import NamedTuple

import numpy as np

from recon.imaging.scan_phase.phase_agreement import MIN_CONTRADICTION_SD, differs_in_bands
from recon.imaging.scan_phase.phase_error import PhaseError, PhaseEstimate
from recon.imaging.scan_phase.phase_search import (
    MIN_FOUND_FRACTION,
    PhaseFound,
    PhaseMatches,
    best_reflection,
)
from recon.imaging.scan_phase.slice_search import SEARCH_ROUNDING_SD_RAD, search_slices, searched_slices
from scanner.channel import Channel
from scanner.device import AXES
from scanner.motion import Motion

UNDETERMINED = PhaseEstimate(nan, inf)
"""A phase error that the samples do not determine."""


class SearchedPhase(NamedTuple):
    """Phase errors of a motion, searched over half a turn.

    Attributes:
        errors: of each slice; undetermined where samples of opposite directions agree at no phase.
        refuted: names of the axes whose samples agree better at the phases found than at the motion's.
    """

    errors: Sequence[PhaseError]
    refuted: Collection[str]


def search_phase_of(beam: Motion, intensity: Channel) -> SearchedPhase:
    """Search the phase errors of both axes in slices of the scan.

    Args:
        beam: motion whose angles are on the intensity's clock.
        intensity: shape (n,) or (n, detectors); detectors are averaged.
    """
    slices = searched_slices(beam, intensity)
    searched = search_slices(beam, intensity, slices)
    x, y = (_continued([_estimate(each.phase(name)) for each in searched], len(slices)) for name in AXES)
    errors = [PhaseError(each.time, *both) for each, both in zip(searched, zip(x, y, strict=True), strict=True)]
    refuted = {name for name in AXES if any(_refutes(each.matches[name]) for each in searched)}
    determined = {name for name in AXES if any(getattr(each, name).sd < inf for each in errors)}
    return SearchedPhase(errors, determined & refuted)


def _estimate(found: PhaseFound) -> PhaseEstimate:
    """Phase error at which the samples of opposite directions agree."""
    return PhaseEstimate(found.value, SEARCH_ROUNDING_SD_RAD) if found.is_clear else UNDETERMINED


def _refutes(match: PhaseMatches) -> bool:
    """Whether samples agree better at the phase found than at the motion's, by more than noise and in most bands."""
    at = int(np.argmin(np.abs([match.phase(shift) for shift in range(match.reflected.size)])))
    difference = float(match.reflected[match.best] - match.reflected[at])
    sd = float(np.hypot(match.noise_sd[match.best], match.noise_sd[at]))
    is_clear = best_reflection(match).is_clear
    return is_clear and difference > MIN_CONTRADICTION_SD * sd and differs_in_bands(match, at)


def _continued(estimates: Sequence[PhaseEstimate], slices: int) -> list[PhaseEstimate]:
    """Estimates without jumps of half a turn; all undetermined if fewer than ``MIN_FOUND_FRACTION`` are determined."""
    at = [index for index, each in enumerate(estimates) if each.sd < inf]
    continued = [UNDETERMINED] * len(estimates)
    if at and len(at) >= MIN_FOUND_FRACTION * slices:
        values = np.unwrap([estimates[index].value for index in at], period=pi)
        for index, value in zip(at, values, strict=True):
            continued[index] = PhaseEstimate(float(value), estimates[index].sd)
    return continued
