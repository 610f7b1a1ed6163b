"""Whether a sensor of the motion holds more than noise: lines are searched where the motion is expected."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain
from math import isclose

from estimation.estimate import default_estimator
from estimation.filters.baselines import find_position_signal
from estimation.reference import tone_frequency
from estimation.signals import is_capacitive, sense_channels
from recon.quality.drive_check import SAME_FREQUENCY
from recon.quality.hum_check import describe_hum
from recon.quality.line_search import LineSearch, search_lines
from scanner.channel import Channel
from scanner.device import AXES, Device
from scanner.errors import BadInput
from scanner.recording import Recording
from scanner.signal_check import check_signal
from scanner.stages import Position

BAND = (0.8, 1.25)
"""Range of a motion's frequency over its nominal one in which it is searched, as the tracker does without a drive: a
stiffness that is wrong or drifts by 50 %."""

POSITION_ESTIMATORS = ("sensor", "sine-ukf", "edges")
"""Estimators that follow a position signal of any waveform; ``edges`` on the axes without edges."""

SENSE_ESTIMATORS = ("tracker", "tracker-causal", "ekf", "ukf", "hyb", "acm", "constant")
"""Estimators that follow a resonant motion in a sense signal."""


@dataclass(frozen=True)
class Sensor:
    """A channel that an estimator follows, and where its motion is expected.

    Attributes:
        channel: with the motion.
        axes: whose motion it carries.
        driven: frequencies that the drives cause in the channel [Hz].
        bands: lowest and highest frequency of each range in which a line is expected [Hz]; none if any is possible.
        any_waveform: whether the estimator can follow what lies outside the bands.
    """

    channel: Channel
    axes: tuple[str, ...]
    driven: tuple[float, ...]
    bands: tuple[tuple[float, float], ...]
    any_waveform: bool


def check_sensor_noise(recording: Recording, device: Device, estimator: str | None) -> list[str]:
    """Check that every sensor that the estimator follows holds more than noise.

    Args:
        recording: with the channels of the motion.
        device: with resonances and readouts.
        estimator: name of the estimator; the default one where None.

    Returns:
        A line for each position sensor that moves, but not at the frequency of its drive, or that shows only hum.

    Raises:
        BadInput: a sensor shows no line where the motion is expected.
    """
    notes = []
    for sensor in _sensors_in_use(recording, device, estimator or default_estimator(recording, device)):
        channel = sensor.channel
        expected = search_lines(channel, sensor.bands, sensor.driven)
        if expected is None:
            continue
        hint = "check the sensor, its cable and amplifier, and check drive voltage and frequency"
        hint += _alternatives(recording, device, sensor)
        if expected.found:
            hum = None if sensor.bands else describe_hum(channel, expected.frequency)
            if hum:
                driven = f"if the mirror is driven at it, state frequency in [{sensor.axes[0]}.drive]"
                notes.append(f"{channel.name}: {hum}: it is hum, not a motion; {hint}; {driven}")
            continue
        other = search_lines(channel, ()) if sensor.bands else None
        what = _describe_search(sensor, expected)
        if other is None or not other.found:
            what = f"shows no motion, only noise: {what}"
            raise BadInput(what, file=channel.file, channel=channel.name, hint=hint)
        what = f"shows no motion where it is expected: {what}; its strongest line is at {other.frequency:.6g} Hz"
        if not sensor.any_waveform:
            raise BadInput(what, file=channel.file, channel=channel.name, hint=hint)
        notes.append(f"{channel.name}: {what}; {hint}")
    return notes


def _sensors_in_use(recording: Recording, device: Device, estimator: str) -> Iterator[Sensor]:
    """The channels that an estimator follows. What it cannot use is left to its own message."""
    if estimator in POSITION_ESTIMATORS:
        for name, axis in device.axes.items():
            if estimator == "edges" and f"sync_{name}" in recording.edges:
                continue
            with suppress(BadInput):
                if recording.channels.keys() & {f"sense_{name}", f"angle_{name}"}:
                    channel = find_position_signal(recording, axis, name)[0]
                    check_signal(channel, gaps_ok=True)
                    driven = _drive_frequencies(recording, device, name)
                    yield Sensor(
                        channel, (name,), tuple(sorted({*driven})), _bands(device, name, driven) if driven else (), True
                    )
    elif estimator in SENSE_ESTIMATORS:
        with suppress(BadInput):
            for sense in sense_channels(recording, device, gaps_ok=True):
                order = 2 if is_capacitive(sense.readout) else 1
                moved = {
                    name: [order * each for each in _drive_frequencies(recording, device, name)] for name in sense.axes
                }
                bands = [_bands(device, name, lines, order) for name, lines in moved.items()]
                used = tuple(sorted(chain(*bands))) if all(bands) else ()
                yield Sensor(sense.channel, sense.axes, tuple(sorted({*chain(*moved.values())})), used, False)


def _drive_frequencies(recording: Recording, device: Device, name: str) -> list[float]:
    """Frequencies at which the drive of an axis moves it [Hz]: of its strongest line near the resonance, and of all."""
    axis, drive = device.axis(name), recording.channels.get(f"drive_{name}")
    if axis.drive is None:
        return []
    ratio = axis.drive.motion_per_drive
    found: list[float] = []
    if drive is None:
        return [] if axis.drive.frequency is None else [axis.drive.frequency * ratio]
    for low in (0.0, 0.1 * axis.resonance) if axis.mechanics else (0.0,):
        with suppress(BadInput):
            check_signal(drive, gaps_ok=True)
            frequency = tone_frequency(drive, low) * ratio
            if not any(isclose(frequency, other, rel_tol=SAME_FREQUENCY) for other in found):
                found.append(frequency)
    return found


def _bands(device: Device, name: str, lines: list[float], order: int = 1) -> tuple[tuple[float, float], ...]:
    """Ranges [Hz] around the driven ``lines`` of an axis and around ``order`` times its resonance, merged."""
    axis = device.axis(name)
    centres = sorted({*lines, order * axis.resonance} if axis.mechanics else set(lines))
    merged: list[tuple[float, float]] = []
    for low, high in ((BAND[0] * centre, BAND[1] * centre) for centre in centres):
        if merged and low <= merged[-1][1]:
            merged[-1] = (merged[-1][0], high)
        else:
            merged.append((low, high))
    return tuple(merged)


def _describe_search(sensor: Sensor, search: LineSearch) -> str:
    """What was found where lines were searched, in words."""
    ranges = " and ".join(f"from {low:.5g} to {high:.5g} Hz" for low, high in sensor.bands) or "at all frequencies"
    lines = " and ".join(f"{line:.6g} Hz" for line in sensor.driven)
    driven = "" if search.driven is None else f"{search.driven:.2g} at {lines}, where the drive moves it, and "
    return (
        f"the power over the noise around is {driven}at most {search.ratio:.2g} {ranges}, as by chance; "
        f"a steady motion has more than {search.needed:.2g}"
    )


def _alternatives(recording: Recording, device: Device, sensor: Sensor) -> str:
    """Other channels that show the motion, with the way to use them, as the end of a hint."""
    name, dead = sensor.axes[0], sensor.channel.name
    readout, others = device.axis(name).readout, []
    if f"angle_{name}" in recording and not dead.startswith("angle"):
        others.append(f"--estimator sensor uses angle_{name}")
    if dead.startswith("angle") and f"sense_{name}" in recording and readout is not None:
        is_position = isinstance(readout, Position)
        how = f"without {dead} the estimator" if is_position else "--estimator tracker"
        others.append(f"{how} uses sense_{name}")
    for other in (f"velocity_{name}", f"acceleration_{name}"):
        if dead.startswith("sense") and other in recording:
            others.append(f"without {dead} the tracker uses {other}")
    if f"sync_{name}" in recording.edges:
        others.append(f"--estimator edges uses sync_{name}")
    if all(_drive_frequencies(recording, device, axis) for axis in AXES if axis in device.axes):
        others.append("--estimator picture needs the drives and the intensity alone")
    return f"; or {', '.join(others)}" if others else ""
