"""State vector of the tracker and its transition from one block to the next, compiled.

State of each axis: phase phi [rad], ln A, relative change of stiffness, its rate [1/s], relative change of damping, and
ln of the readout gain. Then the readout's offset [V], one for all axes of an electrode, and zeros up to a multiple of
``SIMD_WIDTH``. Between two blocks phase and amplitude follow the averaged dynamics (``averaged_dynamics``). These are
linearised near the state and integrated exactly, with the drive of each block. The stiffness's rate, the damping and
the gain are random walks.

A step between the middles of two blocks is made in two parts, up to the time at which the drive of the next block
begins (``predict_to_boundary``), and from there on (``predict_to_block``).
"""

from __future__ import annotations

import numpy as np
from numba import njit

from estimation.tracker.averaged_dynamics import MAX_MOTION_HARMONIC, average_cycle, unpack_parameters

PHASE, LOG_AMPLITUDE, STIFFNESS, STIFFNESS_RATE, DAMPING, GAIN = range(6)

AXIS_STATES = 6
"""Number of states of an axis."""

SIMD_WIDTH = 8
"""The state vector's length is a multiple of it: rows of matrices then fill vector registers, which halves the time."""

MIN_AMPLITUDE_THETA0 = 1e-3
"""Smallest amplitude, in units of theta0: keeps ln A finite; a smaller motion is far below the noise of any readout."""

MAX_SD = (10.0, 3.0)
"""Standard deviations of phase [rad] and ln A that mean "unknown": they bound unstable dynamics without data."""

MAX_ITERATIONS = 5
"""Most iterations of a measurement update, and of the state after a drive step; both converge quadratically."""

RATE_TERMS = 5
"""The rate r of an axis and its derivatives by phase, ln A, stiffness and damping, see ``fill_rates``."""

RELINEARISE_DISTANCE = 2e-3
"""``state_distance`` [rad, 1] above which a block is linearised again: second-order terms are then below 1e-5."""

SUBSTEP_TOLERANCE_RAD = 1e-5
"""Error of linearised rates over a substep [rad]: a fifth of the least phase error at 40 dB, 0.003 degrees."""

MAX_SUBSTEPS = 16
"""Most substeps of a step: bounds the cost of a step whose state is far from the steady motion."""


def padded_size(states: int) -> int:
    """The next multiple of SIMD_WIDTH."""
    return -(-states // SIMD_WIDTH) * SIMD_WIDTH


@njit(cache=True, error_model="numpy")
def fill_rates(law, cycle, stiffness, damping, rates):  # type: ignore[no-untyped-def]
    """Fill ``rates``, shape (RATE_TERMS,), with r and its derivatives by phase, ln A, stiffness and damping state."""
    rates[0], rates[1], rates[2] = cycle.rate, cycle.by_phase, cycle.by_log
    rates[3], rates[4] = cycle.by_stiffness * (law.k / stiffness), cycle.by_damping * (law.b / damping)


@njit(cache=True, error_model="numpy")
def rates_at(law, x, w, force):  # type: ignore[no-untyped-def]
    """``fill_rates`` of one axis in state ``x``, shape (AXIS_STATES,), at the reference's ``w`` [rad/s]."""
    rates = np.empty(RATE_TERMS, np.complex128)
    stiffness, damping = law.k * (1.0 + x[STIFFNESS]), law.b * (1.0 + x[DAMPING])
    cycle = average_cycle(law, np.exp(x[LOG_AMPLITUDE]), x[PHASE], w, stiffness, damping, force)
    fill_rates(law, cycle, stiffness, damping, rates)
    return rates


@njit(cache=True, error_model="numpy")
def extrapolate_rate(rates, point, x):  # type: ignore[no-untyped-def]
    """Rate r of one axis in state ``x`` [1/s], to first order from the rates about the state ``point``."""
    rate = rates[0] + rates[1] * (x[PHASE] - point[PHASE]) + rates[2] * (x[LOG_AMPLITUDE] - point[LOG_AMPLITUDE])
    return rate + rates[3] * (x[STIFFNESS] - point[STIFFNESS]) + rates[4] * (x[DAMPING] - point[DAMPING])


@njit(cache=True, error_model="numpy", fastmath={"reassoc", "contract"})
def propagate_mean(rates, point, x, h, transition):  # type: ignore[no-untyped-def]
    """Propagate the state ``x`` of one axis over ``h`` seconds, in place, by the rates linearised about ``point``.

    With a the 2 x 2 Jacobian of (phase, ln A) and g the constant part of their rates, the step is phi_1(a h) g h, and
    the transition exp(a h); phi_1 and phi_2 are the first two integrals of the exponential. By Cayley and Hamilton each
    is p + q a, with p and q from the power series.

    Args:
        rates: see ``rates_at``.
        transition: filled with the derivatives of phase and ln A after the step by the first five states before it,
            shape (2, DAMPING + 1).
    """
    by_phase, by_log, by_stiffness, by_damping = rates[1], rates[2], rates[3], rates[4]
    trace = by_phase.imag + by_log.real
    det = by_phase.imag * by_log.real - by_phase.real * by_log.imag
    # h is a fraction of the decay time, so that nine terms reach rounding error
    p0, q0, p1, q1, p2, q2, p, q = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0
    for n in range(9):
        one = h / (n + 1)
        two = one * h / (n + 2)
        p0, q0, p1, q1, p2, q2 = p0 + p, q0 + q, p1 + p * one, q1 + q * one, p2 + p * two, q2 + q * two
        p, q = -det * q * one, (p + trace * q) * one
    rate = extrapolate_rate(rates, point, x)
    change = p1 * rate + q1 * (by_phase * rate.imag + by_log * rate.real)
    stiffness_flow = by_phase * by_stiffness.imag + by_log * by_stiffness.real
    after_stiffness, after_rate = p1 * by_stiffness + q1 * stiffness_flow, p2 * by_stiffness + q2 * stiffness_flow
    after_damping = p1 * by_damping + q1 * (by_phase * by_damping.imag + by_log * by_damping.real)
    x[PHASE] += change.imag + after_rate.imag * x[STIFFNESS_RATE]
    x[LOG_AMPLITUDE] += change.real + after_rate.real * x[STIFFNESS_RATE]
    x[STIFFNESS] += h * x[STIFFNESS_RATE]
    transition[0, PHASE], transition[0, LOG_AMPLITUDE] = p0 + q0 * by_phase.imag, q0 * by_log.imag
    transition[1, PHASE], transition[1, LOG_AMPLITUDE] = q0 * by_phase.real, p0 + q0 * by_log.real
    transition[0, STIFFNESS], transition[1, STIFFNESS] = after_stiffness.imag, after_stiffness.real
    transition[0, STIFFNESS_RATE], transition[1, STIFFNESS_RATE] = after_rate.imag, after_rate.real
    transition[0, DAMPING], transition[1, DAMPING] = after_damping.imag, after_damping.real


@njit(cache=True, error_model="numpy")
def _add_process_noise(P, transition, h, densities):  # type: ignore[no-untyped-def]
    """Add the process noise of ``h`` seconds, in place, to one axis's covariance ``P`` (AXIS_STATES, AXIS_STATES).

    The noise of the step is lumped into one impulse at its middle.

    Args:
        densities: spectral densities of the white noise on phase and ln A [1/s], stiffness rate [1/s^3], damping [1/s]
            and gain [1/s], shape (4,).
    """
    # response of phase, ln A, stiffness and stiffness rate at the end to an impulse of the rate in the middle
    response = 0.25 * transition[0, STIFFNESS_RATE], 0.25 * transition[1, STIFFNESS_RATE], 0.5 * h, 1.0
    for i, first in enumerate(response):
        for j, second in enumerate(response):
            P[i, j] += densities[1] * h * first * second
    P[DAMPING, DAMPING] += densities[2] * h
    P[GAIN, GAIN] += densities[3] * h
    for i in range(2):
        half = 0.5 * transition[i, DAMPING]
        P[i, i] += (densities[0] + densities[2] * half * half) * h
        P[i, DAMPING] += densities[2] * h * half
        P[DAMPING, i] += densities[2] * h * half


@njit(cache=True, error_model="numpy")
def _step_drive(law, x, signal, k, a):  # type: ignore[no-untyped-def]
    """Phase and ln A of axis ``a`` after its drive switched between blocks k and k + 1.

    Angle and angular velocity are continuous. The harmonics that the drive adds to the motion and the rate r are not.
    The fundamental takes up the difference: 0.3 degrees when the drive of the imaging scanner stops.

    Args:
        law: ``AxisParameters``. x: the axis's state before, its phase relative to the reference of block k + 1.
    """
    stiffness, damping = law.k * (1.0 + x[STIFFNESS]), law.b * (1.0 + x[DAMPING])
    psi = signal.psi[k + 1, a] - (1.0 - signal.drive_share[k, a]) * signal.step * signal.w[k + 1, a]
    reference_jump = signal.psi[k, a] + signal.drive_share[k, a] * signal.step * signal.w[k, a] - psi
    phase, log, theta, speed = x[PHASE], x[LOG_AMPLITUDE], 0.0, 0.0
    for i in range(1 + MAX_ITERATIONS):  # i = 0: angle and velocity with the old drive; then solve for the new one
        j = k + min(i, 1)
        reference_phase = phase - (0.0 if i else reference_jump)
        w = signal.w[j, a]
        cycle = average_cycle(law, np.exp(log), reference_phase, w, stiffness, damping, signal.force[j, a])
        w, u = w + cycle.rate.imag, psi + phase
        rest, rest_speed = 0.0, np.exp(log) * cycle.rate.real * np.sin(u)
        for n in range(MAX_MOTION_HARMONIC + 1):
            line = cycle.motion_harmonics[n] * np.exp(1j * n * u)
            rest += line.real
            rest_speed -= n * w * line.imag
        if i == 0:
            theta, speed = np.exp(log) * np.sin(u) + rest, np.exp(log) * w * np.cos(u) + rest_speed
        else:
            sine, cosine = theta - rest, (speed - rest_speed) / w
            phase += np.arctan2(sine * np.cos(u) - cosine * np.sin(u), cosine * np.cos(u) + sine * np.sin(u))
            log = 0.5 * np.log(sine * sine + cosine * cosine)
    return phase, log


@njit(cache=True, error_model="numpy", fastmath={"reassoc", "contract"})
def apply_transition(rows, transition, h):  # type: ignore[no-untyped-def]
    """Multiply one axis's ``rows``, shape (AXIS_STATES, n), in place from the left by the Jacobian of its step."""
    for v in range(rows.shape[1]):
        phase, log = 0.0, 0.0
        for j in range(DAMPING + 1):
            phase += transition[0, j] * rows[j, v]
            log += transition[1, j] * rows[j, v]
        rows[PHASE, v], rows[LOG_AMPLITUDE, v] = phase, log
        rows[STIFFNESS, v] += h * rows[STIFFNESS_RATE, v]


@njit(cache=True, error_model="numpy")
def _compose_transitions(first, second, h):  # type: ignore[no-untyped-def]
    """Transition of two consecutive steps, into ``first``; the first step lasts ``h`` seconds."""
    for j in range(DAMPING + 1):
        phase, log = first[0, j], first[1, j]
        for i in range(2):
            direct = 0.0
            if j > LOG_AMPLITUDE:
                direct = second[i, j] + (h * second[i, STIFFNESS] if j == STIFFNESS_RATE else 0.0)
            first[i, j] = second[i, PHASE] * phase + second[i, LOG_AMPLITUDE] * log + direct


@njit(cache=True)
def state_distance(x, point, step):  # type: ignore[no-untyped-def]
    """Largest difference of two states; that of a stiffness rate counts times ``step``, the time between blocks [s]."""
    largest = 0.0
    for i in range(x.size):
        difference = abs(x[i] - point[i])
        largest = max(largest, difference * step if i % AXIS_STATES == STIFFNESS_RATE else difference)
    return largest


@njit(cache=True, error_model="numpy")
def _count_substeps(rates, h):  # type: ignore[no-untyped-def]
    """Number of substeps of ``h`` seconds, so that the rates' curvature contributes less than SUBSTEP_TOLERANCE_RAD.

    One, except after a switch of the drive, where phase and amplitude move towards their new steady values.
    """
    error = (abs(rates[1]) + abs(rates[2])) * h * (abs(rates[0]) * h) ** 2 / 6.0
    if error <= SUBSTEP_TOLERANCE_RAD:
        return 1
    return int(np.ceil(min(np.sqrt(error / SUBSTEP_TOLERANCE_RAD), MAX_SUBSTEPS)))


@njit(cache=True, error_model="numpy")
def _propagate_axis(laws, signal, k, a, h, densities, linear, x, P, transition):  # type: ignore[no-untyped-def]
    """Propagate axis ``a`` over ``h`` seconds under block k's drive, in place on the whole state and covariance."""
    at, law = a * AXIS_STATES, unpack_parameters(laws[a])
    mine, point, rates = x[at : at + AXIS_STATES], linear.point[k, at : at + AXIS_STATES], linear.rates[k, a]
    if not state_distance(mine, point, signal.step) < RELINEARISE_DISTANCE:
        point = mine.copy()
        rates = rates_at(law, mine, signal.w[k, a], signal.force[k, a])
    substeps = _count_substeps(rates, h)
    for i in range(substeps):
        part = transition if i == 0 else np.empty((2, DAMPING + 1))
        if i > 0:
            clip_amplitudes(laws, signal, x)
            point = mine.copy()
            rates = rates_at(law, mine, signal.w[k, a], signal.force[k, a])
        propagate_mean(rates, point, mine, h / substeps, part)
        apply_transition(P[at : at + AXIS_STATES], part, h / substeps)
        apply_transition(P.T[at : at + AXIS_STATES], part, h / substeps)
        _add_process_noise(P[at : at + AXIS_STATES, at : at + AXIS_STATES], part, h / substeps, densities)
        if i > 0:
            _compose_transitions(transition, part, i * h / substeps)


@njit(cache=True, error_model="numpy")
def predict_to_boundary(laws, signal, k, x, P, densities, linear, transitions):  # type: ignore[no-untyped-def]
    """Propagate state and covariance, in place, from block k's middle to the time at which the next drive begins.

    Args:
        laws: rows of ``AxisParameters``, shape (axes, 11). densities: shape (axes, 4), see ``_add_process_noise``.
        linear: ``Linearisation``, made for block k. transitions: of each axis, shape (axes, 2, DAMPING + 1); filled.
    """
    for a in range(len(laws)):
        law, at, h = unpack_parameters(laws[a]), a * AXIS_STATES, signal.step * signal.drive_share[k, a]
        _propagate_axis(laws, signal, k, a, h, densities[a], linear, x, P, transitions[a])
        # the phase is now relative to the next block's reference, extrapolated back to where its drive begins
        psi = signal.psi[k, a] + h * signal.w[k, a]
        x[at + PHASE] += psi - (signal.psi[k + 1, a] - (signal.step - h) * signal.w[k + 1, a])
        if signal.drive_share[k, a] != 0.5:
            x[at + PHASE], x[at + LOG_AMPLITUDE] = _step_drive(law, x[at : at + AXIS_STATES], signal, k, a)
    clip_amplitudes(laws, signal, x)


@njit(cache=True, error_model="numpy")
def extrapolate_state(laws, signal, k, x, linear):  # type: ignore[no-untyped-def]
    """First-order prediction of the state at the middle of block k + 1 from the state at the drive boundary.

    It serves as a linearisation point only.
    """
    out = x.copy()
    for a in range(len(laws)):
        at, h = a * AXIS_STATES, signal.step * (1.0 - signal.drive_share[k, a])
        rate = linear.rates[k, a, 0]
        out[at + PHASE] += h * (rate.imag + signal.w[k, a] - signal.w[k + 1, a])
        out[at + LOG_AMPLITUDE] += h * rate.real
        out[at + STIFFNESS] += h * x[at + STIFFNESS_RATE]
    clip_amplitudes(laws, signal, out)
    return out


@njit(cache=True, error_model="numpy")
def predict_to_block(laws, signal, k, x, P, densities, offset_density, linear, transitions):  # type: ignore[no-untyped-def]
    """Propagate state and covariance, in place, from the drive boundary to the middle of block k + 1.

    ``transitions`` of ``predict_to_boundary`` become those of the whole step. offset_density: [V^2/s].
    """
    second = np.empty((2, DAMPING + 1))
    for a in range(len(laws)):
        h = signal.step * (1.0 - signal.drive_share[k, a])
        _propagate_axis(laws, signal, k + 1, a, h, densities[a], linear, x, P, second)
        _compose_transitions(transitions[a], second, signal.step - h)
    clip_amplitudes(laws, signal, x)
    offset = AXIS_STATES * len(laws)
    P[offset, offset] += offset_density * signal.step
    for a in range(len(laws)):
        for i, limit in ((a * AXIS_STATES + PHASE, MAX_SD[0]), (a * AXIS_STATES + LOG_AMPLITUDE, MAX_SD[1])):
            if P[i, i] > limit * limit:
                scale = limit / np.sqrt(P[i, i])
                P[i, :] *= scale
                P[:, i] *= scale


@njit(cache=True, error_model="numpy")
def clip_amplitudes(laws, signal, x):  # type: ignore[no-untyped-def]
    """Clip each amplitude, in place, to MIN_AMPLITUDE_THETA0 and the largest one of the amplitude table."""
    for a in range(len(laws)):
        at, table = a * AXIS_STATES + LOG_AMPLITUDE, signal.amplitude_table
        low, high = np.log(MIN_AMPLITUDE_THETA0 * unpack_parameters(laws[a]).theta0), np.log(table[a, 0, -1])
        x[at] = min(max(x[at], low), high)
