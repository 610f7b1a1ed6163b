"""Whether a recording lasts for a period of the slower axis, of which a shorter one shows a part of the field only."""

from __future__ import annotations

from estimation.reference import BLOCK_CYCLES
from estimation.short_tone import fit_short_tone
from scanner.channel import Channel
from scanner.device import AXES, Axis, Device
from scanner.errors import BadInput
from scanner.recording import Recording

MIN_PERIODS_OF_PICTURE = 1.0
"""Periods of each axis from which a picture is made: the beam has then passed its whole range in both directions."""

MOTION_KINDS = ("sense", "angle", "velocity", "acceleration", "drive")
"""Kinds of channels that show the motion of an axis or cause it, in order of preference."""


def check_duration(recording: Recording, device: Device) -> None:
    """Check that the channels of both axes hold a period of their motion.

    An axis whose device states neither mechanics nor the frequency of its drive is not checked: the ramp of a single
    frame is no period, and complete.

    Raises:
        BadInput: the channel of an axis is shorter; of two such axes the slower is named.
    """
    short: list[tuple[float, BadInput]] = []
    for name in AXES:
        axis, channel = device.axis(name), _motion_channel(recording, name)
        expected = _expected_frequency(recording, axis, name)
        if expected is None or channel is None:
            continue
        frequency, keys = expected
        periods = frequency * channel.size / channel.sample_rate
        if periods < MIN_PERIODS_OF_PICTURE and not _is_driven_faster(recording, axis, name, frequency):
            what = (
                f"holds {periods:.4g} periods of the motion of {name} at {frequency:.6g} Hz, and a picture needs "
                f"{MIN_PERIODS_OF_PICTURE:g} at least"
            )
            hint = f"record for longer, or check sample_rate, and {keys} of the device"
            short.append((periods, BadInput(what, file=channel.file, channel=channel.name, hint=hint)))
    if short:
        raise min(short, key=lambda each: each[0])[1]


def _expected_frequency(recording: Recording, axis: Axis, name: str) -> tuple[float, str] | None:
    """Frequency of an axis by its device [Hz], and the keys that state it: drive if not recorded, or mechanics."""
    own = axis.drive
    if own is not None and own.frequency is not None and f"drive_{name}" not in recording:
        return own.frequency * own.motion_per_drive, f"frequency in [{name}.drive]"
    return (axis.resonance, f"J and k in [{name}.mechanics]") if axis.mechanics else None


def _motion_channel(recording: Recording, name: str) -> Channel | None:
    """The channel that shows how long the motion of an axis was recorded; None with edges alone."""
    names = ("sense", *(f"{kind}_{name}" for kind in MOTION_KINDS))
    return next((recording[each] for each in names if each in recording), None)


def _is_driven_faster(recording: Recording, axis: Axis, name: str, frequency: float) -> bool:
    """Whether a recorded linear drive oscillates above ``frequency`` [Hz]; combs move an axis at its resonance."""
    own, drive = axis.drive, recording.channels.get(f"drive_{name}")
    if own is None or drive is None or own.motion_per_drive != 1.0:
        return False
    return fit_short_tone(drive, frequency, 2.0 * BLOCK_CYCLES) is not None
