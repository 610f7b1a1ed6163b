"""A part of the drive's voltage in a capacitive sense signal, found by the lines of the signal.

An even capacitance gives lines at 2, 4 and 6 times the frequency of the motion. An electrostatic drive has twice this
frequency, so that its feedthrough adds to the second line alone and changes amplitude and phase that are estimated from
it. The other lines contradict these. Errors of amplitude, phase and gain, which all lines share, and a feedthrough
g V + h V'/ω_d of each drive (term ``feedthrough``) are solved for by least squares. Where a feedthrough explains what
the others cannot, the signal is used without it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from math import exp, hypot
from typing import NamedTuple

import numpy as np

from estimation.signals import SenseChannel, sense_channels
from scanner.arrays import Array, Complex
from scanner.channel import Channel
from scanner.device import Device
from scanner.harmonics import capacitance_harmonics, readout_response
from scanner.motion import Motion
from scanner.recording import Recording
from scanner.stages import Amdm, Transimpedance

EFFECT = "feedthrough"

ORDERS = (2, 4, 6)
"""Lines that are compared, in multiples of the motion's frequency. Higher ones are below 0.1 % of the second."""

MAX_SAMPLES = 1 << 19
"""Samples about the middle of the recording in which the lines are measured: a constant needs no more."""

LINE_MODEL_SD = 2e-3
"""Standard deviation of a line of the model over the larger one of this line and the one below it: a third harmonic of
the motion, 0.1 to 0.2 % of its amplitude, carries such a share of each line into the next."""

AMPLITUDE_STEP = 1e-3
"""Relative change of the amplitude for the derivative of a line."""

AMPLITUDES_AVERAGED = 32
"""Amplitudes over the samples whose lines are averaged."""

MIN_SIGNIFICANCE_SD = 5.0
"""Feedthrough of all drives in its standard deviations from which it is removed."""

MAX_LOG_AMPLITUDE_SD = 0.05
"""Largest standard deviation of the logarithm of the amplitude by the lines without feedthrough. Above it, as in noise,
they do not separate a feedthrough from another amplitude, and the signal is used as it is."""

MAX_REDUCED_CHI2 = 4.0
"""Largest squared residual of the lines per degree of freedom at which a feedthrough explains them."""

GAUSS_NEWTON_STEPS = 6
"""Steps from the motion as estimated: a feedthrough of a fifth of the signal needs four."""

TINY = float(np.finfo(float).tiny)

LineModel = Callable[[str, float], tuple[Complex, Complex]]
"""Lines of an axis and their derivatives, by its name and the logarithm of its amplitude over the estimated one."""

ROUNDS = 2
"""Estimates of the motion without the feedthrough: the second one begins at a better phase."""


class Feedthrough(NamedTuple):
    """Feedthrough of the drive of one axis.

    Attributes:
        g, h: its factors of V and of V'/ω_d. omega_d: angular frequency of the drive [rad/s].
        share: rms over that of the sense signal.
        log_amplitude_sd: standard deviation that it leaves to the logarithm of the amplitude.
    """

    g: float
    h: float
    omega_d: float
    share: float
    log_amplitude_sd: float


def without_feedthrough(
    recording: Recording, device: Device, motion: Motion, run: Callable[[Recording, Device], Motion]
) -> Motion:
    """The motion estimated without the feedthrough that the sense signal shows, and a note on it.

    Args:
        recording, device: of the motion; a device that states terms describes the signal itself.
        run: estimates the motion, also for a device with terms.
    """
    if any(axis.terms for axis in device.axes.values()):
        return motion
    first, found = motion, dict[str, Feedthrough]()
    for _ in range(ROUNDS):
        measured = measure_feedthrough(recording, device, motion)
        if not measured:
            break
        found = measured
        motion = run(recording, _with_terms(device, found))
    if not found:
        return motion
    axes = dict(motion.axes)
    for name, each in found.items():
        own = axes[name]
        sd = np.zeros_like(own.amplitude) if own.amplitude_sd is None else own.amplitude_sd
        axes[name] = replace(own, amplitude_sd=np.hypot(sd, each.log_amplitude_sd * own.amplitude))
    lines = [_describe(name, each, first, motion, recording) for name, each in found.items()]
    return replace(motion, axes=axes, notes=(*motion.notes, *lines))


def measure_feedthrough(recording: Recording, device: Device, motion: Motion) -> dict[str, Feedthrough]:
    """The significant feedthroughs by axis; none where they do not explain the lines of the signal."""
    found: dict[str, Feedthrough] = {}
    for sense in sense_channels(recording, device, gaps_ok=True):
        drives = {name: recording.channels.get(f"drive_{name}") for name in sense.axes}
        driven = {name: drive for name, drive in drives.items() if drive is not None}
        kinds = [device.axis(name).drive for name in sense.axes]
        if len(driven) == len(drives) and all(kind is not None and kind.kind == "electrostatic" for kind in kinds):
            found |= _measure_channel(sense, driven, device, motion)
    return found


def _measure_channel(
    sense: SenseChannel, drives: Mapping[str, Channel], device: Device, motion: Motion
) -> dict[str, Feedthrough]:
    """The significant feedthroughs into one capacitive sense channel."""
    channel, readout = sense.channel, sense.readout
    tracks = {name: motion.axes[name].angle.phasors() for name in sense.axes}
    clocks = {(each.sample_rate, each.start, each.size) for each in (channel, *drives.values())}
    if not isinstance(readout, (Amdm, Transimpedance)) or len(clocks) > 1:
        return {}
    first = max((channel.size - MAX_SAMPLES) // 2, 0)
    part = slice(first, min(first + MAX_SAMPLES, channel.size))
    time, values = channel.time(part.start, part.stop), channel.read(part.start, part.stop)
    phases = {name: track.phase(time) for name, track in tracks.items() if track is not None}
    if len(phases) < len(sense.axes):
        return {}
    voltages = [drives[name].read(part.start, part.stop) for name in sense.axes]
    known = np.all(np.isfinite([values, *voltages, *phases.values()]), axis=0)
    if known.sum() < 2 * len(ORDERS) * (2 * len(phases) + 1):
        return {}
    used = {name: phase[known] for name, phase in phases.items()}
    lines, sd = _lines(values[known], used)
    drive_lines = [
        _lines(voltage[known], {name: used[name]})[0] for name, voltage in zip(phases, voltages, strict=True)
    ]
    model = partial(_model_lines, device, motion, sense)
    gain_sd = hypot(*(device.tolerance(sense.axes[0], key) for key in ("C0", "a_cir", "R_s", "V_bias")))
    scales = np.array([np.std(values[known]) / max(float(np.std(each[known])), TINY) for each in voltages])
    by_axis = lines.reshape(len(phases), -1)
    solved = _solve(by_axis, sd, model, scales[:, None] * np.array(drive_lines), list(phases), gain_sd)
    if solved is None:
        return {}
    value, covariance = solved
    factors = [column for k in range(len(phases)) for column in _columns(k)[2:]]
    joint = value[factors] @ np.linalg.solve(covariance[np.ix_(factors, factors)], value[factors])
    amplitudes = [_columns(k)[0] for k in range(len(phases))]
    if joint < MIN_SIGNIFICANCE_SD**2 or covariance.diagonal()[amplitudes].max() > MAX_LOG_AMPLITUDE_SD**2:
        return {}
    found = {}
    for k, name in enumerate(phases):
        at, _, *own = _columns(k)
        rate = 4.0 * np.pi * float(np.median(motion.axes[name].frequency))
        g, h = (scales[k] * value[own]).tolist()
        found[name] = Feedthrough(g, h, rate, float(np.hypot(*value[own])), float(np.sqrt(covariance[at, at])))
    return found


def _lines(values: Array, phases: Mapping[str, Array]) -> tuple[Complex, float]:
    """Complex lines at ``ORDERS`` of each phase, shape (axes * orders,), and the standard deviation of their parts."""
    columns = [np.ones(values.size)]
    for phase in phases.values():
        columns += [part(order * phase) for order in ORDERS for part in (np.cos, np.sin)]
    design = np.stack(columns, axis=1)
    coefficients = np.linalg.solve(design.T @ design, design.T @ values)
    noise = float(np.mean((values - design @ coefficients) ** 2))
    return coefficients[1::2] - 1j * coefficients[2::2], float(np.sqrt(2.0 * noise / values.size))


def _model_lines(
    device: Device, motion: Motion, sense: SenseChannel, name: str, log_amplitude: float
) -> tuple[Complex, Complex]:
    """Lines of the motion of one axis, and their derivatives by the logarithm of its amplitude, shape (orders,) each.

    Args:
        log_amplitude: logarithm of the amplitude over that of the motion.
    """
    own, comb = motion.axes[name], device.axis(name).require_capacitance()
    response = readout_response(sense.readout, float(np.median(own.frequency)) * np.array(ORDERS))
    middle = sense.channel.start + 0.5 * sense.channel.size / sense.channel.sample_rate
    half = 0.5 * min(MAX_SAMPLES, sense.channel.size) / sense.channel.sample_rate
    times = np.linspace(middle - half, middle + half, AMPLITUDES_AVERAGED)
    amplitudes = np.interp(times, own.time, own.amplitude)

    def lines(factor: float) -> Complex:
        each = [capacitance_harmonics(float(factor * amplitude), comb)[list(ORDERS)] for amplitude in amplitudes]
        return np.asarray(np.mean(each, axis=0) * response)

    factor = exp(log_amplitude)
    behind, ahead = (lines(factor * (1.0 + step)) for step in (-AMPLITUDE_STEP, AMPLITUDE_STEP))
    return lines(factor), (ahead - behind) / (2.0 * AMPLITUDE_STEP)


def _columns(axis: int) -> list[int]:
    """Unknowns of an axis: ln amplitude, phase, g and h; the first of all is the logarithm of the gain."""
    return list(range(1 + 4 * axis, 5 + 4 * axis))


def _solve(
    lines: Complex, noise_sd: float, model: LineModel, drives: Complex, names: Sequence[str], gain_sd: float
) -> tuple[Array, Array] | None:
    """Errors of gain, amplitudes and phases, and the feedthroughs, by Gauss-Newton, and their covariance.

    Args:
        lines: of the signal, shape (axes, orders) [V]. noise_sd: of their parts [V].
        model: lines of an axis and their derivatives.
        drives: lines of each axis's drive with the rms of the signal, shape (axes, orders) [V].
        names: of the axes.
        gain_sd: relative standard deviation of the gain.

    Returns:
        None if a feedthrough does not explain the lines.
    """
    orders = np.array(ORDERS)
    value = np.zeros(1 + 4 * len(names))
    prior = np.zeros_like(value)
    prior[0] = 1.0 / max(gain_sd, LINE_MODEL_SD)
    for _ in range(GAUSS_NEWTON_STEPS):
        design, residual = np.zeros((lines.size, value.size), complex), np.empty(lines.size, complex)
        for k, name in enumerate(names):
            rows = slice(k * orders.size, (k + 1) * orders.size)
            log_amplitude, phase, g, h = value[_columns(k)]
            turned = exp(value[0]) * np.exp(1j * orders * phase)
            line, slope = (turned * each for each in model(name, log_amplitude))
            passed = np.stack([drives[k], 0.5j * orders * drives[k]], axis=1)
            sd = np.hypot(noise_sd, LINE_MODEL_SD * np.maximum(np.abs(line), np.abs(np.roll(line, 1)) * (orders > 2)))
            own = np.column_stack([slope, 1j * orders * line, passed])
            design[rows, 0], design[rows, _columns(k)] = line / sd, own / sd[:, None]
            residual[rows] = (lines[k] - line - passed @ [g, h]) / sd
        stacked = np.concatenate([design.real, design.imag, prior[None]])
        wanted = np.concatenate([residual.real, residual.imag, [-prior[0] * value[0]]])
        if not np.isfinite(stacked).all() or np.linalg.matrix_rank(stacked) < value.size:
            return None
        covariance = np.linalg.inv(stacked.T @ stacked)
        step = covariance @ stacked.T @ wanted
        value = value + step
    chi2 = float(np.sum((wanted - stacked @ step) ** 2))
    return (value, covariance) if chi2 <= MAX_REDUCED_CHI2 * (wanted.size - value.size) else None


def _with_terms(device: Device, found: Mapping[str, Feedthrough]) -> Device:
    """The device with the feedthroughs as terms."""
    axes = {
        name: replace(axis, terms={EFFECT: {"g": found[name].g, "h": found[name].h, "omega_d": found[name].omega_d}})
        if name in found
        else axis
        for name, axis in device.axes.items()
    }
    return replace(device, axes=axes)


def _describe(name: str, found: Feedthrough, before: Motion, after: Motion, recording: Recording) -> str:
    """The line on the feedthrough of one drive."""
    sense = "sense" if "sense" in recording else f"sense_{name}"
    change = float(np.median(after.axes[name].amplitude) / np.median(before.axes[name].amplitude)) - 1.0
    return (
        f"{sense}: holds a part of drive_{name}, {found.share:.2g} of the signal (rms), as its line at the drive's "
        f"frequency does not fit the others: it was removed, which changes the amplitude of {name} by {change:+.1%} "
        "(a low-pass that the device omits has a similar effect); to state it in the device: "
        f"[{name}.terms.feedthrough] g = {found.g:.4g}, h = {found.h:.4g}, omega_d = {found.omega_d:.6g}"
    )
