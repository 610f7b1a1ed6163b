"""The equations of one axis, and a fifth-order integrator that locates every turning point under dry friction.

    J theta'' + b theta' + k theta = 1/2 C'(theta) V^2   (combs)   or   torque_per_volt V   (linear)

with every term of :class:`~benchmarks.blind.scanner_truth.Truth` added at its stage. The drive amplifier, the
demodulator's sections, a lagging readout, a second mode and memories are states of the same system. No filter is
discretised separately from the motion that it filters.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

import numpy as np
from numba import njit
from numpy.typing import NDArray

from benchmarks.blind.scanner_truth import Truth

Array = NDArray[np.float64]

THETA, RATE, AMPLIFIER, CREEP, MODE, MODE_RATE, MEMORY, SECTION_1, SECTION_2, READOUT = range(10)
FOREIGN, FOREIGN_RATE, SPRING_MEMORY, DRIVE_MEMORY, SLIP = range(10, 15)
STATES = 15

# Dormand and Prince (1980), the fifth-order formula of their pair 5(4): J. Comput. Appl. Math. 6, 19-26, table 2.
NODES = np.array([0.0, 1 / 5, 3 / 10, 4 / 5, 8 / 9, 1.0])
STAGES = len(NODES)
A = np.zeros((STAGES, STAGES))
A[1, :1] = [1 / 5]
A[2, :2] = [3 / 40, 9 / 40]
A[3, :3] = [44 / 45, -56 / 15, 32 / 9]
A[4, :4] = [19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729]
A[5, :5] = [9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656]
B = np.array([35 / 384, 0.0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84])


@dataclass(frozen=True)
class Trajectory:
    """States on a uniform grid, with interpolation to any time in between.

    Attributes:
        start: time of the first state [s].
        step: [s].
        states: (n, STATES).
        slopes: their time derivatives, (n, STATES).
    """

    start: float
    step: float
    states: Array
    slopes: Array

    def at(self, times: Array, state: int) -> Array:
        """One state at ``times`` (n,) [s], by the cubic that meets values and slopes at both ends of a step."""
        position = (times - self.start) / self.step
        i = np.clip(position.astype(np.int64), 0, len(self.states) - 2)
        x = position - i
        left, right = self.states[i, state], self.states[i + 1, state]
        rise, d0, d1 = right - left, self.step * self.slopes[i, state], self.step * self.slopes[i + 1, state]
        return left + x * (d0 + x * ((3 * rise - 2 * d0 - d1) + x * (d0 + d1 - 2 * rise)))


def integrate(truth: Truth, voltages: Array, start: float, step: float, initial: Array) -> Trajectory:
    """The motion under a drive.

    Args:
        truth: the axis.
        voltages: command at the NODES of every step, (n, STAGES) [V].
        start: time of the first state [s]; drifts begin at 0.
        step: [s].
        initial: (STATES,).
    """
    states, slopes = _integrate(truth, voltages, start, step, initial)
    return Trajectory(start, step, states, slopes)


@njit(cache=True, error_model="numpy")
def capacitance(theta: float, p: Truth) -> float:  # numba compiles it for arrays as well
    """C0 exp(-u^2) (1 + shape u^4) + Cb with u = (theta - theta_c)/theta0, and a parasitic that saturates [F]."""
    u2 = ((theta - p.theta_c) / p.theta0) ** 2
    bell = p.C0 * np.exp(-u2) * (1.0 + p.shape * u2 * u2) + p.Cb
    if p.parasitic == 0.0:
        return bell
    return bell + p.parasitic * p.parasitic_angle * np.tanh(theta / p.parasitic_angle)


@njit(cache=True, error_model="numpy")
def capacitance_slope(theta: float, p: Truth) -> float:
    """dC/dtheta of :func:`capacitance` [F/rad]."""
    u = (theta - p.theta_c) / p.theta0
    u2 = u * u
    bell = p.C0 * np.exp(-u2) / p.theta0 * u * (-2.0 + p.shape * u2 * (4.0 - 2.0 * u2))
    if p.parasitic == 0.0:
        return bell
    return bell + p.parasitic / np.cosh(theta / p.parasitic_angle) ** 2


@njit(cache=True, error_model="numpy")
def detected(c: float, p: Truth) -> float:
    """The envelope detector's output in farads: the capacitance, its modulus with carrier leakage, or its square."""
    if p.leak != 0.0:
        c = np.sqrt(c * c + 2.0 * c * p.leak * np.cos(p.leak_phase) + p.leak * p.leak)
    if p.square_Cp < inf:
        at = p.square_at + p.square_Cp
        c = p.square_at + ((c + p.square_Cp) ** 2 - at * at) / (2.0 * at)
    return c


@njit(cache=True, error_model="numpy")
def flat_output(theta: float, rate: float, section: float, bias: float, p: Truth) -> float:
    """The output of a readout without errors, without its offset [V]."""
    if p.R_s != 0.0:
        return -p.R_s * bias * capacitance_slope(theta, p) * rate
    if p.a_cir != 0.0:
        return p.a_cir * section
    return p.gain * theta


@njit(cache=True, error_model="numpy")
def settled(change: float, tau: float, t: float) -> float:
    """change (1 - exp(-t/tau)) from t = 0 on."""
    if change == 0.0 or t <= 0.0:
        return 0.0
    return change * (1.0 - np.exp(-t / tau))


@njit(cache=True, error_model="numpy")
def comb_voltage(command: float, amplifier: float, memory: float, t: float, p: Truth) -> float:
    """Voltage at the actuator."""
    v = command
    if p.drive_corner < inf or p.slew < inf:
        v = amplifier
    v = p.drive_mean + p.droop * (v - p.drive_mean)
    v *= 1.0 - p.drive_memory * memory
    return v * (1.0 - p.compression * v * v) + settled(p.charge, p.charge_tau, t)


@njit(cache=True, error_model="numpy")
def torque(t: float, s: Array, command: float, p: Truth) -> float:
    """All torque on the mirror except dry friction [N m]."""
    theta, rate = s[THETA], s[RATE]
    v = comb_voltage(command, s[AMPLIFIER], s[DRIVE_MEMORY], t, p)
    if p.torque_per_volt != 0.0:
        applied = p.torque_per_volt * v
    else:
        applied = 0.5 * capacitance_slope(theta, p) * (v * v + p.carrier)
    k = p.scale * p.k * (1.0 + settled(p.dk, p.dk_tau, t))
    if p.wander != 0.0:
        k += p.scale * p.k * p.wander * np.sin(p.wander_frequency * t)
    k *= 1.0 + p.spring_memory * s[SPRING_MEMORY]
    b = p.scale * p.b * (1.0 + settled(p.db, p.db_tau, t) + p.warming * s[MEMORY])
    spring = theta * (k + theta * (p.k2 + theta * (p.k3 + theta * theta * p.k5))) + p.k_v * (theta - s[CREEP])
    if p.pendulum != 0.0:
        spring += p.pendulum * k * (np.sin(theta) - theta)
    spring += p.slip_stiffness * s[SLIP]
    if p.kink_stiffness != 0.0:
        spring += p.kink_stiffness * max(theta - p.kink_angle, 0.0)
    damping = rate * (b + p.b2 * abs(rate) + p.b3 * theta * theta)
    mode = p.scale * p.J * (p.mode_coupling * s[MODE] - 0.5 * p.mode_exchange * s[MODE] ** 2)
    return applied - spring - damping + mode + p.scale * p.J * p.foreign_coupling * s[FOREIGN]


@njit(cache=True, error_model="numpy")
def imperfection_slopes(s: Array, command: float, p: Truth, out: Array) -> None:
    """Time derivatives of the states of unlisted imperfections.

    The pivot that slips is a Bouc-Wen element (Wen, J. Eng. Mech. Div. ASCE 102, 249, 1976) with exponent 2: its torque
    follows the angle while the deflection is small, and is constant beyond ``slip_angle``.
    """
    theta, rate = s[THETA], s[RATE]
    out[FOREIGN] = s[FOREIGN_RATE]
    out[FOREIGN_RATE] = (
        p.foreign_coupling * theta - p.foreign_damping * s[FOREIGN_RATE] - p.foreign_frequency**2 * s[FOREIGN]
    )
    out[SPRING_MEMORY] = (theta * theta - s[SPRING_MEMORY]) / p.spring_tau if p.spring_memory != 0.0 else 0.0
    out[DRIVE_MEMORY] = (command * command - s[DRIVE_MEMORY]) / p.drive_tau if p.drive_memory != 0.0 else 0.0
    out[SLIP] = 0.0
    if p.slip_stiffness != 0.0:
        share = s[SLIP] / p.slip_angle
        out[SLIP] = rate * (1.0 - share * share) if rate * s[SLIP] > 0.0 else rate


@njit(cache=True, error_model="numpy")
def slope(t: float, s: Array, command: float, sliding: float, p: Truth, out: Array) -> None:
    """Time derivative of all states; ``sliding`` is the sign of the rate, or 0 while dry friction holds the mirror."""
    theta, rate = s[THETA], s[RATE]
    held = p.tau_c > 0.0 and sliding == 0.0
    out[THETA] = 0.0 if held else rate
    out[RATE] = 0.0 if held else (torque(t, s, command, p) - p.tau_c * sliding) / (p.scale * p.J)
    out[AMPLIFIER] = 0.0
    if p.drive_corner < inf:
        out[AMPLIFIER] = min(max(p.drive_corner * (command - s[AMPLIFIER]), -p.slew), p.slew)
    out[CREEP] = (theta - s[CREEP]) / p.tau_v if p.k_v != 0.0 else 0.0
    out[MODE] = s[MODE_RATE]
    stiffness = p.mode_frequency**2 + p.mode_exchange * theta
    out[MODE_RATE] = p.mode_coupling * theta - p.mode_damping * s[MODE_RATE] - stiffness * s[MODE]
    out[MEMORY] = (theta * theta - s[MEMORY]) / p.memory
    imperfection_slopes(s, command, p, out)
    if p.a_cir != 0.0:
        out[SECTION_1] = p.sections * p.section_1 * (detected(capacitance(theta, p), p) - s[SECTION_1])
        out[SECTION_2] = p.sections * p.section_2 * (s[SECTION_1] - s[SECTION_2])
    else:
        out[SECTION_1] = out[SECTION_2] = 0.0
    out[READOUT] = 0.0
    if p.readout_corner < inf:
        bias = command + settled(p.charge, p.charge_tau, t)
        out[READOUT] = p.readout_corner * (flat_output(theta, rate, s[SECTION_2], bias, p) - s[READOUT])


@njit(cache=True, error_model="numpy")
def advance(t: float, h: float, s: Array, commands: Array, sliding: float, p: Truth, K: Array, out: Array) -> None:
    """One Dormand-Prince step from ``s`` into ``out``; K (STAGES, STATES) receives the stage slopes."""
    for i in range(STAGES):
        _moved(s, h, A[i], K[:i], out)
        slope(t + NODES[i] * h, out, commands[i], sliding, p, K[i])
    _moved(s, h, B, K, out)


@njit(cache=True, error_model="numpy")
def _moved(s: Array, h: float, weights: Array, K: Array, out: Array) -> None:
    """s + h weights K into ``out``, states innermost: they lie side by side."""
    out[:] = 0.0
    for j in range(len(K)):
        for m in range(STATES):
            out[m] += weights[j] * K[j, m]
    for m in range(STATES):
        out[m] = s[m] + h * out[m]


@njit(cache=True, error_model="numpy")
def between(commands: Array, x0: float, x1: float, out: Array) -> None:
    """Commands at the nodes of the part [x0, x1] of a step: Lagrange's polynomial through those of the whole."""
    for i in range(STAGES):
        x = x0 + NODES[i] * (x1 - x0)
        out[i] = 0.0
        for j in range(STAGES):
            weight = 1.0
            for m in range(STAGES):
                if m != j:
                    weight *= (x - NODES[m]) / (NODES[j] - NODES[m])
            out[i] += weight * commands[j]


@njit(cache=True, error_model="numpy")
def released(t: float, s: Array, command: float, p: Truth) -> float:
    """Direction in which a mirror at rest starts to slide, 0 when dry friction holds it."""
    push = torque(t, s, command, p)
    return np.sign(push) if abs(push) > p.tau_c else 0.0


@njit(cache=True, error_model="numpy")
def advance_with_friction(
    t: float, h: float, s: Array, commands: Array, sliding: float, p: Truth, K: Array, out: Array
) -> float:
    """As :func:`advance`, split where the rate passes zero; the sign of sliding afterwards is returned.

    A step across the jump of the friction's sign has an error of up to 2 tau_c h / J in the rate, in every half period
    with the same sign. That would look like other damping, so the turning point is located by bisection.
    """
    part = np.empty(STAGES)
    done = 0.0
    for _ in range(4):
        if sliding == 0.0:
            s[RATE] = 0.0
            between(commands, done, 1.0, part)
            sliding = released(t + done * h, s, part[0], p)
        between(commands, done, 1.0, part)
        advance(t + done * h, (1.0 - done) * h, s, part, sliding, p, K, out)
        if out[RATE] * sliding >= 0.0:
            return sliding
        low, high = done, 1.0
        for _ in range(40):
            middle = 0.5 * (low + high)
            between(commands, done, middle, part)
            advance(t + done * h, (middle - done) * h, s, part, sliding, p, K, out)
            if out[RATE] * sliding >= 0.0:
                low = middle
            else:
                high = middle
        s[:] = out
        done, sliding = high, 0.0
    return sliding


@njit(cache=True, error_model="numpy")
def _integrate(p: Truth, voltages: Array, start: float, step: float, initial: Array) -> tuple[Array, Array]:
    n = len(voltages)
    states, slopes = np.empty((n + 1, STATES)), np.empty((n + 1, STATES))
    s, out, K = initial.copy(), np.empty(STATES), np.empty((STAGES, STATES))
    sliding = np.sign(s[RATE])
    for i in range(n):
        t = start + i * step
        states[i] = s
        slope(t, s, voltages[i, 0], sliding, p, slopes[i])
        if p.tau_c > 0.0:
            sliding = advance_with_friction(t, step, s, voltages[i], sliding, p, K, out)
        else:
            advance(t, step, s, voltages[i], sliding, p, K, out)
        s[:] = out
    states[n] = s
    slope(start + n * step, s, voltages[n - 1, STAGES - 1], sliding, p, slopes[n])
    return states, slopes
