"""Free, smooth corrections, one for each stage: they locate a misfit, and stand in for physics that has no name yet.

Each is an ordinary term with many small amplitudes, so the same fit, the same evidence and the same pictures serve it.
The evidence charges for every amplitude that the recording fixes: a named law of one number wins wherever it is true.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit
from numpy.polynomial.chebyshev import chebval
from numpy.typing import NDArray

from scanner.terms import Parameter, Term, View
from scanner.trajectory import BELL, TORQUE

Array = NDArray[np.float64]

DEGREE = 5
"""Highest total degree of the free force in angle and rate."""

POWERS = tuple((i, n - i) for n in range(2, DEGREE + 1) for i in range(n, -1, -1))
"""Powers of angle and rate in the free force, in the order of its coefficients."""

WAVES = 3
"""Cosines over the recording's length by which stiffness and damping may move."""

OFFSETS, GAINS, DELAYS = 6, 28, 20
"""Cosines over the recording's length of a readout's offset and gain, and of a delay: a few where the spectrum is full
of other things, up to a dozen cycles where nothing else stands."""

KNOTS = np.linspace(-1.0, 1.0, 15)
"""Angles, over the amplitude, between which the free mapping of a reference angle is straight."""

SOURCE = "free correction: polynomials and cosines, no physics of their own"


@njit(TORQUE, cache=True)
def _force(t, theta, omega, other, volt, z0, z1, p, nominal):  # type: ignore[no-untyped-def]
    x, y = theta / p[0], omega / (p[0] * p[1])
    total, at = 0.0, 3
    for n in range(2, DEGREE + 1):
        for j in range(n + 1):
            total += p[at] * x ** (n - j) * y**j
            at += 1
    first = np.cos(np.pi * t / p[2])
    before, wave = 1.0, first
    for _ in range(WAVES):
        total += (p[at] * x + p[at + 1] * y) * wave
        before, wave = wave, 2.0 * first * wave - before
        at += 2
    return -total * nominal[2] * p[0], 0.0, 0.0


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
    """sum_j sizes[j] cos(j turn), of the shape of ``turn``; cos(j turn) is Chebyshev's polynomial of its cosine."""
    return np.asarray(chebval(np.cos(turn), np.asarray(sizes)))


def _drive(voltage: Array, p: Sequence[float], view: View) -> Array:
    time = view.time[:-1, None] + view.step * np.array([0.0, 0.5, 1.0])
    turn, size, rate = np.pi * time / p[0], p[1], p[2]
    mean = view.raw_voltage.mean()
    swing = voltage - mean
    slope = np.gradient(view.raw_voltage, view.step)
    slopes = np.stack([slope[:-1], 0.5 * (slope[:-1] + slope[1:]), slope[1:]], axis=1)
    gain, offset = waves(turn, [p[3], *p[6::2]]), waves(turn, [0.0, *p[7::2]])
    return voltage + (gain + p[5] / size * swing) * swing + size * offset + p[4] / rate * slopes


def _readout(signal: Array, p: Sequence[float], view: View) -> Array:
    turn, size, rate = np.pi * view.time / p[0], p[1], p[2]
    swing = signal - signal.mean()
    slope = np.gradient(signal, view.step) / rate
    offset = waves(turn, [0.0, *p[6 : 6 + OFFSETS]])
    gain = waves(turn, [0.0, *p[6 + OFFSETS :]])
    u = swing / size
    return signal + swing * (gain + u * (p[3] + p[4] * u)) + size * offset + p[5] * slope


def _timing(signal: Array, p: Sequence[float], view: View) -> Array:
    late = waves(np.pi * view.time / p[0], p[1:])
    return signal - late * np.gradient(signal, view.step)


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
            "free-mechanics", "mechanics", "J θ'' + b θ' + k θ + f(θ, θ', t) = τ",
            (
                Parameter("A", "rad", lambda s: s.amplitude, kind="fixed"),
                Parameter("W", "rad/s", lambda s: s.rate, kind="fixed"),
                Parameter("T", "s", lambda s: s.duration, kind="fixed"),
                *(Parameter(f"f{i}{j}", "k A", _size(i, j)) for i, j in POWERS),
                *(
                    Parameter(f"{name}{j}", "k A", size)
                    for j in range(1, WAVES + 1)
                    for name, size in (("k", lambda s: 0.01), ("b", lambda s: 0.3 * s.b * s.rate / s.k))
                ),
            ),
            SOURCE, torque=_force,
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
                *(Parameter(f"v{i}", "1", lambda s: 0.04) for i in range(9)),
            ),
            SOURCE, voltage=_drive, applies=lambda axis, scales: scales.voltage_rms > 0,
        ),
        Term(
            "free-readout", "readout", "y + δy(y, y', t)",
            (
                Parameter("T", "s", lambda s: s.duration, kind="fixed"),
                Parameter("size", "V", lambda s: s.sense_rms, kind="fixed"),
                Parameter("rate", "rad/s", lambda s: s.rate, kind="fixed"),
                *(Parameter(f"y{i}", "1", lambda s: 0.04) for i in range(3 + OFFSETS)),
                *(Parameter(f"g{i}", "1", lambda s: 0.04) for i in range(1, GAINS + 1)),
            ),
            SOURCE, output=_readout,
        ),
        Term(
            "free-timing", "timing", "y(t − δ(t))",
            (
                Parameter("T", "s", lambda s: s.duration, kind="fixed"),
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
