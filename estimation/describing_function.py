"""Effect of nonlinear torques on a steady motion: equivalent stiffness and damping, and harmonics of the motion.

A torque along theta = a sin u has a first harmonic, which acts as a stiffness and a damping that depend on the
amplitude (its describing function), and further harmonics, to which the mechanics answer linearly.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from scanner.active_terms import ActiveTerm
from scanner.arrays import Array, Complex
from scanner.device import Axis, Device
from scanner.integrator.abi import nominal_values
from scanner.motion import Motion
from scanner.stages import Mechanics

POINTS_PER_CYCLE = 64
"""Points of a cycle at which a torque is evaluated: only its harmonics above the 58th alias onto those that are
kept."""

MAX_HARMONIC = 5
"""Highest harmonic of the motion that is kept; the response to higher ones falls with the square of their order."""

MAX_CYCLES, PERIODICITY_TOLERANCE = 400, 1e-6
"""Cycles over which hidden states of a torque are stepped until it repeats, and the relative change that counts as
repeated."""

DEGENERATE_FREQUENCY_RATIO = 0.05
"""Relative distance of two axes' frequencies below which their coupled motion is not separated: the response of one
axis at the frequency of the other is then resonant and not a small correction."""

MIN_DAMPING_RATIO = 0.01
"""Smallest equivalent damping relative to the nominal one, so that a linearised device is always stable."""


@dataclass(frozen=True)
class DescribingFunction:
    """Effect of all torques of one axis's terms at one amplitude and frequency.

    Attributes:
        k, b: equivalent stiffness [N m/rad] and damping [N m s].
        harmonics: of the motion relative to its amplitude: the terms add the sum of Re(harmonics[n] a exp(i n u)) to
            a sin u, shape (MAX_HARMONIC + 1,).
        cross_response: motion of this axis over the phasor of the other axis's motion.
    """

    k: float
    b: float
    harmonics: Complex
    cross_response: complex = 0.0j

    @property
    def changes_angle(self) -> bool:
        """Whether the terms add anything to the angle besides a change of stiffness and damping."""
        return bool(self.harmonics.any() or self.cross_response)


def describing_function(
    axis: Axis, terms: Sequence[ActiveTerm], motion: Motion, name: str, duration: float
) -> DescribingFunction:
    """The describing function of an axis's terms at the median amplitude and frequency of its motion.

    Laws that depend on time are evaluated at the middle of the recording; an estimator follows the changes by itself.

    Args:
        axis: nominal. name: of the axis in ``motion``.
        duration: of the recording [s].
    """
    axis_motion = motion.axes[name]
    amplitude, rate = float(np.median(axis_motion.amplitude)), 2 * np.pi * float(np.median(axis_motion.frequency))
    mechanics, time = axis.mechanics, 0.5 * duration
    if mechanics is None or not any(active.term.torque for active in terms):
        return DescribingFunction(0.0, 0.0, np.zeros(MAX_HARMONIC + 1, np.complex128))

    def response(torque: complex, at: float) -> complex:
        return torque / (mechanics.k - mechanics.J * at * at + 1j * mechanics.b * at)

    torque = np.sum(
        [torque_harmonics(active, axis, amplitude, rate, time) for active in terms if active.term.torque], axis=0
    )
    harmonics = np.array([response(line, n * rate) / amplitude for n, line in enumerate(torque)])
    harmonics[1] = 0.0
    result = DescribingFunction(
        float(torque[1].imag / amplitude), float(-torque[1].real / (amplitude * rate)), harmonics
    )
    coupled = [active for active in terms if active.term.couples_motions]
    for other, other_motion in motion.axes.items():
        other_rate = 2 * np.pi * float(np.median(other_motion.frequency))
        if other == name or not coupled or abs(other_rate / rate - 1.0) <= DEGENERATE_FREQUENCY_RATIO:
            continue
        size = float(np.median(other_motion.amplitude))
        line = sum(torque_harmonics(active, axis, 0.0, other_rate, time, size)[1] for active in coupled)
        result = replace(result, cross_response=response(line, other_rate) / size)
    return result


def torque_harmonics(
    active: ActiveTerm, axis: Axis, amplitude: float, rate: float, time: float, other_amplitude: float = 0.0
) -> Complex:
    """Harmonics of a term's torque along amplitude sin u, while the other axis moves along other_amplitude sin u.

    Hidden states are stepped cycle by cycle (Runge-Kutta 4) until the torque repeats.

    Args:
        amplitude, other_amplitude: [rad]. rate: du/dt [rad/s].
        time: at which the term is evaluated [s].

    Returns:
        shape (MAX_HARMONIC + 1,) [N m]; the torque is the sum of Re(harmonics[n] exp(i n u)).
    """
    cycle = 2 * np.pi * np.arange(POINTS_PER_CYCLE) / POINTS_PER_CYCLE
    half_interval = np.pi / POINTS_PER_CYCLE
    nominal, parameters = nominal_values(axis), np.asarray(active.values, np.float64)
    step, has_states = 2 * np.pi / (rate * POINTS_PER_CYCLE), bool(active.term.hidden_state_scales)

    def law(u: float, z: Array) -> tuple[float, Array]:
        theta, omega, other = amplitude * np.sin(u), amplitude * rate * np.cos(u), other_amplitude * np.sin(u)
        torque, *rates = active.term.torque(  # type: ignore[misc]
            time, theta, omega, other, 0.0, z[0], z[1], parameters, nominal
        )
        return torque, np.array(rates)

    z, torque = np.zeros(2), np.zeros(POINTS_PER_CYCLE)
    for _ in range(MAX_CYCLES if has_states else 1):
        previous = torque.copy()
        for j, u in enumerate(cycle):
            torque[j], d1 = law(u, z)
            if has_states:
                d2 = law(u + half_interval, z + 0.5 * step * d1)[1]
                d3 = law(u + half_interval, z + 0.5 * step * d2)[1]
                d4 = law(u + 2 * half_interval, z + step * d3)[1]
                z = z + step / 6.0 * (d1 + 2.0 * d2 + 2.0 * d3 + d4)
        if np.abs(torque - previous).max() <= PERIODICITY_TOLERANCE * np.abs(torque).max():
            break
    harmonics = np.fft.rfft(torque)[: MAX_HARMONIC + 1] * (2.0 / POINTS_PER_CYCLE)
    harmonics[0] *= 0.5
    return harmonics


def linearised_device(device: Device, functions: Mapping[str, DescribingFunction]) -> Device:
    """The device with the equivalent stiffness and damping of its terms added to the mechanics of each axis."""
    axes = dict(device.axes)
    for name, function in functions.items():
        if (m := axes[name].mechanics) is not None:
            b = max(m.b + function.b, MIN_DAMPING_RATIO * m.b)
            axes[name] = replace(axes[name], mechanics=Mechanics(m.J, b, m.k + function.k))
    return replace(device, axes=axes)


def add_term_motion(
    angles: Mapping[str, Array],
    sample_rate: float,
    motion: Motion,
    functions: Mapping[str, DescribingFunction],
    name: str,
) -> Array:
    """The angle of an axis with the harmonics and the cross-coupled motion that its terms cause.

    Args:
        angles: of every axis at the same samples, shape (n,) [rad]. sample_rate: [Hz].
        motion: that gives the axes' frequencies.

    Returns:
        shape (n,) [rad].
    """
    function = functions.get(name)
    if function is None or not function.changes_angle:
        return angles[name]
    phasors = {
        axis: _phasor(angle, sample_rate, 2 * np.pi * float(np.median(motion.axes[axis].frequency)))
        for axis, angle in angles.items()
    }
    amplitude = np.abs(phasors[name])
    unit = phasors[name] / np.maximum(amplitude, 1e-300)
    total = angles[name].copy()
    for n, harmonic in enumerate(function.harmonics):
        if harmonic:
            total += amplitude * (harmonic * unit**n).real
    for other, phasor in phasors.items():
        if other != name:
            total += (function.cross_response * phasor).real
    return total


def _phasor(angle: Array, sample_rate: float, rate: float) -> Complex:
    """a exp(i u) of theta = a sin u, from the angle and its slope, shape (n,)."""
    return np.gradient(angle, 1.0 / sample_rate) / rate + 1j * angle
