"""Preparation of a recording: check it once, and collect what estimation, gridding and assessment need."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from math import isclose
from pathlib import Path
from typing import Any

from estimation.optics.correction import correct_intensity
from estimation.signals import require_device
from recon.quality.clock_jumps import detect_clock_jumps, longest_segment
from recon.quality.defects import Defect, find_defects
from recon.quality.drive_check import check_drives, check_rates, check_signals
from recon.quality.duration_check import check_duration
from recon.quality.sensor_sign import describe_inverted_sensors
from scanner import devices
from scanner.channel import USED_CHANNELS, Channel
from scanner.channel_names import suggest_name
from scanner.device import AXES, VALUES, Device
from scanner.errors import BadInput
from scanner.recording import Recording
from scanner.signal_check import check_signal
from scanner.wording import counted

DeviceSource = str | Path | Device
"""A device, the path of a TOML file, or the name of a device of ``scanner.devices``."""

MIN_INTENSITY_COVERAGE = 0.9
"""Part of a recording that an intensity covers without a note: triggers and filters cost less than a tenth."""


MOTION_CHANNELS = ("sense", "angle_", "velocity_", "acceleration_", "drive_")
"""Beginnings of the names of channels that determine the motion."""

MAX_RATE_DIFFERENCE = 1e-4
"""Relative difference of two sample rates that the crystals of two instruments may have."""


@dataclass(frozen=True)
class PreparedRecording:
    """A recording that was checked, cut to the segment in use and corrected for the device's optics.

    Attributes:
        recording: the segment in use; its intensity is corrected for the optics terms of the device.
        lagging: the intensity corrected for delay and gain, and not for the low-pass of a slow detector.
        uncorrected: the same segment with the recorded intensity.
        device: the device in use.
        clock_jumps: phase jumps of the whole recording. The segment contains none of them.
        defects: clock jumps, then gaps, clipping and missing parts of the segment's channels.
        unknown_entries: a line for every channel and every device key that the program does not know.
        clock_notes: what makes the sample rate of the intensity doubtful, a line each.
        origin: time at which the optics terms of the device begin [s].
    """

    recording: Recording
    lagging: Channel
    uncorrected: Recording
    device: Device
    clock_jumps: tuple[Defect, ...]
    defects: tuple[Defect, ...]
    unknown_entries: tuple[str, ...]
    clock_notes: tuple[str, ...]
    origin: float

    @property
    def intensity(self) -> Channel:
        """The corrected intensity of the segment."""
        return self.recording["intensity"]

    def for_picture(self, undo_lag: bool) -> PreparedRecording:
        """The recording with the intensity that a picture is made of.

        Args:
            undo_lag: without the low-pass of a slow detector; with it, averages have less electronic noise.
        """
        return self if undo_lag else replace(self, recording=self.recording.with_channel(self.lagging))

    @property
    def position_z(self) -> Channel | None:
        """Position of the objective or the stage; None where it was not recorded."""
        return self.recording.channels.get("position_z")


def prepare(recording: Recording, device: DeviceSource | None = None) -> PreparedRecording:
    """Check a recording and cut it to its longest segment without a clock jump.

    Args:
        recording: with an intensity, and whatever channels the estimator needs.
        device: in place of the recording's own.

    Raises:
        BadInput: no intensity, or one that is not a signal; no device, a device without an
            x or a y axis, drives that do not fit it, or less than a period of the slower axis.
    """
    check_signal(recording.require("intensity", "a picture needs it"), gaps_ok=True)
    _check_shape(recording["intensity"])
    device = select_device(recording, device)
    clock_jumps = detect_clock_jumps(recording)
    if clock_jumps:
        recording = recording.part(*longest_segment(recording, clock_jumps))
    for axis in AXES:
        device.axis(axis)
    check_drives(recording, device)
    check_signals(recording, device)
    check_rates(recording, device)
    check_duration(recording, device)
    return prepare_segment(recording, device, clock_jumps)


def prepare_segment(segment: Recording, device: Device, clock_jumps: Sequence[Defect]) -> PreparedRecording:
    """Correct and inspect a segment between clock jumps.

    Args:
        segment: with an intensity.
        device: of the recording.
        clock_jumps: of the whole recording.
    """
    recording, lagging = correct_intensity(segment, device, undo_lag=True), correct_intensity(segment, device)
    return PreparedRecording(
        recording=recording,
        lagging=lagging["intensity"],
        uncorrected=segment,
        device=device,
        clock_jumps=tuple(clock_jumps),
        defects=(*clock_jumps, *find_defects(lagging, device, segment["intensity"])),
        unknown_entries=tuple(_unknown_entries(recording, device)),
        clock_notes=tuple(_describe_intensity_clock(recording)),
        origin=recording.origin,
    )


def prepare_frame(recording: Recording, device: Device, start: float, stop: float) -> PreparedRecording:
    """Prepare the part of a growing recording from ``start`` to ``stop`` [s], without a search for clock jumps.

    Raises:
        BadInput: the part holds no intensity.
    """
    frame, lagging = (correct_intensity(recording, device, undo_lag=each).part(start, stop) for each in (True, False))
    frame.require("intensity", "a picture needs it")
    uncorrected = recording.part(start, stop)
    return PreparedRecording(
        recording=frame,
        lagging=lagging.require("intensity", "a picture needs it"),
        uncorrected=uncorrected,
        device=device,
        clock_jumps=(),
        defects=tuple(find_defects(lagging, device, uncorrected.channels.get("intensity"))),
        unknown_entries=(),
        clock_notes=(),
        origin=recording.origin,
    )


def select_device(recording: Recording, device: DeviceSource | None) -> Device:
    """Return the given device, else the recording's own.

    Raises:
        BadInput: the file is not a valid device, or none is given and the recording has none.
    """
    return require_device(recording, None if device is None else devices.find(device))


def _check_shape(intensity: Channel) -> None:
    """Check that an intensity has more samples than detectors.

    Raises:
        BadInput: it has not.
    """
    if len(intensity.shape) == 2 and intensity.shape[1] > intensity.shape[0]:
        what = f"has {counted(intensity.shape[0], 'sample')} of {intensity.shape[1]} detectors: its axes are swapped"
        hint = "store it as (samples, detectors)"
        raise BadInput(what, file=intensity.file, channel=intensity.name, hint=hint)


def _unknown_entries(recording: Recording, device: Device) -> Iterator[str]:
    """A line for every unknown channel and device key, and every inverted sensor."""
    references = {channel.reference for channel in recording.channels.values()}
    for name in recording.channels:
        if name not in USED_CHANNELS and name not in references:
            yield f"{name}: a channel of this name is not used{suggest_name(name)}"
    yield from describe_inverted_sensors(recording, device)
    stated = {"": device.shared_tolerance, **{f"{name}.": axis.tolerance for name, axis in device.axes.items()}}
    for prefix, tolerance in stated.items():
        for key, relative in tolerance.items():
            if key not in VALUES:
                yield f"{prefix}tolerance.{key}: is the tolerance of no value of a device, and not used"
            elif relative > 1.0:
                yield f"{prefix}tolerance.{key}: is {relative:g}, that is {relative:.0%}; it is relative: 5 % is 0.05"
    for key in _dotted_keys({**device.extra, **{name: axis.extra for name, axis in device.axes.items()}}):
        yield f"{key}: is no key of a device, and not used"


def _describe_intensity_clock(recording: Recording) -> Iterator[str]:
    """A line for an intensity that is short, and for one with as many samples as other channels, at another rate."""
    light = recording.channels.get("intensity")
    if light is None:
        return
    covered = (light.end - light.start) / recording.duration if recording.duration > 0.0 else 1.0
    if covered < MIN_INTENSITY_COVERAGE:
        yield (
            f"intensity: covers {covered:.0%} of the recording, {light.end - light.start:.4g} s of "
            f"{recording.duration:.4g} s; if it was recorded throughout, check its sample_rate"
        )
    others = {
        name: channel.sample_rate
        for name, channel in recording.channels.items()
        if name.startswith(MOTION_CHANNELS)
        and channel.size == light.size
        and not isclose(channel.sample_rate, light.sample_rate, rel_tol=MAX_RATE_DIFFERENCE)
    }
    if others:
        rates = " and ".join(f"{rate:.6g}" for rate in dict.fromkeys(others.values()))
        yield (
            f"intensity: has {light.size} samples at {light.sample_rate:.6g} Hz, and {', '.join(others)} as many at "
            f"{rates} Hz; if they were recorded together, a sample_rate is wrong"
        )


def _dotted_keys(table: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    """Dotted keys of all values in nested tables."""
    for key, value in table.items():
        if isinstance(value, Mapping):
            yield from _dotted_keys(value, f"{prefix}{key}.")
        else:
            yield prefix + key
