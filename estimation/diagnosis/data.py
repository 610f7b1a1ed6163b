"""Recordings prepared for the fit: inputs on the integration grid, outputs decimated."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import ceil, floor

import numpy as np

from estimation.diagnosis.noise import periodogram
from scanner.arrays import Array
from scanner.channel import Channel, check_signal
from scanner.device import Amdm, Axis, Device, Position, Readout, Transimpedance
from scanner.errors import BadInput, DeviceInvalid
from scanner.forward_model import DriveInput
from scanner.integrator.nodes import to_nodes
from scanner.interpolation import interpolate_cubic
from scanner.lowpass import lowpass_response
from scanner.recording import Recording
from scanner.terms import NaturalScales

MIN_STEPS_PER_PERIOD = 52
"""Integration steps per period of the motion. With four times as many, the channels of a recording with 20 000 samples
change by half the noise of one sample in total, after the nominal values have been refitted (by 1.1 with 60 000 samples
and a broad-band drive)."""

MIN_STEPS_PER_DRIVE_PERIOD = 24
"""Integration steps per period of the strongest line of the drive, so that the integration resolves the drive's
waveform."""

BAND_HARMONICS = 16
"""Highest frequency that is compared, in multiples of the motion's frequency. Harmonics of a Gaussian capacitance fall
off quickly; a wider band would add noise and cost only."""

MIN_SAMPLES_PER_PERIOD = 2.5
"""Samples of a channel in one period of the resonance, at least: the sampling theorem asks for 2, and the filter that
thins channels out needs a quarter more."""

STEADY_TONE_POWER_SHARE = 0.5
"""Share of the alternating power of a drive above which a tone and its harmonics make it a steady drive. Short pulses
reach half; a sweep or noise has little power there."""

STEADY_TONE_HARMONICS = 6
"""Harmonics that are counted to a steady tone; half of the power of pulses of a twentieth of a period lies in them."""

LINE_SEARCH_SAMPLES = 1 << 17
"""Samples from the start in which the strongest line of a drive is searched. It bounds the cost of the transform and
resolves a line to 1/131 072 of the sample rate."""

FILTER_EDGE_SAMPLES = 16
"""Samples at either end of a decimated channel that are not compared, because the decimation filter (32 of the original
samples per decimated one, half on either side) reaches beyond the recording there."""


@dataclass(frozen=True)
class Output:
    """One recorded channel after decimation.

    Attributes:
        name: of the channel.
        kind: ``"sense"`` or ``"angle"``.
        axes: that act on it.
        data: shape (n,) [V or rad].
        full: as recorded, shape (N,).
        full_rate: sample rate of ``full`` [Hz].
        step: sample interval of ``data`` [s].
        first: position of the first sample on the integration grid, in its steps.
        stride: distance between samples on that grid, in its steps.
        guard: samples at the start and at the end that are not compared.
        bins: number of bins of its Fourier transform that are compared, from 0 Hz on.
        noise_sd: stated standard deviation of the noise of a sample of ``full``, None where none is stated.
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
        """Whether the samples coincide with the points of the integration grid."""
        return abs(self.first) < 1e-6 and abs(self.stride - 1.0) * self.data.size < 1e-6

    def sampled(self, signal: Array) -> Array:
        """``signal``, given on the integration grid, at the samples of this channel up to the end of the grid."""
        if self.on_grid:
            return signal[: self.data.size]
        at = self.first + self.stride * np.arange(self.data.size, dtype=np.float64)
        at = at[at <= signal.size - 1 + 1e-9]
        return interpolate_cubic(signal, at)


@dataclass(frozen=True)
class Run:
    """One recording.

    Attributes:
        name: of the recording.
        inputs: drive voltages by axis.
        outputs: compared channels.
        scales: natural scales by axis.
        duration: [s].
        lines: strongest lines of the drive by axis [Hz].
    """

    name: str
    inputs: Mapping[str, DriveInput]
    outputs: tuple[Output, ...]
    scales: Mapping[str, NaturalScales]
    duration: float
    lines: Mapping[str, Array]


def prepare_run(recording: Recording, device: Device, oversample: int = 1) -> Run:
    """Prepare a recording for the fit.

    Args:
        oversample: factor by which the integration grid is finer than needed, to check the integration error.

    Raises:
        BadInput: no channel can be simulated by the device, or a channel is missing or invalid.
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
    for name, (_, sensed_axes) in outputs.items():
        _check_rate(recording, recording[name], sensed_axes, device, drives)
    start, end = max(c.start for c in used), min(c.end - 1 / c.sample_rate for c in used)
    clock = max((c for channels in drives.values() for c in channels), key=lambda c: c.sample_rate, default=used[0])
    step, n, grid_start = _grid(clock, start, end, axes, device, drives, oversample)
    if n < 8 * MIN_STEPS_PER_PERIOD:
        what = f"the channels share {end - start:.3g} s, fewer than 8 turns of the mirror"
        raise BadInput(what, file=recording.path, hint="record longer, or check the channels' start times")
    origin = recording.start
    inputs = {
        name: DriveInput(
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
    """The readout of ``axis``, which may be shared."""
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


def _check_rate(
    recording: Recording, channel: Channel, axes: tuple[str, ...], device: Device, drives: Mapping[str, list[Channel]]
) -> None:
    """Refuse a channel that is sampled too slowly for the motion of a free decay.

    A driven axis moves at the drive's frequency, which may lie far below its resonance.

    Raises:
        BadInput: fewer than ``MIN_SAMPLES_PER_PERIOD`` samples in a period of the resonance.
    """
    fastest = max(device.axis(name).resonance for name in axes)
    driven = any(float(np.ptp(each.read())) > 0.0 for name in axes for each in drives[name])
    if driven or channel.sample_rate >= MIN_SAMPLES_PER_PERIOD * fastest:
        return
    what = f"is sampled at {channel.sample_rate:.4g} Hz, too slowly for a resonance at {fastest:.4g} Hz"
    hint = f"record at {2.0 * MIN_SAMPLES_PER_PERIOD * fastest:.4g} Hz or more, or correct J and k of the device"
    raise BadInput(what, file=recording.path, channel=channel.name, hint=hint)


def _drive_channels(recording: Recording, axis: Axis) -> list[Channel]:
    names = [f"drive_{axis.name}", f"bias_{axis.name}"]
    if axis.drive is not None and axis.drive.kind == "linear" and names[0] not in recording:
        recording.require(names[0], f"the linear drive of axis {axis.name} cannot be simulated without it")
    return [recording[name] for name in names if name in recording]


def _rest_voltage(device: Device, axis: str, drives: list[Channel]) -> float:
    """Voltage [V] on the comb where no drive was recorded: the bias of the readout."""
    readout = readout_of(device, axis)
    return readout.V_bias if isinstance(readout, Transimpedance) and not drives else 0.0


def _grid(clock: Channel, start: float, end: float, axes: tuple[str, ...], device: Device,
          drives: Mapping[str, list[Channel]], oversample: int) -> tuple[float, int, float]:  # fmt: skip
    """Step [s], number of steps, and start of the integration [s]."""
    fastest = max(device.axis(name).resonance for name in axes)
    line = max((strongest_line(c.read(), c.sample_rate) for name in axes for c in drives[name]), default=0.0)
    wanted = max(MIN_STEPS_PER_PERIOD * fastest, MIN_STEPS_PER_DRIVE_PERIOD * line) * oversample
    rate = clock.sample_rate
    thin = floor(rate / wanted)
    thin = thin - thin % 2 if thin >= 2 else 1
    splits = 1 if thin > 1 else max(1, ceil(wanted / rate / 1.5))
    first = ceil((start - clock.start) * rate - 1e-6)
    step = thin / rate / splits
    grid_start = clock.start + first / rate
    return step, floor((end - grid_start) / step + 1e-6), grid_start


def strongest_line(values: Array, rate: float) -> float:
    """Frequency of the strongest line [Hz], 0 for a constant signal."""
    part = values[:LINE_SEARCH_SAMPLES]
    if part.std() < 1e-3 * (abs(part.mean()) + 1e-300):
        return 0.0
    return float(np.argmax(periodogram(part - part.mean())) * rate / part.size)


def is_steady(line: float, values: Array, rate: float) -> bool:
    """Whether a drive is a tone at ``line`` [Hz] with its harmonics, and not a sweep, a multisine or noise."""
    part = values[:LINE_SEARCH_SAMPLES]
    power, overtone = periodogram(part - part.mean()), np.arange(1, STEADY_TONE_HARMONICS + 1)
    far = np.abs(np.arange(power.size)[:, None] - overtone * line * part.size / rate)
    near = np.any(far <= 2.0 + 0.5 * overtone, axis=1)  # the window is two wide, the line known to half a bin
    return bool(power[near].sum() > STEADY_TONE_POWER_SHARE * power.sum())


def _voltage(channels: list[Channel], rest: float, start: float, step: float, n: int) -> Array:
    """Sum of the channels at the start, middle and end of every step, shape (n, 3)."""
    total = np.full((n, 3), rest)
    for channel in channels:
        samples = channel.read()
        lag, stride = (start - channel.start) * channel.sample_rate, step * channel.sample_rate / 2
        half = resample_drive(samples, lag + stride * np.arange(2 * n + 1, dtype=float))
        total += to_nodes(half)
    return total


def resample_drive(samples: Array, at: Array) -> Array:
    """``samples`` at fractional positions ``at``: band-limited for smooth signals, the last value next to jumps.

    A jump is a step between two samples that is larger than a quarter of the whole range and ten times its neighbours':
    cubic interpolation would ring around it.
    """
    nearest = np.rint(at)
    if np.abs(at - nearest).max() < 1e-6:
        return samples[np.clip(nearest.astype(np.intp), 0, samples.size - 1)]
    factor = round(1.0 / (at[1] - at[0])) if at.size > 1 else 1
    dense_index = at * factor
    if factor > 1 and np.abs(dense_index - np.rint(dense_index)).max() < 1e-4 and not has_jumps(samples):
        from scipy.signal import resample_poly

        mean = samples.mean()
        dense = resample_poly(samples - mean, factor, 1, window=("kaiser", 8.0)) + mean
        return dense[np.clip(np.rint(dense_index).astype(np.intp), 0, dense.size - 1)]
    base = np.clip(np.floor(at + 1e-9).astype(np.intp), 1, samples.size - 3)
    a, b, c, d = samples[base - 1], samples[base], samples[base + 1], samples[base + 2]
    steps = np.stack([np.abs(b - a), np.abs(c - b), np.abs(d - c)])
    largest, ordinary = steps.max(axis=0), np.median(steps, axis=0)
    jumps = (largest > 0.25 * np.ptp(samples)) & (largest > 10.0 * ordinary)
    held = samples[np.clip(np.floor(at + 1e-9).astype(np.intp), 0, samples.size - 1)]
    return np.where(jumps, held, interpolate_cubic(samples, at))


def has_jumps(samples: Array) -> bool:
    """Whether a signal has jumps, as square waves and steps have, between which it changes little."""
    steps = np.abs(np.diff(samples))
    return bool(steps.max() > 0.2 * np.ptp(samples) > 0.0 and steps.max() > 30.0 * np.median(steps))


def _lines(inputs: DriveInput) -> Array:
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
    data = full if thin == 1 else decimate(full, thin)
    own = thin / channel.sample_rate
    offset = (channel.start + first / channel.sample_rate - start) / step
    data = data[: fast_transform_length(floor((n - offset) * step / own + 1e-6) + 1)]
    fastest = max(device.axis(name).resonance for name in axes)
    drive = max((lines[name].max() for name in axes if lines[name].size), default=0.0)
    band = min(0.35 / own, max(BAND_HARMONICS * fastest, 1.5 * drive))
    edge = FILTER_EDGE_SAMPLES if thin > 1 else 2
    guard = (max(edge, ceil(1.0 / (fastest * own))), edge)
    kind = "angle" if channel.name.startswith("angle") else "sense"
    readout = readout_of(device, axes[0])
    noise = readout.noise_sd if kind == "sense" and readout is not None else None
    bins = fast_transform_length(int(band * data.size * own)) + 1
    return Output(
        channel.name, kind, axes, data, full, channel.sample_rate, own, offset, own / step, guard, bins, noise
    )


def fast_transform_length(n: int) -> int:
    """Largest length up to ``n`` with a fast Fourier transform; less than 1 % shorter for long signals."""
    from scipy.fft import prev_fast_len

    return int(prev_fast_len(n, real=True))


def decimate(values: Array, factor: int) -> Array:
    """Decimate by ``factor`` behind a zero-phase low-pass, flat to 1e-5 in the lower 70 % of the new band."""
    from scipy.signal import firwin, resample_poly

    mean = values.mean()
    taps = firwin(32 * factor + 1, 0.9 / factor, window=("kaiser", 10.0))
    return resample_poly(values - mean, 1, factor, window=taps) + mean


def _scales(device: Device, name: str, inputs: DriveInput, outputs: tuple[Output, ...], lines: Array, two: bool,
            duration: float) -> NaturalScales:  # fmt: skip
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
        rate = resonance  # a broad-band drive moves the mirror most there
    if not (
        0.5 < rate / resonance < 2.0 or (follows and rate < resonance)
    ):  # far below its resonance, a stage follows its drive
        rate = resonance
    measured = next((o.data for o in outputs if o.name == f"angle_{name}"), None)
    return NaturalScales(
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
    """Approximate peak amplitude of the motion [rad], from the angle or else through the law of the readout."""
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
        passed = np.abs(
            lowpass_response(rate / np.pi, readout.lpf_hz)
        )  # an even capacitance varies at twice the motion's rate
        simulated = np.ptp(readout.a_cir * comb.C0 * np.exp(-u * u), axis=1) * passed
    elif isinstance(readout, Transimpedance):
        slope = -2 * u / comb.theta0 * comb.C0 * np.exp(-u * u)
        simulated = np.ptp(readout.R_s * readout.V_bias * slope * sizes[:, None] * rate * np.cos(turn), axis=1)
    else:
        raise DeviceInvalid("is missing and needed here", channel=f"{axis.name}.readout", hint="add the readout")
    seen = np.ptp(np.percentile(signal, [0.5, 99.5]))
    above = np.flatnonzero(simulated >= seen)
    return float(sizes[above[0]] if above.size else sizes[np.argmax(simulated)])
