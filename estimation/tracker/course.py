"""From tracks to slow motion: what is kept of every block, and the angles that a picture takes from it."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimation.reference import Reference
from estimation.tracker import smoother
from estimation.tracker.angle import SlowAngle, SlowMotion
from estimation.tracker.orbit import MOVED, law_of, turn_of
from estimation.tracker.signal import Prepared
from estimation.tracker.step import DAMPING, LOG, PHASE, STATES, STIFFNESS, flow, rates_of
from estimation.tracker.switches import EDGE
from scanner.motion import AxisMotion

Array = NDArray[np.float64]


class Course(NamedTuple):
    """Slow motion of one axis along blocks, with two more knots where the drive switched behind one of them.

    Attributes:
        time, phase, phase_rate, log, log_rate, lines: as in ``SlowMotion``, shape (knots, ...).
        bend: which knots are beside a switch, shape (knots,).
        frequency, phase_sd: of the motion in every block, shape (blocks,) [Hz, rad].
    """

    time: Array
    phase: Array
    phase_rate: Array
    log: Array
    log_rate: Array
    lines: NDArray[np.complex64]
    bend: NDArray[np.bool_]
    frequency: Array
    phase_sd: Array


def course(prepared: Prepared, states: Array, sds: Array, a: int) -> Course:
    """Axis ``a`` along a track, ``states`` and ``sds`` of shape (blocks, states); ``prepared`` may go on behind it."""
    signal, law, at, blocks = prepared.signal, prepared.laws[a], a * STATES, len(states)
    own, time, w = states[:, at : at + STATES], prepared.time[:blocks], signal.w[:blocks, a]
    rate, moved = np.empty(blocks, np.complex128), np.empty((blocks, MOVED + 1), np.complex128)
    smoother.turns(law_of(prepared.rows[a]), w, signal.force[:blocks, a], own, rate, moved)
    # a block sees the reference averaged over itself, which is not its value in the middle when the drive sweeps
    phase = own[:, PHASE] + signal.psi[:blocks, a] - prepared.references[prepared.sense.axes[a]].phase(time)
    knots: list[NDArray[Any]] = [time, phase, rate, own[:, LOG], moved, np.zeros(blocks, bool)]
    for k in np.flatnonzero(signal.share[: blocks - 1, a] != 0.5)[::-1]:
        knots = [np.insert(b, k + 1, c, axis=0) for b, c in zip(knots, _at_switch(prepared, states, a, k), strict=True)]
    time, phase, turned, log, moved, bend = knots
    lines = (moved / np.exp(log)[:, None]).astype(np.complex64)
    lines[:, 1] = -1j
    if law.theta_th == 0.0 and law.pull:
        lines = np.ascontiguousarray(lines[:, 1::2])
    frequency = (w + rate.imag) / (2 * np.pi)
    return Course(
        time,
        phase,
        turned.imag.copy(),
        log.copy(),
        turned.real.copy(),
        lines,
        bend,
        frequency,
        sds[:, at + PHASE].copy(),
    )


def joined(parts: list[Course]) -> Course:
    """Courses one behind the other; ``parts`` is emptied, so that there are never two copies of all."""
    fields = [list(values) for values in zip(*parts, strict=True)]
    parts.clear()
    return Course(*(np.concatenate(fields.pop(0)) for _ in Course._fields))


def axis_motion(reference: Reference, along: Course, clock: tuple[float, float, int], sign: str) -> AxisMotion:
    """Motion of one axis from its course over the whole recording.

    Args:
        clock: sample rate, start and number of samples of the angles wanted. sign: as in ``AxisMotion``.
    """
    block = ~along.bend
    time, phase, log = (b if block.all() else b[block] for b in (along.time, along.phase, along.log))
    slow = SlowMotion(reference, along.time, along.phase, along.phase_rate, along.log, along.log_rate, along.lines)
    return AxisMotion(
        time=time,
        phase=phase,
        amplitude=np.exp(log),
        frequency=along.frequency,
        phase_sd=along.phase_sd,
        angle=SlowAngle(slow, *clock),
        reference=reference.kind,
        sign=sign,
    )


def _at_switch(prepared: Prepared, states: Array, a: int, k: int) -> tuple[NDArray[Any], ...]:
    """Time, phase, rate, ln A and own harmonics of axis ``a`` just before and after the switch behind block ``k``."""
    signal, law = prepared.signal, law_of(prepared.rows[a])
    reference = prepared.references[prepared.sense.axes[a]]
    share = signal.share[k, a] * signal.step
    time = prepared.time[k] + share
    sides = []
    for j, h, side in ((k, share, -EDGE), (k + 1, share - signal.step, EDGE)):
        w, force = signal.w[j, a], signal.force[j, a]
        x = states[j, a * STATES : (a + 1) * STATES].copy()
        flow(rates_of(law, x, w, force), x.copy(), x, h, np.empty((2, DAMPING + 1)))
        stiff, damp = law.k * (1.0 + x[STIFFNESS]), law.b * (1.0 + x[DAMPING])
        turn = turn_of(law, np.exp(x[LOG]), x[PHASE], w, stiff, damp, force)
        phase = x[PHASE] + signal.psi[j, a] + w * h - reference.phase(np.array([time + side]))[0]
        sides.append((time, phase, turn.rate, x[LOG], turn.moved, True))
    return tuple(np.array(values) for values in zip(*sides, strict=True))
