"""State estimate before the first block: device tolerances, the first blocks' motion, and the sign of each axis."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from estimation.signals import is_capacitive
from estimation.tracker.block_signal import BlockSignal
from estimation.tracker.filter_run import filter_blocks, select_blocks
from estimation.tracker.kalman_filter import DETECTION_SIGMA, REACQUIRE_SD, StateEstimate
from estimation.tracker.linearisation import empty_linearisation
from estimation.tracker.observations import BlockObservations
from estimation.tracker.process_noise import INITIAL_DENSITIES
from estimation.tracker.state_space import AXIS_STATES, LOG_AMPLITUDE, MIN_AMPLITUDE_THETA0, PHASE
from scanner.arrays import Array
from scanner.device import Device
from scanner.stages import Amdm, MotionSensor

RELATIVE_STIFFNESS_SD = 0.003
"""Change of stiffness since the calibration, in addition to its tolerance: that of silicon for 50 K (-60 ppm/K)."""

RELATIVE_DAMPING_SD = 0.05
"""Change of damping since the calibration, in addition to its tolerance: air damping varies with temperature and
pressure."""

UNRECORDED_DRIVE_SD = 1.0
"""Force of a drive that was not recorded, over that of the damping, in phase with the rate and with the angle. One that
keeps the amplitude replaces all of the damping. Beside the resonance, one as large adds 1 / Q to the relative
stiffness. With the constants of a free decay, the angles of the first millisecond would be those of one."""

STIFFNESS_RATE_SD_PER_S = 0.3
"""Rate of the relative stiffness at the beginning [1/s]: 0.3 % within 10 ms, a fast warming-up."""

RELATIVE_SENSOR_GAIN_SD = 1e-4
"""Gain of a sensor of the motion: small, because its signal is the reference for the amplitude."""

OFFSET_SD_V = 1.0
"""Offset of the readout [V]: unknown on the scale of the signals."""

MAX_ACQUISITION_BLOCKS = 64
"""Largest number of blocks that are averaged to detect a motion in noise: the phase drifts over longer times."""

SIGN_TEST_BLOCKS = 200
"""Blocks over which the likelihoods of both signs are compared."""


def initial_estimate(observations: BlockObservations, device: Device) -> StateEstimate:
    """State before the first block: the device's parameters within their tolerances, and the first blocks' motion."""
    readout, signal = observations.sense.readout, observations.signal
    n = AXIS_STATES * len(observations.parameters) + 1
    x, variance = np.zeros(n), np.zeros(n)
    for a, name in enumerate(observations.sense.axes):
        at = a * AXIS_STATES
        x[at + LOG_AMPLITUDE] = np.log(MIN_AMPLITUDE_THETA0 * observations.parameters[a].theta0)
        if isinstance(readout, MotionSensor):
            gain = RELATIVE_SENSOR_GAIN_SD
        else:
            factor = "a_cir" if isinstance(readout, Amdm) else "R_s"
            gain = np.hypot(device.tolerance(name, factor), device.tolerance(name, "C0"))
        law, unknown = observations.parameters[a], 0.0
        if observations.references[name].kind == "absolute":
            unknown = UNRECORDED_DRIVE_SD
        unknown_stiffness = unknown * law.b / math.sqrt(law.k * law.J)
        variance[at : at + AXIS_STATES] = np.square([
            REACQUIRE_SD[0],
            REACQUIRE_SD[1],
            math.hypot(device.tolerance(name, "k"), RELATIVE_STIFFNESS_SD, unknown_stiffness),
            STIFFNESS_RATE_SD_PER_S,
            math.hypot(device.tolerance(name, "b"), RELATIVE_DAMPING_SD, unknown),
            gain,
        ])  # fmt: skip
    x[-1] = readout.b_cir if isinstance(readout, Amdm) else readout.offset if isinstance(readout, MotionSensor) else 0.0
    variance[-1] = OFFSET_SD_V**2
    acquired = np.array([_detect_motion(signal, a, x) for a in range(len(observations.parameters))])
    return StateEstimate(x, np.diag(variance), acquired)


def _detect_motion(signal: BlockSignal, a: int, x: Array) -> bool:
    """Set phase and amplitude of axis ``a`` in ``x`` from its main line, averaged over the first blocks.

    Returns:
        False if MAX_ACQUISITION_BLOCKS do not detect it; ``x`` is then unchanged.
    """
    (i,) = np.flatnonzero((signal.lines[:, 0] == a) & (signal.lines[:, 1] == signal.main_order))
    count = min(MAX_ACQUISITION_BLOCKS, len(signal.whitened))
    solvers = signal.solvers[signal.geometry[:count]]
    fitted = np.einsum("kij,kj->ki", solvers, signal.whitened[:count])
    to_reference = np.exp(-1j * signal.main_order * signal.psi[:count, a]) / signal.response[:count, i]
    lines = (fitted[:, 1 + 2 * i] - 1j * fitted[:, 2 + 2 * i]) * to_reference
    variances = signal.noise_var[:count] * (solvers[:, 1 + 2 * i] ** 2).sum(axis=1) * np.abs(to_reference) ** 2
    measured = variances > 0.0
    blocks = 1
    while blocks <= count:
        used = measured[:blocks]
        line, sd = lines[:blocks][used].sum(), np.sqrt(variances[:blocks][used].sum())
        if used.any() and abs(line) > DETECTION_SIGMA * sd:
            line, table = line / used.sum(), signal.amplitude_table
            x[a * AXIS_STATES + LOG_AMPLITUDE] = np.log(np.interp(abs(line), table[a, 1], table[a, 0]))
            sine = 0.5 * np.pi if signal.main_order == 1 else 0.0
            x[a * AXIS_STATES + PHASE] = (np.angle(line) + sine) / signal.main_order
            return True
        blocks *= 2
    return False


def choose_signs(observations: BlockObservations, start: StateEstimate) -> tuple[StateEstimate, list[str]]:
    """Choose the sign of each axis by the likelihood of the first blocks.

    A symmetric comb has even harmonics only, which are the same for theta and -theta: the sign is ambiguous. Odd
    harmonics depend on the sign, so that the wrong one has a much lower likelihood.

    Returns:
        (``start`` with the phases of the chosen signs, reason or "ambiguous" for each axis).
    """
    axes = len(observations.parameters)
    if not is_capacitive(observations.sense.readout):
        return start, [f"known: {observations.sense.readout.kind} readout"] * axes
    if not (observations.signal.lines[:, 1] % 2).any():
        return start, ["ambiguous"] * axes
    signal = select_blocks(observations.signal, 0, SIGN_TEST_BLOCKS)
    densities = np.tile(INITIAL_DENSITIES, (axes, 1))

    def log_likelihood(estimate: StateEstimate) -> float:
        with np.errstate(all="ignore"):  # with the wrong sign the filter may diverge
            run = filter_blocks(observations, signal, empty_linearisation(signal), estimate, densities)
        return run.log_likelihood if np.isfinite(run.log_likelihood) else -np.inf

    best, reasons = log_likelihood(start), []
    for a in range(axes):
        x = start.mean.copy()
        x[a * AXIS_STATES + PHASE] += np.pi
        flipped = replace(start, mean=x)
        other = log_likelihood(flipped)
        significant = 2.0 * abs(other - best) > DETECTION_SIGMA**2
        reasons.append("known: the combs' offset theta_th" if significant else "ambiguous")
        if significant and other > best:
            start, best = flipped, other
    return start, reasons
