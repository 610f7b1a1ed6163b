"""Discrepancy terms, one for each stage: flexible corrections that locate a misfit and represent effects without a law.

Each is an ordinary term with many small amplitudes, fitted and compared by evidence like any other. The evidence
charges for every amplitude that the data determine, so a true law with one parameter has the better evidence.

Source: model discrepancy of Kennedy & O'Hagan, J. R. Stat. Soc. B 63, 425 (2001), with polynomials and cosines.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit

from scanner.arrays import Array
from scanner.integrator.abi import CAPACITANCE_LAW, TORQUE_LAW
from scanner.lowpass import apply_lowpass
from scanner.terms import Parameter, SignalContext, Term

FORCE_DEGREE = 5
"""Highest total degree of the force polynomial in angle and rate. Higher degrees are hard to tell from lower ones over
one range of amplitudes."""

FORCE_POWERS = tuple((i, n - i) for n in range(2, FORCE_DEGREE + 1) for i in range(n, -1, -1))
"""Powers (i, j) of angle and rate in the force polynomial, in the order of its coefficients."""

FORCE_DRIFT_COSINES = 3
"""Cosines over the duration by which stiffness and damping may drift beside the force polynomial. Three describe a
monotonic drift; more belong to ``free-stiffness``."""

STIFFNESS_COSINES, DAMPING_COSINES = 20, 8
"""Numbers of cosines over the duration of stiffness and damping in ``free-stiffness``, the term without other freedom.
Damping acts on the channels through the slow amplitude only, so fewer are identifiable."""

OFFSET_COSINES, GAIN_COSINES, DELAY_COSINES = 6, 28, 20
"""Numbers of cosines over the duration of a readout's offset, of its gain and of a delay. The offset has few because
the low end of the spectrum also holds coloured noise; gain and delay reach about a dozen cycles."""

PLAY_HALF_WIDTHS = (0.125, 0.25, 0.5, 1.0)
"""Half-widths of the play operators in a readout, in standard deviations of the signal. Their weighted sum approximates
any rate-independent hysteresis (Prandtl-Ishlinskii); factors of two cover small loops and large ones."""

AMPLITUDE_MEMORY_SHARES = (0.05, 0.25)
"""Time constants with which stiffness and damping follow the squared amplitude, as heating does, as shares of the
duration. Slower ones look like a drift, faster ones like an amplitude dependence without memory."""

DELAY_MEMORY_PERIODS = (1.0, 4.0, 16.0)
"""Time constants with which a delay follows the squared amplitude, in periods of the motion. Their weighted sum
approximates any decay from one period to some dozens."""

MAX_DRIVE_SLOPE = 2.0
"""Largest slope of the drive, in its standard deviation times its rate, that its polynomial is evaluated at. The slope
of an edge has no bound and would dominate the polynomial."""

MAPPING_KNOTS = np.linspace(-1.0, 1.0, 15)
"""Angles, in amplitudes, between which the correction of a reference angle is linear. Fifteen knots resolve a seventh
of the amplitude."""

SOURCE = "free correction: polynomials and cosines, no physics of their own"


@njit(cache=True)
def _cosines(turn, sizes):  # type: ignore[no-untyped-def]
    """sum_j sizes[j - 1] cos(j turn)."""
    first = np.cos(turn)
    total, before, wave = 0.0, 1.0, first
    for i in range(len(sizes)):
        total += sizes[i] * wave
        before, wave = wave, 2.0 * first * wave - before
    return total


@njit(cache=True)
def apply_play(signal, width):  # type: ignore[no-untyped-def]
    """Output of a play operator of half-width ``width`` on ``signal``, shape (n,), at rest at the first sample."""
    out = np.empty_like(signal)
    held = signal[0]
    for i in range(signal.size):
        held = min(max(held, signal[i] - width), signal[i] + width)
        out[i] = held
    return out


@njit(TORQUE_LAW, cache=True)
def _force(t, theta, omega, other, volt, z0, z1, p, nominal):  # type: ignore[no-untyped-def]
    x, y = theta / p[0], omega / (p[0] * p[1])
    total, at = 0.0, 3
    for n in range(2, FORCE_DEGREE + 1):
        for j in range(n + 1):
            total += p[at] * x ** (n - j) * y**j
            at += 1
    total += (p[at] * z0 + p[at + 1] * z1) * x + (p[at + 2] * z0 + p[at + 3] * z1) * y
    turn = np.pi * t / p[2]
    total += _cosines(turn, p[at + 4 :: 2]) * x + _cosines(turn, p[at + 5 :: 2]) * y
    swing = x * x + y * y
    return (
        -total * nominal[2] * p[0],
        (swing - z0) / (p[2] * AMPLITUDE_MEMORY_SHARES[0]),
        (swing - z1) / (p[2] * AMPLITUDE_MEMORY_SHARES[1]),
    )


@njit(TORQUE_LAW, cache=True)
def _drifting_force(t, theta, omega, other, volt, z0, z1, p, nominal):  # type: ignore[no-untyped-def]
    turn, damping = np.pi * t / p[1], 2 + STIFFNESS_COSINES
    force = _cosines(turn, p[2:damping]) * theta + _cosines(turn, p[damping:]) * omega / p[0]
    return -force * nominal[2], 0.0, 0.0


@njit(CAPACITANCE_LAW, cache=True)
def _profile(theta, p, nominal):  # type: ignore[no-untyped-def]
    u = (theta - nominal[5]) / nominal[4]
    bell = nominal[3] * np.exp(-u * u)
    value, slope = 0.0, 0.0
    for i in range(5):
        n = (1, 3, 4, 5, 6)[i]
        value += p[i] * u**n
        slope += p[i] * (n * u ** (n - 1) - 2.0 * u ** (n + 1))
    return bell * value, bell * slope / nominal[4]


def cosine_series(turn: Array, sizes: Sequence[float]) -> Array:
    """sum_j sizes[j] cos(j turn), of the shape of ``turn``."""
    return np.asarray(_chebyshev(np.cos(turn).ravel(), np.asarray(sizes, float)).reshape(turn.shape))


@njit(cache=True, fastmath={"contract"})
def _chebyshev(cosine, sizes):  # type: ignore[no-untyped-def]
    """sum_j sizes[j] T_j(cosine) by Clenshaw's recurrence, piece by piece as the processor's first cache holds them."""
    out = np.empty_like(cosine)
    for first in range(0, cosine.size, 512):
        c = cosine[first : first + 512]
        one, two = np.zeros(c.size), np.zeros(c.size)
        for j in range(sizes.size - 1, 0, -1):
            for i in range(c.size):
                two[i] = sizes[j] + 2.0 * c[i] * one[i] - two[i]
            one, two = two, one
        for i in range(c.size):
            out[first + i] = sizes[0] + c[i] * one[i] - two[i]
    return out


def _drive(voltage: Array, p: Sequence[float], view: SignalContext) -> Array:
    time = view.time[:-1, None] + view.step * np.array([0.0, 0.5, 1.0])
    turn, size, rate = np.pi * time / p[0], p[1], p[2]
    swing = voltage - view.raw_voltage.mean()
    slope = np.gradient(view.raw_voltage, view.step) / rate
    slopes = np.stack([slope[:-1], 0.5 * (slope[:-1] + slope[1:]), slope[1:]], axis=1)
    u, v = swing / size, np.clip(slopes / size, -MAX_DRIVE_SLOPE, MAX_DRIVE_SLOPE)
    gain, offset = cosine_series(turn, [p[3], *p[9:12]]), cosine_series(turn, [0.0, *p[12:]])
    bent = u * u * (p[5] + p[6] * u) + v * (p[7] * u + p[8] * v * v)
    return voltage + gain * swing + size * (offset + bent) + p[4] * slopes


def _readout(signal: Array, p: Sequence[float], view: SignalContext) -> Array:
    turn, size, rate, amplitude = np.pi * view.time / p[0], p[1], p[2], p[3]
    u = (signal - signal.mean()) / size
    slope = np.gradient(signal, view.step) / rate
    gains = 12 + OFFSET_COSINES
    memories = gains + GAIN_COSINES
    offset, gain = cosine_series(turn, [0.0, *p[12:gains]]), cosine_series(turn, [0.0, *p[gains:memories]])
    behind = sum(
        part * (apply_play(signal, width * size) - signal)
        for part, width in zip(p[memories:], PLAY_HALF_WIDTHS, strict=True)
    )
    x, v = view.theta / amplitude, view.rate / (amplitude * rate)
    way = v / np.sqrt(x * x + v * v + 1e-6)
    by_rate = v * (p[7] + p[8] * x) + way * (p[9] + way * way * (p[10] + way * way * p[11]))
    bent = u * (gain + u * (p[4] + p[5] * u)) + offset
    return signal * (1.0 + by_rate) + size * bent + p[6] * slope + behind


def _timing(signal: Array, p: Sequence[float], view: SignalContext) -> Array:
    swing = (view.theta**2 + (view.rate / p[1]) ** 2) / p[2] ** 2
    fading = p[1] / (2.0 * np.pi) ** 2  # cut-off of a memory of one period [Hz]
    behind = sum(
        m * (apply_lowpass(swing, fading / n, view.step) - swing)
        for m, n in zip(p[5:8], DELAY_MEMORY_PERIODS, strict=True)
    )
    late = cosine_series(np.pi * view.time / p[0], p[8:]) + swing * (p[3] + p[4] * swing) + behind
    slope = np.gradient(signal, view.step)
    # to second order: at a delay of 0.1 rad the second-order term is 0.5 % of the signal
    return signal - late * (slope - 0.5 * late * np.gradient(slope, view.step))


def _optics(signal: Array, p: Sequence[float], view: SignalContext) -> Array:
    return signal + p[0] * np.interp(signal / p[0], MAPPING_KNOTS, p[1:])


def _prior_size(i: int, j: int):  # type: ignore[no-untyped-def]
    """Prior size of a force coefficient: relative to the stiffness for even powers of the rate, else to the damping."""
    if j % 2:
        return lambda s: 0.5 * s.b * s.rate / s.k
    return lambda s: 0.03


DISCREPANCY_TERMS: dict[str, Term] = {
    term.effect: term
    for term in (
        Term(
            "free-mechanics", "mechanics", "J θ'' + b θ' + k θ + f(θ, θ', t, H_s[r]) = τ",
            (
                Parameter("A", "rad", lambda s: s.amplitude, kind="fixed"),
                Parameter("W", "rad/s", lambda s: s.rate, kind="fixed"),
                Parameter("T", "s", lambda s: s.duration, kind="fixed"),
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
                Parameter("W", "rad/s", lambda s: s.rate, kind="fixed"),
                Parameter("T", "s", lambda s: s.duration, kind="fixed"),
                *(Parameter(f"k{j}", "k", lambda s: 0.01) for j in range(1, STIFFNESS_COSINES + 1)),
                *(Parameter(f"b{j}", "k", lambda s: 0.3 * s.b * s.rate / s.k) for j in range(1, DAMPING_COSINES + 1)),
            ),
            SOURCE, torque=_drifting_force,
        ),
        Term(
            "free-capacitance", "capacitance", "C(θ) + C0 exp(−u²) Σ a_n uⁿ",
            tuple(Parameter(f"a{n}", "1", lambda s: 0.07) for n in (1, 3, 4, 5, 6)),
            SOURCE, capacitance=_profile, applies=lambda axis, scales: axis.capacitance is not None,
        ),
        Term(
            "free-drive", "drive", "V + δV(V, V', t)",
            (
                Parameter("T", "s", lambda s: s.duration, kind="fixed"),
                Parameter("size", "V", lambda s: s.voltage_rms, kind="fixed"),
                Parameter("rate", "rad/s", lambda s: s.drive_rate, kind="fixed"),
                *(Parameter(f"v{i}", "1", lambda s: 0.04) for i in range(6)),
                *(
                    Parameter(f"{name}{j}", "1", lambda s: 0.04)
                    for name in "go"
                    for j in range(1, FORCE_DRIFT_COSINES + 1)
                ),
            ),
            SOURCE, voltage=_drive, applies=lambda axis, scales: scales.voltage_rms > 0,
        ),
        Term(
            "free-readout", "readout", "y + δy(y, y', θ', t) + Σ m_h P_h[y]",
            (
                Parameter("T", "s", lambda s: s.duration, kind="fixed"),
                Parameter("size", "V", lambda s: s.sense_rms, kind="fixed"),
                Parameter("rate", "rad/s", lambda s: s.rate, kind="fixed"),
                Parameter("A", "rad", lambda s: s.amplitude, kind="fixed"),
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
                Parameter("T", "s", lambda s: s.duration, kind="fixed"),
                Parameter("W", "rad/s", lambda s: s.rate, kind="fixed"),
                Parameter("A", "rad", lambda s: s.amplitude, kind="fixed"),
                *(Parameter(f"r{i}", "s", lambda s: 0.05 / s.rate) for i in (2, 4)),
                *(Parameter(f"m{i}", "s", lambda s: 0.05 / s.rate) for i in range(len(DELAY_MEMORY_PERIODS))),
                *(Parameter(f"d{i}", "s", lambda s: 0.05 / s.rate) for i in range(DELAY_COSINES + 1)),
            ),
            SOURCE, output=_timing, channels=("sense", "angle"),
        ),
        Term(
            "free-optics", "optics", "θ_ref = θ + g(θ)",
            (
                Parameter("A", "rad", lambda s: s.amplitude, kind="fixed"),
                *(Parameter(f"c{i}", "1", lambda s: 0.02) for i in range(MAPPING_KNOTS.size)),
            ),
            SOURCE, output=_optics, channels=("angle",),
        ),
    )
}  # fmt: skip
"""Discrepancy terms by name. A finding never reports these names as its effect."""
