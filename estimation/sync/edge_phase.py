"""Phase and amplitude of a motion at the edges of a detector, from the edge times alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimation.sync.numbering import SIGNIFICANT_SD, NumberedEdges, number_edges
from estimation.sync.smoother import smooth_phase
from scanner.arrays import Array, Mask
from scanner.edges import Edges
from scanner.motion import UNKNOWN_PHASE_SD_RAD

NOMINAL_PHASE = {
    "zero-crossing-up": (0.0,),
    "zero-crossing-down": (np.pi,),
    "turn": (0.5 * np.pi, 1.5 * np.pi),
    "both-edges": (0.0, np.pi),
}
"""Phase of theta = A sin(phi) at the edges of each kind, for a detector in the centre [rad]."""


GAP_PERIODS = 4.0
"""Distance in periods of the points in a gap: that of the slow clock of the other estimators."""


@dataclass(frozen=True)
class EdgePhase:
    """Phase of an axis at the edges that are used, and every ``GAP_PERIODS`` in the gaps between them.

    Attributes:
        time: shape (n,) [s].
        phase: of theta = A sin(phase), unwrapped, shape (n,) [rad]. frequency: shape (n,) [Hz].
        phase_sd: shape (n,) [rad].
        asymmetry: phase by which the beam passes the detector after the centre on its way up, shape (n,) [rad].
        asymmetry_sd: its standard deviation, shape (n,) [rad].
        jitter_sd: of an edge [s].
        sign: ``"known: <how>"`` or ``"ambiguous"``.
        numbered: the edges before outliers were left out.
        outliers: edges left out for their distance from the smoothed phase.
    """

    time: Array
    phase: Array
    frequency: Array
    phase_sd: Array
    asymmetry: Array
    asymmetry_sd: Array
    jitter_sd: float
    sign: str
    numbered: NumberedEdges
    outliers: int

    @property
    def edges(self) -> int:
        """Number of edges that are used."""
        return self.numbered.times.size - self.outliers

    def describe(self, name: str) -> str:
        """Description of missing, repeated and stray edges in one line; empty if there are none."""
        counts = {
            "missing": self.numbered.missing,
            "repeated and left out": self.numbered.doubled,
            "out of place and left out": self.numbered.stray + self.outliers,
        }
        found = ", ".join(f"{count} {what}" for what, count in counts.items() if count)
        return f"{name}: {self.edges} edges are used; {found}" if found else ""


def phase_from_edges(edges: Edges) -> EdgePhase:
    """Phase and frequency of a motion from edge times alone. Raises as ``number_edges``."""
    numbered = number_edges(edges)
    nominal = np.array(NOMINAL_PHASE[edges.event])
    f0, t0 = 1.0 / numbered.length, float(numbered.times[0])
    at_edges = (numbered.times - t0) * f0
    side = np.array([-1.0, 1.0] if nominal.size == 2 else [0.0, 0.0])[numbered.kind]
    measured = 2 * np.pi * (numbered.period - at_edges) + nominal[numbered.kind]
    periods, measured, side, is_edge = _with_points_in_gaps(at_edges, measured, side)
    smoothed = smooth_phase(periods, measured, side, is_edge, walking_asymmetry=bool(edges.angle))
    used = smoothed.used
    asymmetry, asymmetry_sd = (
        np.interp(periods, periods[used], values[used]) for values in (smoothed.asymmetry, smoothed.asymmetry_sd)
    )
    flipped, sign = _sign(edges, asymmetry, asymmetry_sd)
    kept = used | ~is_edge
    return EdgePhase(
        time=t0 + periods[kept] / f0,
        phase=(2 * np.pi * periods + smoothed.phase + np.pi * flipped)[kept],
        frequency=f0 * (1.0 + smoothed.rate[kept] / (2 * np.pi)),
        phase_sd=np.minimum(smoothed.phase_sd[kept], UNKNOWN_PHASE_SD_RAD),
        asymmetry=(-asymmetry if flipped else asymmetry)[kept],
        asymmetry_sd=asymmetry_sd[kept],
        jitter_sd=smoothed.jitter_sd / (2 * np.pi * f0),
        sign=sign,
        numbered=numbered,
        outliers=int(np.sum(is_edge & ~used)),
    )


def _with_points_in_gaps(periods: Array, measured: Array, side: Array) -> tuple[Array, Array, Array, Mask]:
    """The arguments of ``smooth_phase`` with points every ``GAP_PERIODS`` between edges that are further apart."""
    wide = np.flatnonzero(np.diff(periods) > GAP_PERIODS)
    points = [np.arange(periods[at] + GAP_PERIODS, periods[at + 1], GAP_PERIODS) for at in wide]
    inserted = np.concatenate([np.empty(0), *points])
    after = np.searchsorted(periods, inserted)
    is_edge = np.insert(np.ones(periods.size, bool), after, False)
    return np.insert(periods, after, inserted), np.insert(measured, after, 0.0), np.insert(side, after, 0.0), is_edge


def _sign(edges: Edges, asymmetry: Array, sd: Array) -> tuple[bool, str]:
    """Whether the phase has to be turned by half a period, and what the edges say of the sign."""
    if edges.is_one_direction:
        return False, f"known: {edges.name}"
    if edges.event == "turn" or not edges.angle or not asymmetry_is_significant(asymmetry, sd):
        return False, "ambiguous"
    return bool(np.median(asymmetry) * edges.angle < 0.0), f"known: {edges.name}"


def asymmetry_is_significant(asymmetry: Array, sd: Array) -> bool:
    """Whether the asymmetry differs from 0 by ``SIGNIFICANT_SD`` at every edge, and has one sign."""
    return bool(np.all(np.abs(asymmetry) > SIGNIFICANT_SD * sd) and np.ptp(np.sign(asymmetry)) == 0.0)


def amplitude_from_edges(edges: Edges, found: EdgePhase) -> tuple[Array, Array] | None:
    """Amplitude and its sd at each edge, shape (n,) [rad], by a detector at a known angle; else None."""
    if (
        not edges.angle
        or found.sign == "ambiguous"
        or not asymmetry_is_significant(found.asymmetry, found.asymmetry_sd)
    ):
        return None
    amplitude = edges.angle / np.sin(found.asymmetry)
    return amplitude, np.abs(amplitude / np.tan(found.asymmetry)) * found.asymmetry_sd
