"""From a track of states to the motion of an axis, which yields the angle at any sample."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimation.reference import PhaseReference
from estimation.tracker.angle_synthesis import PhasorAngle, PhasorMotion
from estimation.tracker.averaged_dynamics import MAX_MOTION_HARMONIC, average_cycle, unpack_parameters
from estimation.tracker.change_points import JUMP_WIDTH_S
from estimation.tracker.kalman_filter import fill_track_rates
from estimation.tracker.observations import BlockObservations
from estimation.tracker.state_space import (
    AXIS_STATES,
    DAMPING,
    LOG_AMPLITUDE,
    PHASE,
    STIFFNESS,
    propagate_mean,
    rates_at,
)
from scanner.arrays import Array
from scanner.motion import AxisMotion


class AxisKnots(NamedTuple):
    """Motion of one axis at the middles of the blocks, with two more knots at each switch of its drive.

    Attributes:
        time, phase, phase_rate, log_amplitude, log_amplitude_rate, harmonics: as in ``PhasorMotion``.
        at_switch: which knots belong to a switch, shape (knots,).
        frequency, phase_sd, log_amplitude_sd: of the motion in every block, shape (blocks,) [Hz, rad, 1].
    """

    time: Array
    phase: Array
    phase_rate: Array
    log_amplitude: Array
    log_amplitude_rate: Array
    harmonics: NDArray[np.complex64]
    at_switch: NDArray[np.bool_]
    frequency: Array
    phase_sd: Array
    log_amplitude_sd: Array


def axis_knots(observations: BlockObservations, states: Array, sds: Array, a: int) -> AxisKnots:
    """Knots of axis ``a`` along a track.

    Args:
        observations: may have more blocks than the track. states, sds: of the track, shape (blocks, states).
    """
    signal, law, at, blocks = observations.signal, observations.parameters[a], a * AXIS_STATES, len(states)
    track, time, w = states[:, at : at + AXIS_STATES], observations.time[:blocks], signal.w[:blocks, a]
    rate, harmonics = np.empty(blocks, np.complex128), np.empty((blocks, MAX_MOTION_HARMONIC + 1), np.complex128)
    parameters = unpack_parameters(observations.parameter_rows[a])
    fill_track_rates(parameters, w, signal.force[:blocks, a], track, rate, harmonics)
    # psi is the reference averaged over the block, which differs from its value in the middle when the drive sweeps
    reference = observations.references[observations.sense.axes[a]]
    phase = track[:, PHASE] + signal.psi[:blocks, a] - reference.phase(time)
    knots: list[NDArray[Any]] = [time, phase, rate, track[:, LOG_AMPLITUDE], harmonics, np.zeros(blocks, bool)]
    for k in np.flatnonzero(signal.drive_share[: blocks - 1, a] != 0.5)[::-1]:
        pair = _knots_at_switch(observations, states, a, k)
        knots = [np.insert(values, k + 1, added, axis=0) for values, added in zip(knots, pair, strict=True)]
    time, phase, rates, log, motion_harmonics, at_switch = knots
    with np.errstate(all="ignore"):  # a diverged motion is refused by estimate()
        relative = (motion_harmonics / np.exp(log)[:, None]).astype(np.complex64)
    relative[:, 1] = -1j
    if law.theta_th == 0.0 and law.electrostatic_factor:
        relative = np.ascontiguousarray(relative[:, 1::2])
    return AxisKnots(
        time,
        phase,
        rates.imag.copy(),
        log.copy(),
        rates.real.copy(),
        relative,
        at_switch,
        (w + rate.imag) / (2 * np.pi),
        sds[:, at + PHASE].copy(),
        sds[:, at + LOG_AMPLITUDE].copy(),
    )


def join_knots(parts: list[AxisKnots]) -> AxisKnots:
    """Concatenate the knots of consecutive sections; ``parts`` is emptied to save memory."""
    fields = [list(values) for values in zip(*parts, strict=True)]
    parts.clear()
    return AxisKnots(*(np.concatenate(fields.pop(0)) for _ in AxisKnots._fields))


def motion_of_knots(
    reference: PhaseReference, knots: AxisKnots, clock: tuple[float, float, int], sign: str
) -> AxisMotion:
    """Motion of one axis from its knots over the whole recording.

    Args:
        clock: sample rate [Hz], start [s] and number of samples of the angles. sign: as in ``AxisMotion``.
    """
    block = ~knots.at_switch
    fields = (knots.time, knots.phase, knots.log_amplitude)
    time, phase, log = (values if block.all() else values[block] for values in fields)
    motion = PhasorMotion(
        reference,
        knots.time,
        knots.phase,
        knots.phase_rate,
        knots.log_amplitude,
        knots.log_amplitude_rate,
        knots.harmonics,
    )
    return AxisMotion(
        time=time,
        phase=phase,
        amplitude=np.exp(log),
        frequency=knots.frequency,
        phase_sd=knots.phase_sd,
        angle=PhasorAngle(motion, *clock),
        reference=reference.kind,
        reference_frequency=reference.frequency,
        sign=sign,
        amplitude_sd=np.exp(log) * knots.log_amplitude_sd,
    )


def _knots_at_switch(observations: BlockObservations, states: Array, a: int, k: int) -> tuple[NDArray[Any], ...]:
    """Time, phase, rate, ln A, harmonics and flag before and after the switch of axis ``a`` after block k."""
    signal, law = observations.signal, unpack_parameters(observations.parameter_rows[a])
    reference = observations.references[observations.sense.axes[a]]
    delay = signal.drive_share[k, a] * signal.step
    time = observations.time[k] + delay
    sides = []
    for j, h, side in ((k, delay, -JUMP_WIDTH_S), (k + 1, delay - signal.step, JUMP_WIDTH_S)):
        w, force = signal.w[j, a], signal.force[j, a]
        x = states[j, a * AXIS_STATES : (a + 1) * AXIS_STATES].copy()
        propagate_mean(rates_at(law, x, w, force), x.copy(), x, h, np.empty((2, DAMPING + 1)))
        stiffness, damping = law.k * (1.0 + x[STIFFNESS]), law.b * (1.0 + x[DAMPING])
        cycle = average_cycle(law, np.exp(x[LOG_AMPLITUDE]), x[PHASE], w, stiffness, damping, force)
        phase = x[PHASE] + signal.psi[j, a] + w * h - reference.phase(np.array([time + side]))[0]
        sides.append((time, phase, cycle.rate, x[LOG_AMPLITUDE], cycle.motion_harmonics, True))
    return tuple(np.array(values) for values in zip(*sides, strict=True))
