"""Which period and which kind each edge belongs to; missing, doubled and stray edges are recognised."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from scanner.arrays import Array, Index
from scanner.edges import Edges
from scanner.errors import BadInput
from scanner.wording import counted

MIN_EDGES = 12
"""Edges that a phase is estimated from at least: six half-periods of each kind."""

MAX_DEVIATION_PERIODS = 0.1
"""Deviation of an edge from its expected place above which it is stray. A jitter of a hundredth of a period, which is
large for a detector, lies ten standard deviations below."""

DOUBLED_PERIODS = 0.04
"""Time after the previous edge, in periods, below which an edge is a repetition (a bounce of the comparator)."""

MIN_DWELL_PERIODS = 0.08
"""Least fraction of a period between the two edges of a detector: below, the beam hardly passes it, and the kinds of
edges could be confused."""

PERIOD_GAIN = 0.05
"""Weight of a new edge in the local period, which follows drifts: an average over some twenty edges."""

MAX_STRAY_FRACTION = 0.2
"""Fraction of stray and doubled edges above which the list is refused."""

MAX_MISSING_FRACTION = 0.8
"""Fraction of missing edges above which the list is refused: the period is then that of a disturbance."""

SIGNIFICANT_SD = 6.0
"""Asymmetry of a detector in standard deviations from which it determines sign, amplitude and the kinds of edges; by
chance once in 1e8."""

FIRST_EDGES = 12
"""Edges that are tried as the first one: a stray one would number all others wrongly."""


class NumberedEdges(NamedTuple):
    """Edges that are used.

    Attributes:
        times: shape (n,) [s].
        kind: 0 or 1; always 0 where a period has one edge, shape (n,).
        period: number of the period of the edge, shape (n,).
        length: of a period [s].
        dwell: from kind 0 to kind 1, in periods.
        missing, doubled, stray: how many edges were missing, repeated or out of place.
    """

    times: Array
    kind: Index
    period: Index
    length: float
    dwell: float
    missing: int
    doubled: int
    stray: int


def number_edges(edges: Edges) -> NumberedEdges:
    """Number the edges of a detector.

    Raises:
        BadInput: fewer than ``MIN_EDGES``, or no regular sequence.
    """

    def bad(what: str, hint: str) -> BadInput:
        return BadInput(what, file=edges.file, channel=edges.name, hint=hint)

    times, kinds = edges.times, 2 if edges.event in ("both-edges", "turn") else 1
    if times.size < MIN_EDGES:
        raise bad(f"holds {counted(times.size, 'edge')}; {MIN_EDGES} are needed", "record for longer")
    gaps = np.diff(times)
    bounce = DOUBLED_PERIODS * float(np.median(gaps))
    clean = times[np.append(True, gaps > 4.0 * bounce)]
    if clean.size < MIN_EDGES:
        raise bad("holds no regular sequence of edges", "check its unit and its threshold")
    length = float(np.median(clean[kinds:] - clean[:-kinds]))
    shares = np.diff(clean) / length
    inside = shares[(shares > MIN_DWELL_PERIODS) & (shares < 1.0 - MIN_DWELL_PERIODS)]
    if kinds == 2 and inside.size < 0.5 * shares.size:
        raise bad("the beam hardly passes the detector: its two edges nearly coincide", "move it towards the centre")
    dwell = float(np.median(np.minimum(inside, 1.0 - inside))) if kinds == 2 else 0.0
    if edges.event == "turn" or abs(dwell - 0.5) < 0.5 * MIN_DWELL_PERIODS:
        dwell = 0.5 if kinds == 2 else 0.0
    offsets = np.array([0.0, dwell])[:kinds]
    tried = [
        (int(np.sum(_number(times[first : first + 400], length, offsets, kind)[0] < 0)) + first, first, kind)
        for first in range(min(FIRST_EDGES, times.size - MIN_EDGES + 1))
        for kind in range(kinds if dwell != 0.5 else 1)
    ]
    _, first, kind = min(tried)
    numbered, period, missing, doubled = _number(times[first:], length, offsets, kind)
    used = numbered >= 0
    stray = int(times.size - used.sum() - doubled)
    if used.sum() < MIN_EDGES or stray + doubled > MAX_STRAY_FRACTION * times.size:
        what = f"is no regular sequence of edges: {stray} of {times.size} are out of place and {doubled} repeated"
        raise bad(what, "check the detector's threshold, and that the motion was on all the time")
    if missing > MAX_MISSING_FRACTION * (missing + used.sum()):
        what = f"{missing} of {missing + used.sum()} edges of a motion at {1.0 / length:.4g} Hz are missing"
        hint = (
            f"edges lie {length / kinds:.3g} s apart: keep one of those that belong together, and check the threshold"
        )
        raise bad(what, hint)
    kept = times[first:][used]
    by_side = consistent_kinds(kept, numbered[used], period[used])
    return NumberedEdges(kept, *by_side, length, dwell, missing, doubled, stray)


def consistent_kinds(times: Array, kind: Index, period: Index) -> tuple[Index, Index]:
    """Kind and period of each edge; kinds are exchanged where the long intervals begin at the other kind than before.

    While the beam does not reach the detector, its phase may change by half a period, and the edges after that are then
    numbered half a period wrong. The exchange begins after the longest interval between the two runs of edges.

    Args:
        times, kind, period: of the edges that are used, all of shape (n,).
    """
    starts = np.append(0, np.flatnonzero(np.diff(2 * period + kind) != 1) + 1)  # of runs in which no edge is missing
    stops = np.append(starts[1:], times.size)
    turned, before = np.zeros(times.size, np.int64), (0, 0)
    for start, stop in zip(starts.tolist(), stops.tolist(), strict=True):
        side = _long_side(times[start:stop]) * (1 - 2 * int(kind[start]))
        if side == 0:
            continue
        if before[1] * side < 0:
            at = before[0] + int(np.argmax(np.diff(times[before[0] : start + 1])))
            turned[at + 1 :] ^= 1
        before = stop - 1, side
    return np.where(turned, 1 - kind, kind), period + turned * kind


def _long_side(times: Array) -> int:
    """Sign of the first, third, ... interval less the second, fourth, ... one; 0 if they do not alternate."""
    if times.size < MIN_EDGES:
        return 0
    difference = np.diff(times, 2) * (1 - 2 * (np.arange(times.size - 2) % 2))  # without the drift of the period
    sd = difference.std() / np.sqrt(difference.size)
    return -int(np.sign(difference.mean())) if abs(difference.mean()) > SIGNIFICANT_SD * sd else 0


@njit(cache=True)
def _number(times, length, offsets, first_kind):  # type: ignore[no-untyped-def]
    """Kind (-1: not used) and period of each edge, and the numbers of missing and repeated edges."""
    n, kinds = times.size, offsets.size
    kind, period = np.full(n, -1), np.zeros(n, np.int64)
    kind[0], last, missing, doubled = first_kind, 0, 0, 0
    for k in range(1, n):
        elapsed = (times[k] - times[last]) / length
        if elapsed < DOUBLED_PERIODS:
            doubled += 1
            continue
        best, best_kind, best_turns, best_expected = 1.0, -1, 0, 1.0
        for candidate in range(kinds):
            offset = offsets[candidate] - offsets[kind[last]]
            turns = int(np.rint(elapsed - offset))
            expected = turns + offset
            if expected > 0.0 and abs(elapsed - expected) < best:
                best, best_kind, best_turns, best_expected = abs(elapsed - expected), candidate, turns, expected
        if best > MAX_DEVIATION_PERIODS:
            continue
        kind[k], period[k] = best_kind, period[last] + best_turns
        missing += kinds * best_turns + best_kind - kind[last] - 1
        length *= 1.0 + PERIOD_GAIN * (elapsed / best_expected - 1.0)
        last = k
    return kind, period, missing, doubled
