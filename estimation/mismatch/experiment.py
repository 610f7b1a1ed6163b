"""What was recorded, ready to be compared with a simulation: inputs on an integration grid, outputs thinned out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import ceil, floor

import numpy as np
from numpy.typing import NDArray

from estimation.mismatch.noise import periodogram
from scanner.channel import Channel, check_signal
from scanner.device import Amdm, Axis, Device, Position, Readout, Transimpedance
from scanner.errors import BadInput, DeviceInvalid
from scanner.lowpass import response
from scanner.recording import Recording
from scanner.response import Inputs
from scanner.terms import Scales
from scanner.trajectory import thirds

Array = NDArray[np.float64]

STEPS_A_TURN = 52
"""Integration steps in one turn of the motion, at least. Four times as many change channels of 20 000 samples by half
of one sample's noise in all that no nominal value takes up (1.1 for 60 000 samples under a broad drive)."""

STEPS_A_DRIVE = 24
"""Integration steps in one turn of the drive's strongest line, at least."""

BAND = 16
"""Highest frequency compared, in multiples of the motion's."""

STEADY = 0.5
"""Share of what alternates in a drive that a tone and its overtones make up, from which it is taken to be steady."""

OVERTONES = 6
"""Lines that a steady tone is known by; half of the power of pulses a twentieth of a period long lies in them."""

SEEN = 1 << 17
"""Samples from the start in which a drive's strongest line is looked for."""

EDGE = 16
"""Samples at either end of a thinned channel that its filter has touched."""


@dataclass(frozen=True)
class Output:
    """One recorded channel on its thinned clock.

    Attributes:
        name: of the channel.
        kind: ``"sense"`` or ``"angle"``.
        axes: that it sees.
        data: shape (n,) [V or rad].
        full: as recorded, shape (N,).
        full_rate: of that [Hz].
        step: between samples of ``data`` [s].
        first: position of the first sample on the integration grid, in its steps.
        stride: distance between samples on that grid, in its steps.
        guard: samples at the start and at the end that are not compared.
        bins: number of bins of its transform that are compared, from 0 Hz on.
        noise_sd: stated standard deviation of a full-rate sample, None where none is stated.
    """

    name: str
    kind: str
    axes: tuple[str, ...]
    data: Array
    full: Array
    full_rate: float
    step: float
    first: float
    stride: float
    guard: tuple[int, int]
    bins: int
    noise_sd: float | None

    @property
    def on_grid(self) -> bool:
        """Whether the samples fall on the integration grid one by one."""
        return abs(self.first) < 1e-6 and abs(self.stride - 1.0) * self.data.size < 1e-6

    def sampled(self, signal: Array) -> Array:
        """``signal`` on the integration grid, at this channel's samples, as far as the grid goes."""
        if self.on_grid:
            return signal[: self.data.size]
        at = self.first + self.stride * np.arange(self.data.size)
        at = at[at <= signal.size - 1 + 1e-9]
        base = np.clip(np.floor(at).astype(np.intp), 1, signal.size - 3)
        u = at - base
        a, b, c, d = signal[base - 1], signal[base], signal[base + 1], signal[base + 2]
        return (
            -u * (u - 1) * (u - 2) / 6 * a + (u + 1) * (u - 1) * (u - 2) / 2 * b
            - (u + 1) * u * (u - 2) / 2 * c + (u + 1) * u * (u - 1) / 6 * d
        )  # fmt: skip


@dataclass(frozen=True)
class Run:
    """One recording.

    Attributes:
        name: of it.
        inputs: by axis.
        outputs: compared channels.
        scales: natural sizes by axis.
        duration: [s].
        lines: strongest lines of the drive by axis [Hz].
    """

    name: str
    inputs: Mapping[str, Inputs]
    outputs: tuple[Output, ...]
    scales: Mapping[str, Scales]
    duration: float
    lines: Mapping[str, Array]


def experiment(recording: Recording, device: Device, finer: int = 1) -> Run:
    """A recording made ready.

    Args:
        finer: integrate on a grid finer by this factor, for checks of the numerics.

    Raises:
        BadInput: there is nothing to compare with, a needed channel is missing or cannot be used.
    """
    outputs = _output_channels(recording, device)
    if not outputs:
        holds = ", ".join(recording.channels)
        hint = f"record sense or angle channels, or add the readout to the device; it holds {holds}"
        raise BadInput("holds no channel that the device could be held against", file=recording.path, hint=hint)
    axes = tuple(name for name in device.axes if any(name in seen for _, seen in outputs.values()))
    drives = {name: _drive_channels(recording, device.axis(name)) for name in axes}
    used = [recording[name] for name in outputs] + [each for channels in drives.values() for each in channels]
    for channel in used:
        check_signal(channel, constant_ok=channel.name.startswith(("bias", "drive")))
    start, end = max(c.start for c in used), min(c.end - 1 / c.sample_rate for c in used)
    clock = max((c for channels in drives.values() for c in channels), key=lambda c: c.sample_rate, default=used[0])
    step, n, grid_start = _grid(clock, start, end, axes, device, drives, finer)
    if n < 8 * STEPS_A_TURN:
        what = f"the channels share {end - start:.3g} s, fewer than 8 turns of the mirror"
        raise BadInput(what, file=recording.path, hint="record longer, or check the channels' start times")
    origin = recording.start
    inputs = {
        name: Inputs(
            _voltage(drives[name], _rest_voltage(device, name, drives[name]), grid_start, step, n),
            step,
            grid_start - origin,
        )
        for name in axes
    }
    lines = {name: _lines(inputs[name]) for name in axes}
    made = tuple(
        _output(recording[name], seen, device, step, n, grid_start, lines) for name, (_, seen) in outputs.items()
    )
    scales = {name: _scales(device, name, inputs[name], made, lines[name], len(axes) > 1, end - start) for name in axes}
    return Run(recording.name, inputs, made, scales, end - start, lines)


def sense_channel(device: Device, axis: str) -> str:
    """Name of the channel in which ``axis`` is sensed."""
    return "sense" if device.readout is not None else f"sense_{axis}"


def readout_of(device: Device, axis: str) -> Readout | None:
    """The readout that sees ``axis``, its own or the shared one."""
    return device.readout if device.readout is not None else device.axis(axis).readout


def _output_channels(recording: Recording, device: Device) -> dict[str, tuple[str, tuple[str, ...]]]:
    found: dict[str, tuple[str, tuple[str, ...]]] = {}
    for name in device.axes:
        channel = sense_channel(device, name)
        if channel in recording and readout_of(device, name) is not None:
            found[channel] = ("sense", (*found.get(channel, ("", ()))[1], name))
        if f"angle_{name}" in recording:
            found[f"angle_{name}"] = ("angle", (name,))
    return found


def _drive_channels(recording: Recording, axis: Axis) -> list[Channel]:
    names = [f"drive_{axis.name}", f"bias_{axis.name}"]
    if axis.drive is not None and axis.drive.kind == "linear" and names[0] not in recording:
        recording.require(names[0], f"the linear drive of axis {axis.name} cannot be simulated without it")
    return [recording[name] for name in names if name in recording]


def _rest_voltage(device: Device, axis: str, drives: list[Channel]) -> float:
    """What lies on the comb where nothing was recorded: the readout's own bias."""
    readout = readout_of(device, axis)
    return readout.V_bias if isinstance(readout, Transimpedance) and not drives else 0.0


def _grid(clock: Channel, start: float, end: float, axes: tuple[str, ...], device: Device,
          drives: Mapping[str, list[Channel]], finer: int) -> tuple[float, int, float]:  # fmt: skip
    """Step [s], number of steps, and start of the integration [s]."""
    fastest = max(device.axis(name).resonance for name in axes)
    line = max((strongest_line(c.read(), c.sample_rate) for name in axes for c in drives[name]), default=0.0)
    wanted = max(STEPS_A_TURN * fastest, STEPS_A_DRIVE * line) * finer
    rate = clock.sample_rate
    thin = floor(rate / wanted)
    thin = thin - thin % 2 if thin >= 2 else 1
    splits = 1 if thin > 1 else max(1, ceil(wanted / rate / 1.5))
    first = ceil((start - clock.start) * rate - 1e-6)
    step = thin / rate / splits
    grid_start = clock.start + first / rate
    return step, floor((end - grid_start) / step + 1e-6), grid_start


def strongest_line(values: Array, rate: float) -> float:
    """Frequency of the strongest line [Hz], 0 where nothing alternates."""
    part = values[:SEEN]
    if part.std() < 1e-3 * (abs(part.mean()) + 1e-300):
        return 0.0
    return float(np.argmax(periodogram(part - part.mean())) * rate / part.size)


def is_steady(line: float, values: Array, rate: float) -> bool:
    """Whether what alternates is a tone at ``line`` [Hz] and its overtones, not a sweep, many tones or noise."""
    part = values[:SEEN]
    power, overtone = periodogram(part - part.mean()), np.arange(1, OVERTONES + 1)
    far = np.abs(np.arange(power.size)[:, None] - overtone * line * part.size / rate)
    near = np.any(far <= 2.0 + 0.5 * overtone, axis=1)  # the window is two wide, the line known to half a bin
    return bool(power[near].sum() > STEADY * power.sum())


def _voltage(channels: list[Channel], rest: float, start: float, step: float, n: int) -> Array:
    """Sum of the channels at the start, middle and end of every step, shape (n, 3)."""
    total = np.full((n, 3), rest)
    for channel in channels:
        samples = channel.read()
        lag, stride = (start - channel.start) * channel.sample_rate, step * channel.sample_rate / 2
        half = between(samples, lag + stride * np.arange(2 * n + 1, dtype=float))
        total += thirds(half)
    return total


def between(samples: Array, at: Array) -> Array:
    """``samples`` at fractional positions: band-limited where the signal is smooth, held where it jumps.

    A jump is a step between two samples that is larger than a quarter of the whole range and ten times its neighbours':
    cubic interpolation would ring around it.
    """
    nearest = np.rint(at)
    if np.abs(at - nearest).max() < 1e-6:
        return samples[np.clip(nearest.astype(np.intp), 0, samples.size - 1)]
    finer = round(1.0 / (at[1] - at[0])) if at.size > 1 else 1
    fine = at * finer
    if finer > 1 and np.abs(fine - np.rint(fine)).max() < 1e-4 and not has_jumps(samples):
        from scipy.signal import resample_poly

        mean = samples.mean()
        dense = resample_poly(samples - mean, finer, 1, window=("kaiser", 8.0)) + mean
        return dense[np.clip(np.rint(fine).astype(np.intp), 0, dense.size - 1)]
    base = np.clip(np.floor(at + 1e-9).astype(np.intp), 1, samples.size - 3)
    u = np.clip(at - base, -1.0, 2.0)
    a, b, c, d = samples[base - 1], samples[base], samples[base + 1], samples[base + 2]
    smooth = (
        -u * (u - 1) * (u - 2) / 6 * a + (u + 1) * (u - 1) * (u - 2) / 2 * b
        - (u + 1) * u * (u - 2) / 2 * c + (u + 1) * u * (u - 1) / 6 * d
    )  # fmt: skip
    steps = np.stack([np.abs(b - a), np.abs(c - b), np.abs(d - c)])
    largest, ordinary = steps.max(axis=0), np.median(steps, axis=0)
    jumps = (largest > 0.25 * np.ptp(samples)) & (largest > 10.0 * ordinary)
    held = samples[np.clip(np.floor(at + 1e-9).astype(np.intp), 0, samples.size - 1)]
    return np.where(jumps, held, smooth)


def has_jumps(samples: Array) -> bool:
    """Whether a signal that otherwise changes little from sample to sample jumps: square waves, steps."""
    steps = np.abs(np.diff(samples))
    return bool(steps.max() > 0.2 * np.ptp(samples) > 0.0 and steps.max() > 30.0 * np.median(steps))


def _lines(inputs: Inputs) -> Array:
    """Frequencies of the drive's lines [Hz]: above 1e-3 of the strongest, and well above their neighbours."""
    from scipy.ndimage import median_filter

    values = inputs.voltage[:, 0] - inputs.voltage[:, 0].mean()
    if values.std() < 1e-9 * (1.0 + np.abs(inputs.voltage).max()):
        return np.empty(0)
    spectrum = np.abs(np.fft.rfft(values * np.hanning(values.size)))
    tall = (spectrum > 1e-3 * spectrum.max()) & (spectrum > 6.0 * median_filter(spectrum, 41))
    return np.flatnonzero(tall) / (values.size * inputs.step)


def _output(channel: Channel, axes: tuple[str, ...], device: Device, step: float, n: int, start: float,
            lines: Mapping[str, Array]) -> Output:  # fmt: skip
    full = channel.read()
    first = max(0, ceil((start - channel.start) * channel.sample_rate - 1e-6))
    full = full[first:]
    thin = max(1, round(step * channel.sample_rate))
    data = full if thin == 1 else thinned(full, thin)
    own = thin / channel.sample_rate
    offset = (channel.start + first / channel.sample_rate - start) / step
    data = data[: quick_length(floor((n - offset) * step / own + 1e-6) + 1)]
    fastest = max(device.axis(name).resonance for name in axes)
    drive = max((lines[name].max() for name in axes if lines[name].size), default=0.0)
    band = min(0.35 / own, max(BAND * fastest, 1.5 * drive))
    edge = EDGE if thin > 1 else 2
    guard = (max(edge, ceil(1.0 / (fastest * own))), edge)
    kind = "angle" if channel.name.startswith("angle") else "sense"
    readout = readout_of(device, axes[0])
    noise = readout.noise_sd if kind == "sense" and readout is not None else None
    bins = quick_length(int(band * data.size * own)) + 1
    return Output(
        channel.name, kind, axes, data, full, channel.sample_rate, own, offset, own / step, guard, bins, noise
    )


def quick_length(n: int) -> int:
    """The largest length up to ``n`` that is quick to transform; it gives away less than 1 % of a long signal."""
    from scipy.fft import prev_fast_len

    return int(prev_fast_len(n, real=True))


def thinned(values: Array, factor: int) -> Array:
    """Every ``factor``-th sample behind a low-pass without delay that keeps the lower 70 % of the new band to 1e-5."""
    from scipy.signal import firwin, resample_poly

    mean = values.mean()
    taps = firwin(32 * factor + 1, 0.9 / factor, window=("kaiser", 10.0))
    return resample_poly(values - mean, 1, factor, window=taps) + mean


def _scales(device: Device, name: str, inputs: Inputs, outputs: tuple[Output, ...], lines: Array, two: bool,
            duration: float) -> Scales:  # fmt: skip
    axis = device.axis(name)
    mechanics, readout = axis.require_mechanics(), readout_of(device, name)
    voltage = inputs.voltage[:, 0]
    line = strongest_line(voltage, 1 / inputs.step)
    resonance = 2 * np.pi * mechanics.resonance
    parametric = axis.drive is not None and axis.drive.kind == "electrostatic"
    sensed = next((o for o in outputs if o.kind == "sense" and name in o.axes), outputs[0])
    follows = not parametric and 0.8 < strongest_line(sensed.data, 1 / sensed.step) / (line or np.inf) < 1.25
    rate = np.pi * line if parametric and line else 2 * np.pi * line if line else resonance
    if line and not is_steady(line, voltage, 1 / inputs.step):
        rate = resonance  # where it moves most
    if not (0.5 < rate / resonance < 2.0 or (follows and rate < resonance)):  # a stage far below its resonance follows
        rate = resonance
    measured = next((o.data for o in outputs if o.name == f"angle_{name}"), None)
    return Scales(
        amplitude=_amplitude(axis, readout, rate, sensed.data, measured),
        rate=float(rate),
        J=mechanics.J, b=mechanics.b, k=mechanics.k,
        duration=duration,
        voltage_mean=float(voltage.mean()), voltage_rms=float(voltage.std()),
        drive_rate=2 * np.pi * line if line else float(rate),
        sense_rms=float(sensed.data.std()), sense_peak=float(np.abs(sensed.full).max()),
        readout=readout, two_axes=two,
    )  # fmt: skip


def _amplitude(axis: Axis, readout: Readout | None, rate: float, signal: Array, measured: Array | None) -> float:
    """Peak amplitude of the motion [rad], roughly: from the angle, else from what the readout's law makes of it."""
    if measured is not None:
        return float(np.percentile(np.abs(measured - np.median(measured)), 99))
    if isinstance(readout, Position):
        return float(np.percentile(np.abs(signal - np.median(signal)), 99) / abs(readout.gain))
    comb = axis.require_capacitance()
    sizes = comb.theta0 * np.geomspace(0.02, 2.0, 60)
    turn = 2 * np.pi * np.arange(128) / 128
    theta = sizes[:, None] * np.sin(turn)
    u = theta / comb.theta0
    if isinstance(readout, Amdm):
        passed = np.abs(response(rate / np.pi, readout.lpf_hz))  # an even bell swings at twice the motion's rate
        told = np.ptp(readout.a_cir * comb.C0 * np.exp(-u * u), axis=1) * passed
    elif isinstance(readout, Transimpedance):
        slope = -2 * u / comb.theta0 * comb.C0 * np.exp(-u * u)
        told = np.ptp(readout.R_s * readout.V_bias * slope * sizes[:, None] * rate * np.cos(turn), axis=1)
    else:
        raise DeviceInvalid("is missing and needed here", channel=f"{axis.name}.readout", hint="add the readout")
    seen = np.ptp(np.percentile(signal, [0.5, 99.5]))
    above = np.flatnonzero(told >= seen)
    return float(sizes[above[0]] if above.size else sizes[np.argmax(told)])
