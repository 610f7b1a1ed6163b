"""Free, smooth corrections, one for each stage: they locate a misfit, and stand in for physics that has no name yet.

Each is an ordinary term with many small amplitudes, so the same fit, the same evidence and the same pictures serve it.
The evidence charges for every amplitude that the recording fixes: a named law of one number wins wherever it is true.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit
from numpy.typing import NDArray

from scanner.lowpass import low_passed
from scanner.terms import Parameter, Term, View
from scanner.trajectory import BELL, TORQUE

Array = NDArray[np.float64]

DEGREE = 5
"""Highest total degree of the free force in angle and rate."""

POWERS = tuple((i, n - i) for n in range(2, DEGREE + 1) for i in range(n, -1, -1))
"""Powers of angle and rate in the free force, in the order of its coefficients."""

WAVES = 3
"""Cosines over the recording's length by which stiffness and damping may move beside a force over the state."""

STIFFNESSES, DAMPINGS = 20, 8
"""Cosines over the recording's length of stiffness and damping where nothing else of the mechanics is free."""

OFFSETS, GAINS, DELAYS = 6, 28, 20
"""Cosines over the recording's length of a readout's offset and gain, and of a delay: a few where the spectrum is full
of other things, up to a dozen cycles where nothing else stands."""

PLAYS = (0.125, 0.25, 0.5, 1.0)
"""Half-widths, over the signal's deviation, of the plays in a readout: weighed against each other they make up any
memory without rate (Prandtl-Ishlinskii)."""

FADING = (0.05, 0.25)
"""Shares of the recording's length over which stiffness and damping remember the swing, as what warms with it does."""

MEMORIES = (1.0, 4.0, 16.0)
"""Turns of the motion over which a delay remembers the swing: weighed against each other they make up any fading."""

STEEPEST = 2.0
"""Slope of the drive, over its deviation and rate, from which a law of it says no more: edges are steep without end."""

KNOTS = np.linspace(-1.0, 1.0, 15)
"""Angles, over the amplitude, between which the free mapping of a reference angle is straight."""

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
def play(signal, width):  # type: ignore[no-untyped-def]
    """What follows ``signal`` (n,) with a play of half-width ``width``, at rest at the first sample."""
    out = np.empty_like(signal)
    held = signal[0]
    for i in range(signal.size):
        held = min(max(held, signal[i] - width), signal[i] + width)
        out[i] = held
    return out


@njit(TORQUE, cache=True)
def _force(t, theta, omega, other, volt, z0, z1, p, nominal):  # type: ignore[no-untyped-def]
    x, y = theta / p[0], omega / (p[0] * p[1])
    total, at = 0.0, 3
    for n in range(2, DEGREE + 1):
        for j in range(n + 1):
            total += p[at] * x ** (n - j) * y**j
            at += 1
    total += (p[at] * z0 + p[at + 1] * z1) * x + (p[at + 2] * z0 + p[at + 3] * z1) * y
    turn = np.pi * t / p[2]
    total += _cosines(turn, p[at + 4 :: 2]) * x + _cosines(turn, p[at + 5 :: 2]) * y
    swing = x * x + y * y
    return -total * nominal[2] * p[0], (swing - z0) / (p[2] * FADING[0]), (swing - z1) / (p[2] * FADING[1])


@njit(TORQUE, cache=True)
def _wandering(t, theta, omega, other, volt, z0, z1, p, nominal):  # type: ignore[no-untyped-def]
    turn, damping = np.pi * t / p[1], 2 + STIFFNESSES
    force = _cosines(turn, p[2:damping]) * theta + _cosines(turn, p[damping:]) * omega / p[0]
    return -force * nominal[2], 0.0, 0.0


@njit(BELL, cache=True)
def _profile(theta, p, nominal):  # type: ignore[no-untyped-def]
    u = (theta - nominal[5]) / nominal[4]
    bell = nominal[3] * np.exp(-u * u)
    value, slope = 0.0, 0.0
    for i in range(5):
        n = (1, 3, 4, 5, 6)[i]
        value += p[i] * u**n
        slope += p[i] * (n * u ** (n - 1) - 2.0 * u ** (n + 1))
    return bell * value, bell * slope / nominal[4]


def waves(turn: Array, sizes: Sequence[float]) -> Array:
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


def _drive(voltage: Array, p: Sequence[float], view: View) -> Array:
    time = view.time[:-1, None] + view.step * np.array([0.0, 0.5, 1.0])
    turn, size, rate = np.pi * time / p[0], p[1], p[2]
    swing = voltage - view.raw_voltage.mean()
    slope = np.gradient(view.raw_voltage, view.step) / rate
    slopes = np.stack([slope[:-1], 0.5 * (slope[:-1] + slope[1:]), slope[1:]], axis=1)
    u, v = swing / size, np.clip(slopes / size, -STEEPEST, STEEPEST)
    gain, offset = waves(turn, [p[3], *p[9:12]]), waves(turn, [0.0, *p[12:]])
    bent = u * u * (p[5] + p[6] * u) + v * (p[7] * u + p[8] * v * v)
    return voltage + gain * swing + size * (offset + bent) + p[4] * slopes


def _readout(signal: Array, p: Sequence[float], view: View) -> Array:
    turn, size, rate, amplitude = np.pi * view.time / p[0], p[1], p[2], p[3]
    u = (signal - signal.mean()) / size
    slope = np.gradient(signal, view.step) / rate
    gains = 12 + OFFSETS
    memories = gains + GAINS
    offset, gain = waves(turn, [0.0, *p[12:gains]]), waves(turn, [0.0, *p[gains:memories]])
    behind = sum(part * (play(signal, width * size) - signal) for part, width in zip(p[memories:], PLAYS, strict=True))
    x, v = view.theta / amplitude, view.rate / (amplitude * rate)
    way = v / np.sqrt(x * x + v * v + 1e-6)
    by_rate = v * (p[7] + p[8] * x) + way * (p[9] + way * way * (p[10] + way * way * p[11]))
    bent = u * (gain + u * (p[4] + p[5] * u)) + offset
    return signal * (1.0 + by_rate) + size * bent + p[6] * slope + behind


def _timing(signal: Array, p: Sequence[float], view: View) -> Array:
    swing = (view.theta**2 + (view.rate / p[1]) ** 2) / p[2] ** 2
    fading = p[1] / (2.0 * np.pi) ** 2  # cut-off of what is remembered over one turn [Hz]
    behind = sum(m * (low_passed(swing, fading / n, view.step) - swing) for m, n in zip(p[5:8], MEMORIES, strict=True))
    late = waves(np.pi * view.time / p[0], p[8:]) + swing * (p[3] + p[4] * swing) + behind
    slope = np.gradient(signal, view.step)
    # to second order: half the square of a tenth of a radian is seen where the signal is a thousand times its noise
    return signal - late * (slope - 0.5 * late * np.gradient(slope, view.step))


def _optics(signal: Array, p: Sequence[float], view: View) -> Array:
    return signal + p[0] * np.interp(signal / p[0], KNOTS, p[1:])


def _size(i: int, j: int):  # type: ignore[no-untyped-def]
    """Prior size of a coefficient of the free force: of the stiffness for a spring, of the damping for a loss."""
    if j % 2:
        return lambda s: 0.5 * s.b * s.rate / s.k
    return lambda s: 0.03


FREE: dict[str, Term] = {
    term.effect: term
    for term in (
        Term(
            "free-mechanics", "mechanics", "J θ'' + b θ' + k θ + f(θ, θ', t, H_s[r]) = τ",
            (
                Parameter("A", "rad", lambda s: s.amplitude, kind="fixed"),
                Parameter("W", "rad/s", lambda s: s.rate, kind="fixed"),
                Parameter("T", "s", lambda s: s.duration, kind="fixed"),
                *(Parameter(f"f{i}{j}", "k A", _size(i, j)) for i, j in POWERS),
                *(Parameter(f"h{i}", "k", _size(1 - i // 2, i // 2)) for i in range(4)),
                *(
                    Parameter(f"{name}{j}", "k A", size)
                    for j in range(1, WAVES + 1)
                    for name, size in (("k", lambda s: 0.01), ("b", lambda s: 0.3 * s.b * s.rate / s.k))
                ),
            ),
            SOURCE, torque=_force, hidden=(lambda s: 1.0, lambda s: 1.0),
        ),
        Term(
            "free-stiffness", "mechanics", "J θ'' + (b + δb(t)) θ' + (k + δk(t)) θ = τ",
            (
                Parameter("W", "rad/s", lambda s: s.rate, kind="fixed"),
                Parameter("T", "s", lambda s: s.duration, kind="fixed"),
                *(Parameter(f"k{j}", "k", lambda s: 0.01) for j in range(1, STIFFNESSES + 1)),
                *(Parameter(f"b{j}", "k", lambda s: 0.3 * s.b * s.rate / s.k) for j in range(1, DAMPINGS + 1)),
            ),
            SOURCE, torque=_wandering,
        ),
        Term(
            "free-capacitance", "capacitance", "C(θ) + C0 exp(−u²) Σ a_n uⁿ",
            tuple(Parameter(f"a{n}", "1", lambda s: 0.07) for n in (1, 3, 4, 5, 6)),
            SOURCE, bell=_profile, applies=lambda axis, scales: axis.capacitance is not None,
        ),
        Term(
            "free-drive", "drive", "V + δV(V, V', t)",
            (
                Parameter("T", "s", lambda s: s.duration, kind="fixed"),
                Parameter("size", "V", lambda s: s.voltage_rms, kind="fixed"),
                Parameter("rate", "rad/s", lambda s: s.drive_rate, kind="fixed"),
                *(Parameter(f"v{i}", "1", lambda s: 0.04) for i in range(6)),
                *(Parameter(f"{name}{j}", "1", lambda s: 0.04) for name in "go" for j in range(1, WAVES + 1)),
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
                *(Parameter(f"o{i}", "1", lambda s: 0.04) for i in range(1, OFFSETS + 1)),
                *(Parameter(f"g{i}", "1", lambda s: 0.04) for i in range(1, GAINS + 1)),
                *(Parameter(f"m{i}", "1", lambda s: 0.04) for i in range(len(PLAYS))),
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
                *(Parameter(f"m{i}", "s", lambda s: 0.05 / s.rate) for i in range(len(MEMORIES))),
                *(Parameter(f"d{i}", "s", lambda s: 0.05 / s.rate) for i in range(DELAYS + 1)),
            ),
            SOURCE, output=_timing, channels=("sense", "angle"),
        ),
        Term(
            "free-optics", "optics", "θ_ref = θ + g(θ)",
            (
                Parameter("A", "rad", lambda s: s.amplitude, kind="fixed"),
                *(Parameter(f"c{i}", "1", lambda s: 0.02) for i in range(KNOTS.size)),
            ),
            SOURCE, output=_optics, channels=("angle",),
        ),
    )
}  # fmt: skip
"""By name; these are no names that a finding may bear."""
