"""Steady motions of an axis under its drive, at the stiffness of the device and at those that its tolerance allows.

The phase of a resonance of quality factor Q turns by a radian where the stiffness changes by 1/Q, and by no more than
half a turn in total. A tolerance of more than 1/Q therefore needs the motions themselves in place of their slope.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from estimation.tracker.amplitude_table import MAX_AMPLITUDE_THETA0
from estimation.tracker.averaged_dynamics import AxisParameters, CycleAverage, average_cycle, unpack_parameters
from estimation.tracker.observations import BlockObservations
from scanner.arrays import Array
from scanner.stages import Mechanics

START_AMPLITUDE_THETA0 = 0.75
"""Amplitude at which the search for the steady motion starts, in units of theta0: near the largest torque of a comb."""

MAX_DECAY_TIMES = 30.0
"""Decay times over which the search for the steady motion is integrated: transients are then below 1e-13."""

STEP_DECAY_TIMES = 0.1
"""Step of that integration in decay times. The linearly implicit Euler method follows growth and decay with it, and is
stable for a drive beside the resonance, under which the phase turns many times in a decay time."""

MAX_STEP_CHANGE = 1.0
"""Largest change of phase [rad] and ln A in one step. Under a linear drive both rates grow as 1/A while the motion
passes a small amplitude. The limit changes the way to the steady motion, not the steady motion."""

MAX_STEADY_CHANGE = 1e-5
"""Change of phase [rad] and ln A over the last step at which the motion counts as steady."""

MAX_NEWTON_STEPS = 30
"""Newton steps to the steady motion at the next stiffness; 3 to 6 are usual."""

TOLERANCE_REACH = 3.0
"""Stiffnesses that count as allowed, in standard deviations of the device's stiffness."""

MIN_BRANCH_POINTS = 61
MAX_BRANCH_POINTS = 2001
"""Numbers of stiffnesses at which the steady motion is computed: 0.1 standard deviations apart, or less."""

PHASE_STEP_RAD = 0.1
"""Change of the phase at the resonance from one of these stiffnesses to the next."""

START_STEP_RAD = 0.5
"""Change of the phase at the resonance from one stiffness to the next in the search for one that sustains a motion: a
parametric drive sustains one over about a radian."""


class SteadyMotion(NamedTuple):
    """Steady motion under a drive.

    Attributes:
        phase: [rad]. log_amplitude: ln A.
        by_parameters: derivatives of the two by relative changes of k and b, shape (2, 2).
    """

    phase: float
    log_amplitude: float
    by_parameters: Array


class SteadyBranch(NamedTuple):
    """Steady motions at all stiffnesses that the device's tolerance allows and that sustain one.

    Attributes:
        stiffness: relative deviation from the device's value, increasing, shape (n,).
        probability: of each, from the tolerance; the sum is 1.
        phase, log_amplitude: of the steady motions, continuous, shape (n,) [rad, 1].
    """

    stiffness: Array
    probability: Array
    phase: Array
    log_amplitude: Array

    def nearest(self, stiffness: float) -> int:
        """Number of the motion at the stiffness nearest to one."""
        return int(np.argmin(np.abs(self.stiffness - stiffness)))


def find_steady_motion(observations: BlockObservations, stiffness: float = 0.0) -> SteadyMotion | None:
    """The steady motion of largest amplitude under the first block's drive; None where every motion decays.

    The averaged equations are integrated from four initial phases.

    Args:
        observations: of one axis.
        stiffness: relative deviation of the stiffness from the device's value.
    """
    law = unpack_parameters(observations.parameter_rows[0])
    step = _step(law)
    log_limit = np.log(MAX_AMPLITUDE_THETA0 * law.theta0)
    best = None
    for phase in np.pi * np.arange(4) / 4:
        log = float(np.log(START_AMPLITUDE_THETA0 * law.theta0))
        for _ in range(round(MAX_DECAY_TIMES / STEP_DECAY_TIMES)):
            cycle = _average(observations, stiffness, phase, log)
            slope = np.eye(2) - step * _phase_and_log_rows(cycle.by_phase, cycle.by_log)
            change = np.linalg.solve(slope, (step * cycle.rate.imag, step * cycle.rate.real))
            turn, growth = np.clip(change, -MAX_STEP_CHANGE, MAX_STEP_CHANGE).tolist()
            phase, log = phase + turn, min(log + growth, log_limit)
        cycle = _average(observations, stiffness, phase, log)
        if abs(cycle.rate) * step < MAX_STEADY_CHANGE and (best is None or log > best.log_amplitude):
            best = steady_motion_at(observations, stiffness, phase, log)
    return best


def steady_motion_at(observations: BlockObservations, stiffness: float, phase: float, log: float) -> SteadyMotion:
    """A steady motion of known phase [rad] and ln A with its derivatives; arguments as for ``find_steady_motion``."""
    cycle, order = _average(observations, stiffness, phase, log), observations.signal.main_order
    by_state = _phase_and_log_rows(cycle.by_phase, cycle.by_log)
    by_parameters = _phase_and_log_rows(cycle.by_stiffness, cycle.by_damping)
    return SteadyMotion(
        float(np.angle(np.exp(1j * order * phase))) / order,
        log,
        np.asarray(-np.linalg.solve(by_state, by_parameters), np.float64),
    )


def find_steady_branch(observations: BlockObservations, stiffness_sd: float) -> SteadyBranch | None:
    """Steady motions at the stiffnesses within ``TOLERANCE_REACH``; None where none of them sustains a motion.

    Args:
        observations: of one axis.
        stiffness_sd: relative standard deviation of the stiffness.
    """
    law = unpack_parameters(observations.parameter_rows[0])
    quality = Mechanics(law.J, law.b, law.k).quality
    points = int(2 * TOLERANCE_REACH * stiffness_sd * quality / PHASE_STEP_RAD)
    half = min(max(points, MIN_BRANCH_POINTS), MAX_BRANCH_POINTS) // 2
    grid = TOLERANCE_REACH * stiffness_sd * np.arange(-half, half + 1) / half
    stride = min(max(1, round(START_STEP_RAD / (quality * (grid[-1] - grid[-2])))), half)
    starts = [half, *(half + sign * i for i in range(stride, half + 1, stride) for sign in (1, -1))]
    found = next(((at, motion) for at in starts if (motion := find_steady_motion(observations, grid[at]))), None)
    if found is None:
        return None
    at, motion = found
    states = {at: (motion.phase, motion.log_amplitude)}
    for direction in (1, -1):
        following = at + direction
        while 0 <= following < grid.size:
            state = _continue_motion(observations, grid[following], *states[following - direction])
            if state is None:
                break
            states[following] = state
            following += direction
    sustained = sorted(states)
    phase, log = np.array([states[i] for i in sustained]).T
    weight = np.exp(-0.5 * (grid[sustained] / stiffness_sd) ** 2)
    return SteadyBranch(grid[sustained], weight / weight.sum(), phase, log)


def _continue_motion(
    observations: BlockObservations, stiffness: float, phase: float, log: float
) -> tuple[float, float] | None:
    """Phase and ln A of the steady motion near those of another stiffness, by Newton's method; None without one."""
    law = unpack_parameters(observations.parameter_rows[0])
    log_limit = np.log(MAX_AMPLITUDE_THETA0 * law.theta0)
    for _ in range(MAX_NEWTON_STEPS):
        cycle = _average(observations, stiffness, phase, log)
        if abs(cycle.rate) * _step(law) < MAX_STEADY_CHANGE:
            return phase, log
        slope = _phase_and_log_rows(cycle.by_phase, cycle.by_log)
        change = -np.linalg.solve(slope, (cycle.rate.imag, cycle.rate.real))
        turn, growth = np.clip(change, -MAX_STEP_CHANGE, MAX_STEP_CHANGE).tolist()
        phase, log = phase + turn, log + growth
        if not log < log_limit:
            return None
    return None


def _step(law: AxisParameters) -> float:
    """Step of the integration [s]."""
    return float(STEP_DECAY_TIMES * 2.0 * law.J / law.b)


def _average(observations: BlockObservations, stiffness: float, phase: float, log: float) -> CycleAverage:
    """Averages over a cycle under the first block's drive."""
    law, signal = unpack_parameters(observations.parameter_rows[0]), observations.signal
    w, force = float(signal.w[0, 0]), signal.force[0, 0]
    return average_cycle(law, np.exp(log), phase, w, law.k * (1.0 + stiffness), law.b, force)


def _phase_and_log_rows(*rates: complex) -> Array:
    """Rates of phase in the first row and of ln A in the second, one column for each argument."""
    return np.array([[rate.imag for rate in rates], [rate.real for rate in rates]])
