"""Discrepancy terms, one for each stage: flexible corrections that locate a misfit and represent effects without a law.

Each is an ordinary term with many small amplitudes, fitted and compared by evidence like any other. The evidence
charges for every amplitude that the data determine, so a true law with one parameter has the better evidence.

Source: model discrepancy of Kennedy & O'Hagan, J. R. Stat. Soc. B 63, 425 (2001), with polynomials and cosines.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit
from numba.extending import register_jitable

from estimation.candidate_terms.curves import CURVE_TERMS
from estimation.device_fit.parameters import Candidate
from scanner.arrays import Array
from scanner.integrator.abi import CAPACITANCE_LAW, TORQUE_LAW
from scanner.integrator.elementary import cosine_of_half_turns
from scanner.lowpass import apply_lowpass
from scanner.terms import Parameter, SignalContext, Term

FORCE_DEGREE = 5
"""Highest total degree of the force polynomial in angle and rate. Over one range of amplitudes, higher degrees can
hardly be distinguished from lower ones."""

FORCE_POWERS = tuple((i, n - i) for n in range(2, FORCE_DEGREE + 1) for i in range(n, -1, -1))
"""Powers (i, j) of angle and rate in the force polynomial, in the order of its coefficients."""

N_FORCE_POWERS = len(FORCE_POWERS)
"""Number of coefficients of the force polynomial."""

PROFILE_POWERS = (1, 3, 4, 5, 6)
"""Powers of (angle - theta_th) / theta0 in the extra capacitance, in the order of its coefficients. The powers 0 and 2
change height and width of the comb's Gaussian, which are nominal values."""

FORCE_DRIFT_COSINES = 3
"""Number of cosines over the duration for the drift of stiffness and damping in ``free-mechanics``. Three describe a
monotonic drift; other drifts are described by ``free-stiffness``."""

STIFFNESS_COSINES, DAMPING_COSINES = 20, 8
"""Numbers of cosines over the duration of stiffness and damping in ``free-stiffness``, which has no other parameters.
Damping acts on the channels through the slow amplitude only, so fewer are identifiable."""

OFFSET_COSINES, GAIN_COSINES, DELAY_COSINES = 6, 28, 20
"""Numbers of cosines over the duration of a readout's offset, of its gain and of a delay. The offset has few because
the low end of the spectrum also holds coloured noise; gain and delay reach about a dozen cycles."""

PLAY_HALF_WIDTHS = (0.125, 0.25, 0.5, 1.0)
"""Half-widths of the play operators in a readout, in standard deviations of the signal. Their weighted sum approximates
any rate-independent hysteresis (Prandtl-Ishlinskii); factors of two cover small loops and large ones."""

AMPLITUDE_MEMORY_SHARES = (0.05, 0.25)
"""Time constants with which stiffness and damping follow the squared amplitude, as heating does, as shares of the
duration. Slower ones cannot be distinguished from a drift, faster ones not from an amplitude dependence without
memory."""

DELAY_MEMORY_PERIODS = (1.0, 4.0, 16.0)
"""Time constants with which a delay follows the squared amplitude, in periods of the motion. Their weighted sum
approximates any decay from one period to some dozens."""

MAX_DRIVE_SLOPE = 2.0
"""Largest slope of the drive, in its standard deviation times its rate, that its polynomial is evaluated at. The slope
of an edge has no bound and would dominate the polynomial."""

MAPPING_KNOTS = np.linspace(-1.0, 1.0, 15)
"""Angles, in amplitudes, between which the correction of a reference angle is linear. Fifteen knots resolve a seventh
of the amplitude."""

SOURCE = "discrepancy term (Kennedy & O'Hagan 2001): polynomials and cosines without a physical model"


@njit(cache=True, nogil=True)
def apply_play(signal, width):  # type: ignore[no-untyped-def]
    """Output of a play operator of half-width ``width`` for ``signal``, shape (n,), equal to it at the first sample."""
    output = np.empty_like(signal)
    state = signal[0]
    for i in range(signal.size):
        state = min(max(state, signal[i] - width), signal[i] + width)
        output[i] = state
    return output


@register_jitable(forceinline=True)
def _force_polynomial(x, y, p):  # type: ignore[no-untyped-def]
    """Sum of the terms of ``FORCE_POWERS`` with the coefficients p[3] to p[20], by Horner's scheme."""
    f0 = x * x * (p[3] + x * (p[6] + x * (p[10] + x * p[15])))
    f1 = x * (p[4] + x * (p[7] + x * (p[11] + x * p[16])))
    f2 = p[5] + x * (p[8] + x * (p[12] + x * p[17]))
    f3 = p[9] + x * (p[13] + x * p[18])
    f4 = p[14] + x * p[19]
    return f0 + y * (f1 + y * (f2 + y * (f3 + y * (f4 + y * p[20]))))


@njit(TORQUE_LAW, cache=True)
def _force(t, theta, omega, other, volt, z0, z1, p, nominal):  # type: ignore[no-untyped-def]
    """Force polynomial up to ``FORCE_DEGREE``, drift and memory: torque [N m] and the rates of two hidden states.

    All loops have constant ranges, so the compiler unrolls them and evaluates several motions at once.
    """
    x, y = theta / p[0], omega / (p[0] * p[1])
    cosine = cosine_of_half_turns(t / p[2])
    total = _force_polynomial(x, y, p)
    memory = 3 + N_FORCE_POWERS
    stiffness = p[memory] * z0 + p[memory + 1] * z1
    damping = p[memory + 2] * z0 + p[memory + 3] * z1
    previous, current = 1.0, cosine
    for i in range(FORCE_DRIFT_COSINES):
        stiffness += p[memory + 4 + 2 * i] * current
        damping += p[memory + 5 + 2 * i] * current
        previous, current = current, 2.0 * cosine * current - previous
    total += stiffness * x + damping * y
    amplitude_squared = x * x + y * y
    return (
        -total * nominal.k * p[0],
        (amplitude_squared - z0) / (p[2] * AMPLITUDE_MEMORY_SHARES[0]),
        (amplitude_squared - z1) / (p[2] * AMPLITUDE_MEMORY_SHARES[1]),
    )


@register_jitable(forceinline=True)
def _cosine_sum(p, first, count, cosine):  # type: ignore[no-untyped-def]
    """sum_j p[first + j - 1] cos(j phase), j = 1 to ``count``, from cos(phase) by Clenshaw's recurrence."""
    newer, older = 0.0, 0.0
    for i in range(count):
        newer, older = p[first + count - 1 - i] + 2.0 * cosine * newer - older, newer
    return cosine * newer - older


@njit(TORQUE_LAW, cache=True)
def _drifting_force(t, theta, omega, other, volt, z0, z1, p, nominal):  # type: ignore[no-untyped-def]
    """Torque [N m] of a stiffness and a damping that depend on time."""
    cosine = cosine_of_half_turns(t / p[1])
    stiffness = _cosine_sum(p, 2, STIFFNESS_COSINES, cosine)
    damping = _cosine_sum(p, 2 + STIFFNESS_COSINES, DAMPING_COSINES, cosine)
    return -(stiffness * theta + damping * omega / p[0]) * nominal.k, 0.0, 0.0


@njit(CAPACITANCE_LAW, cache=True)
def _profile(theta, p, nominal):  # type: ignore[no-untyped-def]
    """Extra capacitance [F], a Gaussian times a polynomial, and its slope over the angle [F/rad]."""
    u = (theta - nominal.theta_th) / nominal.theta0
    gaussian = nominal.C0 * np.exp(-u * u)
    value, slope = 0.0, 0.0
    for i in range(len(PROFILE_POWERS)):
        n = PROFILE_POWERS[i]
        value += p[i] * u**n
        slope += p[i] * (n * u ** (n - 1) - 2.0 * u ** (n + 1))
    return gaussian * value, gaussian * slope / nominal.theta0


def cosine_series(phase: Array, coefficients: Sequence[float]) -> Array:
    """sum_j coefficients[j] cos(j phase), of the shape of ``phase`` [rad]."""
    leading = np.trim_zeros(np.asarray(coefficients, float), "b")
    if leading.size == 0:
        return np.zeros(phase.shape)
    return np.asarray(_chebyshev(np.cos(phase).ravel(), leading).reshape(phase.shape))


@njit(cache=True, nogil=True, fastmath={"contract"})
def _chebyshev(cosine, coefficients):  # type: ignore[no-untyped-def]
    """sum_j coefficients[j] T_j(cosine) by Clenshaw's recurrence, in pieces that fit into the first cache."""
    series = np.empty_like(cosine)
    for first in range(0, cosine.size, 512):
        c = cosine[first : first + 512]
        newer, older = np.zeros(c.size), np.zeros(c.size)
        for j in range(coefficients.size - 1, 0, -1):
            for i in range(c.size):
                older[i] = coefficients[j] + 2.0 * c[i] * newer[i] - older[i]
            newer, older = older, newer
        for i in range(c.size):
            series[first + i] = coefficients[0] + c[i] * newer[i] - older[i]
    return series


def _drive(voltage: Array, p: Sequence[float], context: SignalContext) -> Array:
    """Drive voltage with a gain, an offset and a delay that depend on time and on the voltage."""
    time = context.time[:-1, None] + context.step * np.array([0.0, 0.5, 1.0])
    phase, size, rate = np.pi * time / p[0], p[1], p[2]
    alternating = voltage - context.raw_voltage.mean()
    slope = np.gradient(context.raw_voltage, context.step) / rate
    slopes = np.stack([slope[:-1], 0.5 * (slope[:-1] + slope[1:]), slope[1:]], axis=1)
    u, v = alternating / size, np.clip(slopes / size, -MAX_DRIVE_SLOPE, MAX_DRIVE_SLOPE)
    gain, offset = cosine_series(phase, [p[3], *p[9:12]]), cosine_series(phase, [0.0, *p[12:]])
    nonlinear = u * u * (p[5] + p[6] * u) + v * (p[7] * u + p[8] * v * v)
    return voltage + gain * alternating + size * (offset + nonlinear) + p[4] * slopes


def _readout(signal: Array, p: Sequence[float], context: SignalContext) -> Array:
    """Readout with an error that depends on the signal, its rate, the angle, the rate, time and previous samples."""
    phase, size, rate, amplitude = np.pi * context.time / p[0], p[1], p[2], p[3]
    u = (signal - signal.mean()) / size
    slope = np.gradient(signal, context.step) / rate
    gains = 12 + OFFSET_COSINES
    memories = gains + GAIN_COSINES
    offset, gain = cosine_series(phase, [0.0, *p[12:gains]]), cosine_series(phase, [0.0, *p[gains:memories]])
    hysteresis = sum(
        part * (apply_play(signal, width * size) - signal)
        for part, width in zip(p[memories:], PLAY_HALF_WIDTHS, strict=True)
        if part
    )
    by_rate = _gain_by_rate(p[7:12], context, rate, amplitude) if any(p[7:12]) else 0.0
    by_signal = u * (gain + u * (p[4] + p[5] * u)) + offset
    return signal * (1.0 + by_rate) + size * by_signal + p[6] * slope + hysteresis


def _gain_by_rate(p: Sequence[float], context: SignalContext, rate: float, amplitude: float) -> Array:
    """Relative change of a readout's gain with rate and direction of the motion, shape (n,)."""
    x, v = context.theta / amplitude, context.rate / (amplitude * rate)
    w = v / np.sqrt(x * x + v * v + 1e-6)
    return np.asarray(v * (p[0] + p[1] * x) + w * (p[2] + w * w * (p[3] + w * w * p[4])))


def _timing(signal: Array, p: Sequence[float], context: SignalContext) -> Array:
    """Signal delayed by an amount that depends on time, on the amplitude and on previous amplitudes."""
    r2 = (context.theta**2 + (context.rate / p[1]) ** 2) / p[2] ** 2
    cutoff = p[1] / (2.0 * np.pi) ** 2  # of a low-pass whose time constant is one period [Hz]
    memory = sum(
        m * (apply_lowpass(r2, cutoff / n, context.step) - r2)
        for m, n in zip(p[5:8], DELAY_MEMORY_PERIODS, strict=True)
        if m
    )
    delay = cosine_series(np.pi * context.time / p[0], p[8:]) + r2 * (p[3] + p[4] * r2) + memory
    slope = np.gradient(signal, context.step)
    # to second order: at a delay of 0.1 rad the second-order term is 0.5 % of the signal
    return signal - delay * (slope - 0.5 * delay * np.gradient(slope, context.step))


def _optics(signal: Array, p: Sequence[float], context: SignalContext) -> Array:
    """Reference angle with a piecewise linear error over the angle."""
    return signal + p[0] * np.interp(signal / p[0], MAPPING_KNOTS, p[1:])


def _prior_size(i: int, j: int):  # type: ignore[no-untyped-def]
    """Prior size of a force coefficient: relative to the stiffness for even powers of the rate, else to the damping."""
    if j % 2:
        return lambda s: 0.5 * s.b * s.rate / s.k
    return lambda s: 0.03


AMPLITUDE = Parameter("A", "rad", lambda s: s.amplitude, kind="fixed")
RATE = Parameter("W", "rad/s", lambda s: s.rate, kind="fixed")
DURATION = Parameter("T", "s", lambda s: s.duration, kind="fixed")
"""Scales of the motion that the laws of several terms take as parameters."""

DISCREPANCY_TERMS: dict[str, Term] = {
    term.effect: term
    for term in (
        Term(
            "free-mechanics", "mechanics", "J θ'' + b θ' + k θ + f(θ, θ', t, H_s[r]) = τ",
            (
                AMPLITUDE, RATE, DURATION,
                *(Parameter(f"f{i}{j}", "k A", _prior_size(i, j)) for i, j in FORCE_POWERS),
                *(Parameter(f"h{i}", "k", _prior_size(1 - i // 2, i // 2)) for i in range(4)),
                *(
                    Parameter(f"{name}{j}", "k A", size)
                    for j in range(1, FORCE_DRIFT_COSINES + 1)
                    for name, size in (("k", lambda s: 0.01), ("b", lambda s: 0.3 * s.b * s.rate / s.k))
                ),
            ),
            SOURCE, torque=_force, hidden_state_scales=(lambda s: 1.0, lambda s: 1.0),
        ),
        Term(
            "free-stiffness", "mechanics", "J θ'' + (b + δb(t)) θ' + (k + δk(t)) θ = τ",
            (
                RATE, DURATION,
                *(Parameter(f"k{j}", "k", lambda s: 0.01) for j in range(1, STIFFNESS_COSINES + 1)),
                *(Parameter(f"b{j}", "k", lambda s: 0.3 * s.b * s.rate / s.k) for j in range(1, DAMPING_COSINES + 1)),
            ),
            SOURCE, torque=_drifting_force,
        ),
        Term(
            "free-capacitance", "capacitance", "C(θ) + C0 exp(−u²) Σ a_n uⁿ",
            tuple(Parameter(f"a{n}", "1", lambda s: 0.07) for n in PROFILE_POWERS),
            SOURCE, capacitance=_profile, applies=lambda axis, scales: axis.capacitance is not None,
        ),
        Term(
            "free-drive", "drive", "V + δV(V, V', t)",
            (
                DURATION,
                Parameter("size", "V", lambda s: s.voltage_rms, kind="fixed"),
                Parameter("rate", "rad/s", lambda s: s.drive_rate, kind="fixed"),
                *(Parameter(f"v{i}", "1", lambda s: 0.04) for i in range(6)),
                *(Parameter(f"g{j}", "1", lambda s: 0.04) for j in range(1, FORCE_DRIFT_COSINES + 1)),
                *(Parameter(f"o{j}", "1", lambda s: 0.04) for j in range(1, FORCE_DRIFT_COSINES + 1)),
            ),
            SOURCE, voltage=_drive, applies=lambda axis, scales: scales.voltage_rms > 0,
        ),
        Term(
            "free-readout", "readout", "y + δy(y, y', θ', t) + Σ m_h P_h[y]",
            (
                DURATION,
                Parameter("size", "V", lambda s: s.sense_rms, kind="fixed"),
                Parameter("rate", "rad/s", lambda s: s.rate, kind="fixed"),
                AMPLITUDE,
                *(Parameter(f"y{i}", "1", lambda s: 0.04) for i in range(3)),
                *(Parameter(f"w{i}", "1", lambda s: 0.02) for i in range(5)),
                *(Parameter(f"o{i}", "1", lambda s: 0.04) for i in range(1, OFFSET_COSINES + 1)),
                *(Parameter(f"g{i}", "1", lambda s: 0.04) for i in range(1, GAIN_COSINES + 1)),
                *(Parameter(f"m{i}", "1", lambda s: 0.04) for i in range(len(PLAY_HALF_WIDTHS))),
            ),
            SOURCE, output=_readout,
        ),
        Term(
            "free-timing", "timing", "y(t − δ(t, r, M_n[r]))",
            (
                DURATION, RATE, AMPLITUDE,
                *(Parameter(f"r{i}", "s", lambda s: 0.05 / s.rate) for i in (2, 4)),
                *(Parameter(f"m{i}", "s", lambda s: 0.05 / s.rate) for i in range(len(DELAY_MEMORY_PERIODS))),
                *(Parameter(f"d{i}", "s", lambda s: 0.05 / s.rate) for i in range(DELAY_COSINES + 1)),
            ),
            SOURCE, output=_timing, channels=("sense", "angle"),
        ),
        Term(
            "free-optics", "optics", "θ_ref = θ + g(θ)",
            (
                AMPLITUDE,
                *(Parameter(f"c{i}", "1", lambda s: 0.02) for i in range(MAPPING_KNOTS.size)),
            ),
            SOURCE, output=_optics, channels=("angle",),
        ),
    )
}  # fmt: skip
"""Discrepancy terms by name, beside which laws are selected. A finding never reports these names as its effect."""


def is_discrepancy(candidate: Candidate) -> bool:
    """Whether a term is a discrepancy term."""
    return candidate.term.effect in DISCREPANCY_TERMS or candidate.term.effect in CURVE_TERMS
