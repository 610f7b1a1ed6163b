"""Whether drives and signals fit the device: what is swapped, doubled or at a wrong rate is named before estimation."""

from __future__ import annotations

from math import isclose

import numpy as np

from estimation.reference import dominant_frequency
from scanner.channel import Channel
from scanner.device import AXES, Device
from scanner.errors import BadInput
from scanner.recording import Recording
from scanner.stages import MotionSensor, Position

SAME_FREQUENCY = 0.05
"""Relative difference up to which a frequency counts as a resonance of the device, or two ratios as equal."""

MIN_SEARCHED_RATIO = 1e-4
"""Frequency over the resonance from which a drive is looked for: a rate in kHz in place of Hz is 1e-3."""

MAX_DRIVE_RATIO = 1.33
"""Factor between drive and resonance from which both axes together show a wrong sample rate."""

COMPARED_SAMPLES = 1 << 16
"""Samples of two channels that are compared: noise makes any two signals differ within a few."""


MAX_RATE_RATIO_ERROR = 1e-3
"""Relative deviation from 2 or 1/2 up to which a motion at a multiple of its drive's frequency shows a wrong rate."""


def check_signals(recording: Recording, device: Device) -> None:
    """Check the signals of the motion of both axes against each other and against the resonances of the device.

    Raises:
        BadInput: both axes have the same samples, or each axis oscillates at the resonance of the other.
    """
    times = [edges.times for edges in recording.edges.values()]
    if len(times) == len(AXES) and np.array_equal(times[0], times[1]):
        edges, other = recording.edges.values()
        hint = "check the mapping: a list may be used twice"
        raise BadInput(f"and {other.name} hold the same edges", file=edges.file, channel=edges.name, hint=hint)
    for kind in ("sense", "angle", "velocity", "acceleration"):
        names = [f"{kind}_{axis}" for axis in AXES]
        if not all(name in recording for name in names):
            continue
        x, y = (recording[name] for name in names)
        _check_different_samples(x, y)
        if any(device.axis(axis).mechanics is None for axis in AXES):
            continue
        if kind == "sense" and not all(isinstance(device.axis(axis).readout, MotionSensor) for axis in AXES):
            continue
        resonance = {axis: device.axis(axis).resonance for axis in AXES}
        if isclose(resonance["x"], resonance["y"], rel_tol=SAME_FREQUENCY):
            continue
        try:
            moves = {axis: dominant_frequency(recording[f"{kind}_{axis}"]) for axis in AXES}
        except BadInput:  # no oscillation, or samples that cannot be used: the estimator says what it needs
            continue
        if all(isclose(moves[axis], resonance[other], rel_tol=SAME_FREQUENCY) for axis, other in ("xy", "yx")):
            what, hint = f"and {y.name} are swapped: they show ", "exchange the channels, or the axes of the device"
            raise BadInput(what + _frequencies(moves, resonance), file=x.file, channel=x.name, hint=hint)
        _check_common_ratio(recording, names, moves, resonance)


def _check_different_samples(one: Channel, other: Channel) -> None:
    """Raise BadInput if two channels hold the same samples and are not constant."""
    first, second = (channel.read(0, COMPARED_SAMPLES) for channel in (one, other))
    if np.array_equal(first, second, equal_nan=True) and np.nanstd(first) > 0.0:
        hint = "check the mapping: a column may be used twice"
        raise BadInput(f"and {other.name} hold the same samples", file=one.file, channel=one.name, hint=hint)


def check_rates(recording: Recording, device: Device) -> None:
    """Check that a motion has the frequency of its linear drive.

    Raises:
        BadInput: a position signal moves at twice or half the frequency of its drive, as at a wrong sample rate, or
            it is the intensity.
    """
    for axis in AXES:
        signal, drive = _position_signal(recording, device, axis), recording.channels.get(f"drive_{axis}")
        if signal is None:
            continue
        light = recording.channels.get("intensity")
        if light is not None and len(light.shape) == 1:
            _check_different_samples(signal, light)
        own = device.axis(axis).drive
        if drive is None or own is None or own.motion_per_drive != 1.0:
            continue
        try:
            moves, driven = dominant_frequency(signal), dominant_frequency(drive)
        except BadInput:  # no oscillation, or samples that cannot be used: the estimator says what it needs
            continue
        ratio = moves / driven
        if any(isclose(ratio, wrong, rel_tol=MAX_RATE_RATIO_ERROR) for wrong in (2.0, 0.5)):
            what = f"moves at {moves:.6g} Hz, {ratio:.3g} times the {driven:.6g} Hz of {drive.name}"
            hint = f"check the sample_rate of both: {signal.sample_rate:g} Hz and {drive.sample_rate:g} Hz"
            raise BadInput(what, file=signal.file, channel=signal.name, hint=hint)


def _position_signal(recording: Recording, device: Device, axis: str) -> Channel | None:
    """The channel that shows the angle of an axis, if one does."""
    if f"angle_{axis}" in recording:
        return recording[f"angle_{axis}"]
    is_position = isinstance(device.axis(axis).readout, Position)
    return recording.channels.get(f"sense_{axis}") if is_position else None


def check_drives(recording: Recording, device: Device) -> None:
    """Check the frequencies of both drives against the resonances of the device.

    One axis that is driven off its resonance is no error. Two that are off by one factor, or at each other's
    resonance, are.

    Raises:
        BadInput: drives that are swapped, or a sample rate off by the factor that the message states.
    """
    moved, resonance = {}, {}
    for name in AXES:
        axis, key = device.axis(name), f"drive_{name}"
        if axis.mechanics is None or axis.drive is None or key not in recording:
            return
        try:
            frequency = dominant_frequency(recording[key], MIN_SEARCHED_RATIO * axis.resonance)
        except BadInput:  # no oscillation: the estimator says what it needs
            return
        moved[name], resonance[name] = frequency * axis.drive.motion_per_drive, axis.resonance
    if isclose(resonance["x"], resonance["y"], rel_tol=SAME_FREQUENCY):
        return
    at, file = _frequencies(moved, resonance), recording["drive_x"].file
    crossed = ((moved["x"], resonance["y"]), (moved["y"], resonance["x"]))
    if all(isclose(f, other, rel_tol=SAME_FREQUENCY) for f, other in crossed):
        what = f"and drive_y are swapped: they move {at}"
        raise BadInput(what, file=file, channel="drive_x", hint="exchange the channels, or the axes of the device")
    _check_common_ratio(recording, ["drive_x", "drive_y"], moved, resonance)


def _check_common_ratio(
    recording: Recording, names: list[str], moved: dict[str, float], resonance: dict[str, float]
) -> None:
    """Raise BadInput if both axes seem to move off their resonances by one factor, as at a wrong sample rate."""
    file, at = recording[names[0]].file, _frequencies(moved, resonance)
    ratio = {name: moved[name] / resonance[name] for name in AXES}
    wrong = max(ratio["x"], 1 / ratio["x"]) > MAX_DRIVE_RATIO
    if wrong and isclose(ratio["x"], ratio["y"], rel_tol=SAME_FREQUENCY):
        what = f"and {names[1]} move {at}, as if the sample rate were {ratio['x']:.3g} times the true one"
        hint = "check sample_rate, and J and k of the device"
        if isclose(ratio["x"], 2.0, rel_tol=SAME_FREQUENCY) or isclose(ratio["x"], 0.5, rel_tol=SAME_FREQUENCY):
            hint += "; combs (kind electrostatic) move the mirror at half the drive's frequency"
        raise BadInput(what, file=file, channel=names[0], hint=hint)


def _frequencies(moved: dict[str, float], resonance: dict[str, float]) -> str:
    """Frequencies of the motion beside the resonances, in words."""
    return ", ".join(f"{name} at {moved[name]:.6g} Hz (resonance {resonance[name]:.6g} Hz)" for name in AXES)
