"""Amplitude, phase and offset from the first cycles of a sense signal by least squares: the start of every filter."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from estimation.reference import PhaseReference
from estimation.signals import SenseChannel, is_capacitive
from scanner.arrays import Array
from scanner.device import Axis, Device
from scanner.errors import BadInput
from scanner.harmonics import capacitance_harmonics, readout_response
from scanner.lowpass import lowpass_response
from scanner.stages import Amdm, Capacitance

WINDOW_CYCLES = 6.0
"""Cycles of the slowest motion that are fitted: enough to separate the harmonics of two axes, short against drift."""

MIN_SAMPLES = 512
"""Samples fitted at least, so that noise averages out at low sample rates."""

DETECTION_SIGMA = 6.0
"""Size of a harmonic in standard deviations of its noise from which it counts as motion; by chance once in 1e8."""


@dataclass(frozen=True)
class InitialAxisMotion:
    """Steady motion A sin(psi + phase) of one axis over the first cycles.

    Attributes:
        amplitude: [rad]. phase: against the reference [rad], modulo pi unless ``sign`` is known.
        amplitude_sd, phase_sd: [rad], from the signal's noise.
        sign: ``"ambiguous"`` or ``"known: <how>"``.
    """

    amplitude: float
    phase: float
    amplitude_sd: float
    phase_sd: float
    sign: str


@dataclass(frozen=True)
class InitialMotion:
    """Initial motion of all axes of one sense channel, and the offset of its readout.

    Attributes:
        axes: by name. offset: of the readout as measured [V]. noise_sd: of the signal about the fit [V].
        window: length of the fitted segment [s].
    """

    axes: Mapping[str, InitialAxisMotion]
    offset: float
    noise_sd: float
    window: float


def fit_initial_motion(sense: SenseChannel, device: Device, references: Mapping[str, PhaseReference]) -> InitialMotion:
    """Fit an offset and the harmonics of every axis to the first cycles of ``sense``.

    The second harmonic of the motion in a capacitive signal (the first in a position signal) gives amplitude and
    phase, through the readout's response at its frequency. The offset is the signal's mean minus that of the
    capacitance.

    Raises:
        BadInput: the signal shows no motion at a reference's frequency, or is too short.
    """
    channel, rate = sense.channel, sense.channel.sample_rate
    frequencies = {name: float(references[name].frequency_at(np.array([channel.start]))[0]) for name in sense.axes}
    n = max(MIN_SAMPLES, round(WINDOW_CYCLES / min(frequencies.values()) * rate))
    if channel.size < n:
        raise BadInput(
            f"is {channel.size} samples long; {n} are needed to start from",
            file=channel.file,
            channel=channel.name,
            hint="record for longer",
        )
    values = channel.read(0, n)
    time = channel.start + np.arange(n) / rate
    orders = range(1, 9) if is_capacitive(sense.readout) else range(1, 4)
    columns, keys = [np.ones(n)], [("", 0)]
    for name in sense.axes:
        turn = references[name].phase(time)
        for order in orders:
            if order * frequencies[name] < 0.45 * rate:
                columns += [np.cos(order * turn), np.sin(order * turn)]
                keys += [(name, order)] * 2
    basis = np.array(columns)
    gram = np.linalg.pinv(basis @ basis.T, hermitian=True)  # two axes may share a harmonic
    fitted = gram @ (basis @ values)
    noise_sd = float(np.std(values - fitted @ basis))
    phasors = {key: fitted[i] - 1j * fitted[i + 1] for i, key in enumerate(keys) if i % 2 == 1}  # Re(Z exp(i n psi))
    line_sd = noise_sd * np.sqrt(2.0 / n)
    axes, offset = {}, float(fitted[0])
    for name in sense.axes:
        line = phasors[name, 2 if is_capacitive(sense.readout) else 1]
        if abs(line) < DETECTION_SIGMA * line_sd:
            raise BadInput(
                f"shows no motion of axis {name} at {frequencies[name]:.6g} Hz: "
                f"{abs(line):.1e} V where noise gives {line_sd:.1e} V",
                file=channel.file,
                channel=channel.name,
                hint="the resonance did not start; check drive voltage and frequency",
            )
        if is_capacitive(sense.readout):
            axes[name], mean = _from_capacitance(sense, device.axis(name), frequencies[name], name, phasors, line_sd)
            offset -= mean
        else:
            gain = complex(readout_response(sense.readout, frequencies[name]))
            phase = float(np.angle(1j * line / gain))  # Re(Z e^{i psi}) = A sin(psi + phase) for Z = -i A e^{i phase}
            sd = line_sd / abs(gain)
            axes[name] = InitialAxisMotion(
                abs(line / gain), phase, sd, sd * abs(gain / line), f"known: {sense.readout.kind} readout"
            )
    return InitialMotion(axes, offset, noise_sd, n / rate)


def amplitude_from_line(size: float, comb: Capacitance, gain: float) -> tuple[float, float]:
    """Amplitude [rad] whose second harmonic of C, times ``gain`` [V/F], is ``size`` [V]; and d size/dA [V/rad]."""
    amplitudes = np.linspace(0.0, 1.6, 161) * comb.theta0
    lines = gain * np.array([abs(capacitance_harmonics(float(a), comb, 2)[2]) for a in amplitudes])
    top = int(lines.argmax())  # beyond it the line falls with the amplitude
    # The line grows as A^2 at first, so that its square root is nearly linear.
    amplitude = float(np.interp(np.sqrt(size), np.sqrt(lines[: top + 1]), amplitudes[: top + 1]))
    for _ in range(3):  # Newton steps remove the interpolation error
        step = 1e-4 * comb.theta0
        value, value_ahead = (gain * abs(capacitance_harmonics(a, comb, 2)[2]) for a in (amplitude, amplitude + step))
        slope = max((value_ahead - value) / step, 1e-3 * gain * comb.C0 / comb.theta0)
        amplitude = float(np.clip(amplitude + (size - value) / slope, amplitudes[1], amplitudes[top]))
    return amplitude, slope


def _from_capacitance(
    sense: SenseChannel,
    axis: Axis,
    frequency: float,
    name: str,
    phasors: Mapping[tuple[str, int], complex],
    line_sd: float,
) -> tuple[InitialAxisMotion, float]:
    comb = axis.require_capacitance()
    line = phasors[name, 2]
    gain = complex(readout_response(sense.readout, 2.0 * frequency))
    amplitude, slope = amplitude_from_line(abs(line), comb, abs(gain))
    harmonics = capacitance_harmonics(amplitude, comb)
    phase = 0.5 * float(np.angle(line / (gain * harmonics[2])))
    sign = "ambiguous"
    odd = complex(readout_response(sense.readout, frequency)) * harmonics[1]
    if abs(odd) > DETECTION_SIGMA * line_sd and (name, 1) in phasors:
        agreement = (np.conj(odd * np.exp(1j * phase)) * phasors[name, 1]).real / abs(odd)
        if abs(agreement) > DETECTION_SIGMA * line_sd:
            phase += 0.0 if agreement > 0.0 else np.pi
            sign = "known: the combs' offset theta_th"
    mean = sense.readout.a_cir * harmonics[0].real if isinstance(sense.readout, Amdm) else 0.0
    return InitialAxisMotion(amplitude, phase, line_sd / slope, 0.5 * line_sd / abs(line), sign), mean


def initial_section_states(
    sense: SenseChannel, device: Device, start: InitialMotion, references: Mapping[str, PhaseReference]
) -> Array:
    """Output of each low-pass section at the signal's first sample under the steady motion of ``start`` [F]."""
    if not isinstance(sense.readout, Amdm):
        return np.empty(0)
    t0 = np.array([sense.channel.start])
    out = np.zeros(len(sense.readout.lpf_hz))
    for name, motion in start.axes.items():
        f = float(references[name].frequency_at(t0)[0])
        turn = float(references[name].phase(t0)[0]) + motion.phase
        harmonics = capacitance_harmonics(motion.amplitude, device.axis(name).require_capacitance())
        orders = np.arange(harmonics.size)
        for s in range(out.size):
            passed = harmonics * lowpass_response(orders * f, sense.readout.lpf_hz[: s + 1])
            out[s] += float(np.sum(passed * np.exp(1j * orders * turn)).real)
    return out
