"""Recordings prepared for the fit: inputs on the integration grid, outputs decimated."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import ceil, floor

import numpy as np

from estimation.device_fit.drive_lines import drive_lines, is_steady, strongest_line
from estimation.device_fit.resampling import decimate, fast_transform_length, resample_drive
from estimation.rail import upper_rail
from estimation.reference import MIN_SAMPLES_PER_PERIOD, sampled_too_slowly
from scanner.arrays import Array
from scanner.channel import Channel
from scanner.device import Axis, Device
from scanner.errors import BadInput, DeviceInvalid
from scanner.forward_model import REFERENCE_ORDERS, DriveInput
from scanner.integrator.nodes import to_nodes
from scanner.interpolation import interpolate_cubic
from scanner.lowpass import lowpass_response
from scanner.recording import Recording
from scanner.settling import settling_time
from scanner.signal_check import check_signal
from scanner.stages import Amdm, MotionSensor, Readout, Transimpedance
from scanner.terms import NaturalScales

MIN_STEPS_PER_PERIOD = 52
"""Integration steps per period of the motion. With four times as many, all samples of a recording of 20 000 change
together by half the standard deviation of one sample's noise, after a refit of the nominal values (by 1.1 standard
deviations with 60 000 samples and a broad-band drive)."""

MIN_STEPS_PER_DRIVE_PERIOD = 24
"""Integration steps per period of the strongest line of the drive, so that the integration resolves the drive's
waveform."""

BAND_HARMONICS = 16
"""Highest frequency that is compared, in multiples of the motion's frequency. Harmonics of a Gaussian capacitance
decrease quickly; a wider band would only add noise and computing time."""

MAX_QUALITY_FORGETTING = np.pi
"""Quality factor below which a free motion decays by more than a factor e within a period. Then only the first samples
determine the initial state: without them it would follow an error of the model, with values far beyond the motion."""

FILTER_EDGE_SAMPLES = 16
"""Samples at either end of a decimated channel that are not compared: the decimation filter extends over 16 decimated
samples on either side, and there beyond the recording."""


MAX_UNSETTLED_SHARE = 0.25
"""Largest share of a channel that is left out at either end for the transient of a readout. Of a shorter recording
nothing has settled, and what is left must determine the motion."""


@dataclass(frozen=True)
class Output:
    """One recorded channel after decimation.

    Attributes:
        name: of the channel.
        kind: ``"sense"`` or one of ``scanner.forward_model.REFERENCE_ORDERS``.
        axes: names of the axes whose motion the channel contains.
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

    @cached_property
    def noisy_share(self) -> Array:
        """Share of every sample of ``data`` that contains noise, shape (n,): samples at a rail of the signal do not."""
        rails = [(side, rail[0]) for side in (1.0, -1.0) if (rail := upper_rail(side * self.full))]
        if not rails:
            return np.ones(self.data.size)
        free = np.logical_and.reduce([side * self.full < limit for side, limit in rails]).astype(float)
        decimation = max(1, round(self.step * self.full_rate))
        return np.clip(free if decimation == 1 else decimate(free, decimation), 0.0, 1.0)[: self.data.size]

    def sampled(self, signal: Array) -> Array:
        """``signal``, given on the integration grid, at the samples of this channel up to the end of the grid."""
        if self.on_grid:
            return signal[: self.data.size]
        position = self.first + self.stride * np.arange(self.data.size, dtype=np.float64)
        return interpolate_cubic(signal, position[position <= signal.size - 1 + 1e-9])


@dataclass(frozen=True)
class Run:
    """One recording, prepared for the fit.

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

    @property
    def steps(self) -> int:
        """Integration steps of all axes."""
        return sum(len(drive.voltage) for drive in self.inputs.values())


def prepare_run(recording: Recording, device: Device, oversample: int = 1, to_last_sample: bool = False) -> Run:
    """Prepare a recording for the fit.

    Args:
        oversample: factor by which the integration grid is finer than needed, to check the integration error.
        to_last_sample: whether the last step may end after the last sample, so that the steps contain all samples.

    Raises:
        BadInput: no channel can be simulated by the device, or a channel is missing or invalid.
    """
    channels = output_channels(recording, device)
    if not channels:
        holds = ", ".join(recording.names)
        kinds = ", ".join(("sense", *REFERENCE_ORDERS))
        hint = f"record one of {kinds}, or add the readout to the device; it holds {holds}"
        raise BadInput("holds no channel that the device can simulate", file=recording.path, hint=hint)
    axes = tuple(name for name in device.axes if any(name in sensed for _, sensed in channels.values()))
    drives = {name: _drive_channels(recording, device.axis(name)) for name in axes}
    used = [recording[name] for name in channels] + [channel for group in drives.values() for channel in group]
    for channel in used:
        check_signal(channel, constant_ok=channel.name.startswith(("bias", "drive")))
    for name, (_, sensed_axes) in channels.items():
        _check_rate(recording, recording[name], sensed_axes, device, drives)
    start, end = max(c.start for c in used), min(c.end - 1 / c.sample_rate for c in used)
    clock = max((c for group in drives.values() for c in group), key=lambda c: c.sample_rate, default=used[0])
    step, n, grid_start = _grid(clock, start, end, axes, device, drives, oversample)
    if n < 8 * MIN_STEPS_PER_PERIOD:
        what = f"the channels share {end - start:.3g} s, fewer than 8 periods of the motion"
        raise BadInput(what, file=recording.path, hint="record longer, or check the channels' start times")
    origin, steps = recording.origin, ceil((end - grid_start) / step - 1e-6) if to_last_sample else n
    inputs = {
        name: DriveInput(
            _voltage(drives[name], _rest_voltage(device, name, drives[name]), grid_start, step, steps),
            step,
            grid_start - origin,
            is_bias=f"bias_{name}" in recording and f"drive_{name}" not in recording,
        )
        for name in axes
    }
    lines = {name: drive_lines(inputs[name]) for name in axes}
    compared = tuple(
        _output(recording[name], sensed, device, step, n, grid_start, lines) for name, (_, sensed) in channels.items()
    )
    for output in compared:
        if sum(output.guard) >= output.data.size:
            slowest = min(device.axis(name).resonance for name in output.axes)
            what = f"covers {(end - start) * slowest:.2g} periods of a resonance at {slowest:.4g} Hz"
            hint = "record at least 8 periods, or correct J and k of the device"
            raise BadInput(what, file=recording.path, channel=output.name, hint=hint)
    scales = {
        name: _scales(device, name, inputs[name], compared, lines[name], len(axes) > 1, end - start) for name in axes
    }
    return Run(recording.name, inputs, compared, scales, end - start, lines)


def sense_channel(device: Device, axis: str) -> str:
    """Name of the channel in which ``axis`` is sensed."""
    return "sense" if device.readout is not None else f"sense_{axis}"


def readout_of(device: Device, axis: str) -> Readout | None:
    """The readout of ``axis``, which may be shared."""
    return device.readout if device.readout is not None else device.axis(axis).readout


def output_channels(recording: Recording, device: Device) -> dict[str, tuple[str, tuple[str, ...]]]:
    """Kind of each channel that the device can simulate, and the axes that it shows, by name."""
    channels: dict[str, tuple[str, tuple[str, ...]]] = {}
    for name in device.axes:
        channel = sense_channel(device, name)
        if channel in recording and readout_of(device, name) is not None:
            channels[channel] = ("sense", (*channels.get(channel, ("", ()))[1], name))
        for kind in REFERENCE_ORDERS:
            if f"{kind}_{name}" in recording:
                channels[f"{kind}_{name}"] = (kind, (name,))
    return channels


def _check_rate(
    recording: Recording, channel: Channel, axes: tuple[str, ...], device: Device, drives: Mapping[str, list[Channel]]
) -> None:
    """Refuse a channel that is sampled too slowly for the motion.

    A free decay moves at its resonance. A driven axis moves at the drive's frequency, which may lie below its
    resonance. Where neither drive nor channel can contain the resonance, its values cannot be determined.

    Raises:
        BadInput: fewer than ``MIN_SAMPLES_PER_PERIOD`` samples in a period of the resonance.
    """
    fastest = max(device.axis(name).resonance for name in axes)
    driving = [drive for name in axes for drive in drives[name] if float(np.ptp(drive.read())) > 0.0]
    if max([channel.sample_rate, *(drive.sample_rate for drive in driving)]) >= MIN_SAMPLES_PER_PERIOD * fastest:
        return
    raise sampled_too_slowly(channel, "a resonance", fastest, remedy=", or correct J and k of the device")


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
    fastest = max(device.axis(name).require_mechanics().fastest_pole for name in axes)
    line = max((strongest_line(c.read(), c.sample_rate) for name in axes for c in drives[name]), default=0.0)
    min_rate = max(MIN_STEPS_PER_PERIOD * fastest, MIN_STEPS_PER_DRIVE_PERIOD * line) * oversample
    rate = clock.sample_rate
    decimation = floor(rate / min_rate)
    decimation = decimation - decimation % 2 if decimation >= 2 else 1
    splits = 1 if decimation > 1 else max(1, ceil(min_rate / rate / 1.5))
    first = ceil((start - clock.start) * rate - 1e-6)
    step = decimation / rate / splits
    grid_start = clock.start + first / rate
    return step, floor((end - grid_start) / step + 1e-6), grid_start


def _voltage(channels: list[Channel], rest_voltage: float, start: float, step: float, n: int) -> Array:
    """Sum of the channels at the start, middle and end of every step, shape (n, 3)."""
    total = np.full((n, 3), rest_voltage)
    for channel in channels:
        samples = channel.read()
        first_position, stride = (start - channel.start) * channel.sample_rate, step * channel.sample_rate / 2
        half = resample_drive(samples, first_position + stride * np.arange(2 * n + 1, dtype=float))
        total += to_nodes(half)
    return total


def _output(channel: Channel, axes: tuple[str, ...], device: Device, step: float, n: int, start: float,
            lines: Mapping[str, Array]) -> Output:  # fmt: skip
    full = channel.read()
    first = max(0, ceil((start - channel.start) * channel.sample_rate - 1e-6))
    full = full[first:]
    decimation = max(1, round(step * channel.sample_rate))
    forgotten = min(device.axis(name).quality for name in axes) < MAX_QUALITY_FORGETTING
    data = full if decimation == 1 else decimate(full, decimation, "line" if forgotten else "mean")
    interval = decimation / channel.sample_rate
    offset = (channel.start + first / channel.sample_rate - start) / step
    data = data[: fast_transform_length(floor((n - offset) * step / interval + 1e-6) + 1)]
    fastest = max(device.axis(name).require_mechanics().fastest_pole for name in axes)
    drive = max((lines[name].max() for name in axes if lines[name].size), default=0.0)
    band = min(0.35 / interval, max(BAND_HARMONICS * fastest, 1.5 * drive))
    edge = FILTER_EDGE_SAMPLES if decimation > 1 else 2
    kind = channel.name.partition("_")[0]
    unsettled = unsettled_samples(kind, [device.sensed_axis(name) for name in axes], data.size, interval)
    start_guard = 0 if forgotten else max(edge, ceil(1.0 / (fastest * interval)))
    guard = (max(start_guard, unsettled[0]), max(edge, unsettled[1]))
    readout = readout_of(device, axes[0])
    noise = readout.noise_sd if kind == "sense" and readout is not None else None
    bins = fast_transform_length(int(band * data.size * interval)) + 1
    return Output(
        channel.name, kind, axes, data, full, channel.sample_rate, interval, offset, interval / step, guard, bins, noise
    )


def unsettled_samples(kind: str, axes: Sequence[Axis], size: int, step: float) -> tuple[int, int]:
    """Samples at the start and at the end of a channel that depend on the signal before and after the recording."""
    most = int(MAX_UNSETTLED_SHARE * size)
    start, end = (min(most, ceil(time / step - 1e-6)) for time in settling_time(kind, axes, size * step))
    return start, end


def _scales(device: Device, name: str, inputs: DriveInput, outputs: tuple[Output, ...], lines: Array, two_axes: bool,
            duration: float) -> NaturalScales:  # fmt: skip
    axis = device.axis(name)
    mechanics, readout = axis.require_mechanics(), readout_of(device, name)
    voltage = inputs.voltage[:, 0]
    line = strongest_line(voltage, 1 / inputs.step)
    resonance = 2 * np.pi * mechanics.resonance
    parametric = axis.drive is not None and axis.drive.kind == "electrostatic"
    shown = [o for o in outputs if name in o.axes]
    sensed = next((o for o in shown if o.kind == "sense"), shown[0])
    follows = not parametric and 0.8 < strongest_line(sensed.data, 1 / sensed.step) / (line or np.inf) < 1.25
    rate = np.pi * line if parametric and line else 2 * np.pi * line if line else resonance
    if line and not is_steady(line, voltage, 1 / inputs.step):
        rate = resonance  # a broad-band drive causes the largest motion there
    follows_drive = follows and rate < resonance  # as a stage does far below its resonance
    if not (0.5 < rate / resonance < 2.0 or follows_drive):
        rate = resonance
    references = {o.kind: o.data for o in outputs if o.axes == (name,) and o.kind != "sense"}
    measured = next((references[k] / float(rate) ** n for k, n in REFERENCE_ORDERS.items() if k in references), None)
    return NaturalScales(
        amplitude=_amplitude(axis, readout, rate, sensed.data, measured),
        rate=float(rate),
        J=mechanics.J, b=mechanics.b, k=mechanics.k,
        duration=duration,
        voltage_mean=float(voltage.mean()), voltage_rms=float(voltage.std()),
        drive_rate=2 * np.pi * line if line else float(rate),
        sense_rms=float(sensed.data.std()), sense_peak=float(np.abs(sensed.full).max()),
        readout=readout, two_axes=two_axes,
    )  # fmt: skip


def _amplitude(axis: Axis, readout: Readout | None, rate: float, signal: Array, measured: Array | None) -> float:
    """Approximate peak amplitude of the motion [rad], from the angle or else through the law of the readout."""
    if measured is not None:
        return float(np.percentile(np.abs(measured - np.median(measured)), 99))
    if isinstance(readout, MotionSensor):
        return float(np.percentile(np.abs(signal - np.median(signal)), 99) / abs(readout.gain) / rate**readout.order)
    capacitance = axis.require_capacitance()
    amplitudes = capacitance.theta0 * np.geomspace(0.02, 2.0, 60)
    phase = 2 * np.pi * np.arange(128) / 128
    theta = amplitudes[:, None] * np.sin(phase)
    u = theta / capacitance.theta0
    if isinstance(readout, Amdm):
        # an even capacitance varies at twice the frequency of the motion
        lowpass_gain = np.abs(lowpass_response(rate / np.pi, readout.lpf_hz))
        simulated = np.ptp(readout.a_cir * capacitance.C0 * np.exp(-u * u), axis=1) * lowpass_gain
    elif isinstance(readout, Transimpedance):
        slope = -2 * u / capacitance.theta0 * capacitance.C0 * np.exp(-u * u)
        simulated = np.ptp(readout.R_s * readout.V_bias * slope * amplitudes[:, None] * rate * np.cos(phase), axis=1)
    else:
        raise DeviceInvalid("is missing and needed here", channel=f"{axis.name}.readout", hint="add the readout")
    peak_to_peak = np.ptp(np.percentile(signal, [0.5, 99.5]))
    large_enough = np.flatnonzero(simulated >= peak_to_peak)
    return float(amplitudes[large_enough[0]] if large_enough.size else amplitudes[np.argmax(simulated)])
