"""Whether the picture contradicts the motion: samples of one place in opposite directions, compared at all phases.

The registration of forward against backward half-periods reaches 15°. A sensor of the wrong kind is 90° off, edges of
which every second one is missing halve the frequency, and a channel may start at another time than stated. Over the
phases (a, b) of the motion the intensity is a function F(a, b) with F(π - a, b) = F(a, b). Where samples agree much
better for another reflection, or for a shift by half a period, the motion is wrong. An intensity for which the same
place at the same phase agrees, and no reflection does, does not depend on the place.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import pi
from typing import NamedTuple

import numpy as np

from recon.imaging.scan_phase.bidirectional_search import SEARCH_REACH_RAD
from recon.imaging.scan_phase.phase_search import (
    BANDS,
    MIN_CORRELATION_RATIO,
    MIN_CORRELATION_SD,
    PHASE_CELLS,
    PhaseMatches,
)
from recon.imaging.scan_phase.slice_matches import SliceMatches, match_slices
from scanner.channel import Channel
from scanner.device import AXES
from scanner.motion import AxisMotion, Motion

MAX_AGREEMENT_RATIO = 0.8
"""Correlation at the motion's phase over the largest of all phases up to which the picture contradicts the motion. At
the right phase the ratio is 1, within noise; at a wrong one a bright middle of the field alone keeps it above 0.5."""

MIN_CONTRADICTION_SD = 10.0
"""Difference of the two correlations from which it counts, in standard deviations of pure noise. The structure of a
specimen scatters more than noise, so that six are not enough."""

MIN_COMMON_CELLS = 1000
"""Pairs of visited cells from which a correlation counts, of 16 384: few cells agree by chance of the specimen."""

MIN_COMMON_SHARE = 0.5
"""Pairs of visited cells at one of the two phases over those at the other from which their correlations are compared:
a scan that fills no area of phases compares other places at each phase."""

MIN_BAND_SDS = 3.0
"""Mean difference of the two correlations over bands of the other phase, in its standard errors from their scatter. A
few bright points agree by chance in one band; at a wrong phase nearly all bands disagree."""

MIN_BANDS = BANDS - 1
"""Number of bands in which the correlation has to be larger at the other phase."""

MIN_PERSISTENCE = 0.5
"""Correlation of samples a period of the faster axis apart from which the intensity may be mostly drift."""

MAX_FOLLOWED_CORRELATION = 0.1
"""Correlation of opposite directions over that of samples a period apart below which the intensity does not follow the
place, whatever the phase is."""

MIN_ALIKE_CORRELATION = 0.3
"""Correlation of successive samples from which those of one place can be expected to agree."""

MAX_PLACE_RATIO = 0.25
"""Largest correlation of opposite directions over that of successive samples up to which the picture is wrong. It is
near 1 for a right motion in white noise, and above 0.5 if the phase drifts by a third of a turn."""


class Contradiction(NamedTuple):
    """What the picture shows of an axis whose motion it contradicts.

    Attributes:
        axis: its name.
        phases: phase of the motion less the assumed one in each slice, in [-π/2, π/2) [rad].
        agreement: mean correlation of opposite directions at the assumed phase.
        best: mean correlation at ``phases``.
        is_doubled: the samples repeat after half a period: the motion has twice the frequency.
    """

    axis: str
    phases: tuple[float, ...]
    agreement: float
    best: float
    is_doubled: bool


def find_contradictions(beam: Motion, intensity: Channel) -> tuple[list[Contradiction], bool]:
    """Find the axes whose motion the picture contradicts.

    Args:
        beam: motion whose angles are on the intensity's clock.
        intensity: shape (n,) or (n, detectors); detectors are averaged.

    Returns:
        the axes, and whether the intensity does not follow the place.
    """
    return judge_slices(match_slices(beam, intensity))


def judge_slices(slices: Sequence[SliceMatches]) -> tuple[list[Contradiction], bool]:
    """As ``find_contradictions``, from the correlations of the slices."""
    found = [_judge(column, slices) for column in range(len(AXES))]
    unfollowed = [_is_unfollowed(match) for match in slices]
    return [each for each in found if each is not None], bool(slices) and 2 * sum(unfollowed) > len(slices)


def describe_contradictions(beam: Motion, intensity: Channel) -> list[str]:
    """A line for each axis whose motion the picture contradicts, and for an intensity that does not follow the place.

    Arguments as for ``find_contradictions``.
    """
    slices = match_slices(beam, intensity)
    found, unfollowed = judge_slices(slices)
    lines = [_describe(each, beam.axes[each.axis]) for each in found]
    if unfollowed and not found:
        lines.append(
            "intensity: samples of one place differ between forward and backward half-periods at any phase, so that "
            "the picture shows something else than the scene: check that the intensity is the detector's signal, not "
            "its integral and not mostly drift, and check the frequencies of the motion"
        )
    elif not found and 2 * sum(_disagrees_at_one_place(match) for match in slices) > len(slices) > 0:
        alike, shown = (float(np.median([each(match) for match in slices])) for each in (_alike, _shown))
        lines.append(
            f"intensity: successive samples agree (correlation {alike:.2f}), and those of one place at different times "
            f"do not ({shown:.2f}), so that the picture is wrong or shows the noise of a slow detector: check "
            "sample_rate and start of intensity and sensors, and that they were recorded together"
        )
    if beam.estimator == "picture" and not lines:
        for column, name in enumerate(AXES):
            if 2 * sum(_is_folded(match.axes[column], _repeated(match.axes)) for match in slices) > len(slices):
                frequency = float(np.median(beam.axes[name].frequency))
                lines.append(
                    f"{name}: the picture equals its mirror image in {name}: so does the scene, or {name} moves at "
                    f"{2 * frequency:.6g} Hz in place of {frequency:.6g} Hz and the picture is wrong: check kind and "
                    f"frequency in [{name}.drive]"
                )
    return lines


def _describe(found: Contradiction, moved: AxisMotion) -> str:
    """The line on one axis with its motion."""
    name, frequency = found.axis, float(np.median(moved.frequency))
    what = (
        f"{name}: forward and backward half-periods disagree (correlation {found.agreement:.2f}), so that the picture "
        f"is wrong; "
    )
    if found.is_doubled:
        return what + (
            f"samples half a period apart agree, as if {name} moved at {2 * frequency:.6g} Hz in place of "
            f"{frequency:.6g} Hz: check for missing edges of sync_{name} and its event, and the drive's frequency"
        )
    degrees = np.degrees(found.phases)
    typical = _circular_mean(found.phases)
    apart = max(abs(_wrapped(phase - typical)) for phase in found.phases)
    if apart > SEARCH_REACH_RAD:
        return what + (
            f"they agree at phases {degrees.min():+.0f}° to {degrees.max():+.0f}° away (correlation {found.best:.2f}), "
            f"different during the scan: check that the sample rates of intensity and sensors are right"
        )
    line = what + f"they agree at a phase {np.degrees(typical):+.0f}° away (correlation {found.best:.2f}): "
    if moved.sign == f"known: phase_{name}":
        return line + (
            f"check unit, sign and reference of phase_{name}, which belongs to the sine: angle = amplitude "
            "sin(2π reference t + phase)"
        )
    if abs(typical) > pi / 2 - SEARCH_REACH_RAD:
        return line + (
            f"check kind in [{name}.readout], as velocity and position differ by 90°, the sign of a capacitive signal, "
            "as half of its inverted phase is 90°, or start of channels"
        )
    late = 1e6 * typical / (2 * pi * frequency)
    line += f"check start of the channels and the sensor's delay, which would be {late:.3g} µs plus any half-periods"
    if moved.sign == f"known: sync_{name}":
        line += ", and, if the edges are of one direction, that their detector is in the centre"
    return line


def _repeated(matches: Sequence[PhaseMatches]) -> float:
    """Correlation of the samples of one place at different times: no more than both axes' best show."""
    return min(matches[0].same_cell, max(float(each.reflected[each.best]) for each in matches))


def _judge(column: int, slices: Sequence[SliceMatches]) -> Contradiction | None:
    """The contradiction of an axis in most of the slices."""
    pairs = [(match.axes[column], _repeated(match.axes)) for match in slices]
    against = [pair for pair in pairs if _contradicts(*pair)]
    if not against or 2 * len(against) <= len(slices):
        return None
    return Contradiction(
        AXES[column],
        tuple(each.phase(each.best) for each, _ in against),
        float(np.mean([_agreement(each)[0] for each, _ in against])),
        float(np.mean([each.reflected[each.best] for each, _ in against])),
        2 * sum(_is_doubled(each, repeated) for each, repeated in against) > len(against),
    )


def _agreement(match: PhaseMatches) -> tuple[float, int]:
    """Largest correlation within the reach of the registration, and the number of its shift."""
    near = np.flatnonzero(np.abs([match.phase(at) for at in range(PHASE_CELLS)]) <= SEARCH_REACH_RAD)
    at = int(near[np.argmax(match.reflected[near])])
    return float(match.reflected[at]), at


def _contradicts(match: PhaseMatches, repeated: float) -> bool:
    """Whether samples agree much better at another phase than at the assumed one; ``repeated`` as ``_repeated``."""
    agreement, at = _agreement(match)
    best = float(match.reflected[match.best])
    sd = float(np.hypot(match.noise_sd[at], match.noise_sd[match.best]))
    if not repeated > 0.0 or at == match.best:
        return False
    fewer, more = sorted((match.common_cells[at], match.common_cells[match.best]))
    return bool(
        fewer >= max(MIN_COMMON_CELLS, MIN_COMMON_SHARE * more)
        and differs_in_bands(match, at)
        and MIN_CORRELATION_RATIO * repeated <= best <= match.same_cell / MIN_CORRELATION_RATIO
        and agreement < MAX_AGREEMENT_RATIO * best
        and best - agreement > MIN_CONTRADICTION_SD * sd
    )


def _is_doubled(match: PhaseMatches, repeated: float) -> bool:
    """Whether samples half a period apart agree, or both of the phases an eighth of a turn away."""
    other = float(match.reflected[(match.best + PHASE_CELLS // 2) % PHASE_CELLS])
    eighth = abs(abs(match.phase(match.best)) - pi / 4) < SEARCH_REACH_RAD
    return max(match.half_turn, other * eighth) >= MIN_CORRELATION_RATIO * repeated


def _is_folded(match: PhaseMatches, repeated: float) -> bool:
    """Whether samples agree as well, within the noise, a quarter of a turn away: the picture is symmetric."""
    at = (match.best + PHASE_CELLS // 2) % PHASE_CELLS
    noise = MIN_CORRELATION_SD * float(np.hypot(match.noise_sd[match.best], match.noise_sd[at]))
    best, quarter = float(match.reflected[match.best]), float(match.reflected[at])
    is_clear = best >= max(MIN_CORRELATION_RATIO * repeated, noise) and repeated > 0.0
    return is_clear and best - quarter < noise and not differs_in_bands(match, at)


def differs_in_bands(match: PhaseMatches, at: int) -> bool:
    """Whether the correlation at the best phase exceeds that at another one in nearly all bands of the other axis."""
    by_band = match.by_band[:, match.best] - match.by_band[:, at]
    is_significant = by_band.mean() > MIN_BAND_SDS * by_band.std(ddof=1) / np.sqrt(BANDS)
    return bool(is_significant and np.sum(by_band > 0.0) >= MIN_BANDS)


def _alike(match: SliceMatches) -> float:
    """Correlation of successive samples: of those in one cell of phase, most of which are of one pass, or nearby."""
    return max(match.nearby, match.axes[0].same_cell)


def _disagrees_at_one_place(match: SliceMatches) -> bool:
    """Whether successive samples are alike and those of one place at different times are not, at any phase."""
    cells = min(float(axis.common_cells.min()) for axis in match.axes)
    alike = _alike(match)
    return cells >= MIN_COMMON_CELLS and alike > MIN_ALIKE_CORRELATION and _shown(match) < MAX_PLACE_RATIO * alike


def _shown(match: SliceMatches) -> float:
    """Largest correlation of opposite directions over all phases of both axes."""
    return max(float(axis.reflected[axis.best]) for axis in match.axes)


def _is_unfollowed(match: SliceMatches) -> bool:
    """Whether the intensity hardly changes in a period of the faster axis, and agrees with the place at no phase."""
    cells = min(float(axis.common_cells.min()) for axis in match.axes)
    return (
        cells >= MIN_COMMON_CELLS
        and match.persistence > MIN_PERSISTENCE
        and _shown(match) < MAX_FOLLOWED_CORRELATION * match.persistence
    )


def _circular_mean(phases: Sequence[float]) -> float:
    """Mean of phases known up to half a turn, in [-π/2, π/2) [rad]."""
    return _wrapped(float(np.angle(np.mean(np.exp(2j * np.array(phases))))) / 2)


def _wrapped(phase: float) -> float:
    """A phase in [-π/2, π/2) [rad]."""
    return (phase + pi / 2) % pi - pi / 2
