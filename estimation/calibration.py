"""Recordings in, device out: which recording tells what (chen2020 IV-A: ringdown, then sweep; the output at rest)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimation.identify import Driven, Value, mechanics_from_driven, profile, ringdown
from estimation.reference import drive_reference
from scanner.channel import check_signal
from scanner.clock import on_clock
from scanner.demodulate import block_length, block_phasors
from scanner.device import Amdm, Axis, Device, Position
from scanner.errors import BadInput
from scanner.recording import Recording

Array = NDArray[np.float64]

STRETCH_CYCLES = 200.0  # of the motion: a sweep is cut into stretches that count as one frequency
STEADY = 0.02  # relative change of a stretch's amplitude above which it is not steady motion
FLAT = 1e-3  # of its largest value: a drive that varies by less is none


@dataclass(frozen=True)
class Identified:
    """What was found.

    Attributes:
        device: the nominal one with the found values in place and their relative deviations as tolerances.
        values: axis -> name -> value; a name is a key of the device, or ``delay``, ``resonance``, ``quality``.
        used: axis -> which recording served as what.
        notes: what could not be told, and what would tell it.
    """

    device: Device
    values: Mapping[str, Mapping[str, Value]]
    used: Mapping[str, Sequence[str]]
    notes: Sequence[str]


def identify(recordings: Sequence[Recording], device: Device) -> Identified:
    """Identify every axis of ``device`` that the recordings show.

    Raises:
        BadInput: no recording tells anything of any axis, or one cannot be used.
    """
    axes, values, used, notes = dict(device.axes), {}, {}, []
    for name, axis in device.axes.items():
        found = _Axis(name, axis)
        for recording in recordings:
            found.look_at(recording)
        found.conclude()
        notes += found.notes
        if found.values:
            axes[name], values[name], used[name] = found.device_axis(), found.values, found.used
    if not values:
        what = "no recording shows a rest, a free decay or a driven motion with a reference angle"
        raise BadInput(what, file=recordings[0].path if recordings else None, hint="record angle_x beside sense_x")
    return Identified(replace(device, axes=axes), values, used, notes)


class _Axis:
    """One axis while the recordings pass by."""

    def __init__(self, name: str, axis: Axis):
        self.name, self.axis = name, axis
        self.values: dict[str, Value] = {}
        self.used: list[str] = []
        self.notes: list[str] = []
        self.driven: list[Driven] = []
        self.inertia: Value | None = None

    def look_at(self, recording: Recording) -> None:
        """Take what one recording tells of this axis."""
        kind = kind_of(recording, self.name)
        if kind is None:
            return
        self.used.append(f"{recording.name}: {kind}")
        if kind == "rest":
            self._rest(recording)
            return
        names = [f"angle_{self.name}", *[n for n in (f"sense_{self.name}", f"drive_{self.name}") if n in recording]]
        clock, values = on_clock(recording, names)
        angle = values[f"angle_{self.name}"]
        if kind == "free decay":
            self._ringdown(recording, angle, clock.rate)
            frequency = self.axis.resonance
        else:
            reference = drive_reference(
                recording[f"drive_{self.name}"],
                "half-drive" if self.axis.require_drive().kind == "electrostatic" else "drive",
            )
            frequency = reference.frequency
            time = clock.time
            self.driven += steady_stretches(
                angle, values[f"drive_{self.name}"], reference.frequency_at(time), clock.rate
            )
        sense = values.get(f"sense_{self.name}")
        if sense is not None and not isinstance(self.axis.require_readout(), Position):
            found = profile(self.axis, angle, sense, clock.rate, frequency).values
            for key, value in found.items():
                self._keep(key, value)

    def _keep(self, key: str, value: Value) -> None:
        """Several recordings' values of one constant, weighed by their variances."""
        old = self.values.get(key)
        if old is not None:
            weights = 1 / old.sd**2, 1 / value.sd**2
            mean = (weights[0] * old.value + weights[1] * value.value) / sum(weights)
            value = Value(mean, float(np.sqrt(1 / sum(weights))))
        self.values[key] = value

    def _rest(self, recording: Recording) -> None:
        sense = recording[f"sense_{self.name}"].read()
        variance = float(sense.var(ddof=1))
        if isinstance(self.axis.require_readout(), Amdm):
            self._keep("noise_var", Value(variance, variance * np.sqrt(2.0 / sense.size)))
        else:
            self._keep("noise_sd", Value(float(np.sqrt(variance)), float(np.sqrt(0.5 * variance / sense.size))))

    def _ringdown(self, recording: Recording, angle: Array, rate: float) -> None:
        bias = f"bias_{self.name}"
        volt = float(recording[bias].read().mean()) if bias in recording else 0.0
        if f"drive_{self.name}" in recording:
            volt += float(recording[f"drive_{self.name}"].read().mean())
        found, _ = ringdown(angle, rate, self.axis, volt)
        for key in ("k_over_J", "b_over_J"):
            self._keep(key, found[key])
        self.inertia = found.get("J", self.inertia)

    def conclude(self) -> None:
        """The torque's scale from driven motion, else what a bias tells of it, else the nominal J."""
        axis = self.device_axis()  # with the bell as found
        frequencies = {round(record.frequency) for record in self.driven}
        if len(frequencies) > 1:
            self.values |= mechanics_from_driven(axis, self.driven)
            return
        if self.driven:
            self.notes.append(f"{self.name}: one drive frequency does not tell J; record two or more")
        if "k_over_J" in self.values:
            mechanics = self.axis.require_mechanics()
            if self.inertia is None:
                self.notes.append(
                    f"{self.name}: J is the nominal one; a free decay tells k/J and b/J only, driven motion J"
                )
            inertia = self.inertia or Value(mechanics.J, 0.0)
            self.values["J"] = inertia
            for key, ratio in (("k", self.values["k_over_J"]), ("b", self.values["b_over_J"])):
                sd = np.hypot(ratio.sd * inertia.value, ratio.value * inertia.sd)
                self.values[key] = Value(ratio.value * inertia.value, float(sd))

    def device_axis(self) -> Axis:
        """The axis with the values in place."""
        axis, tolerance = self.axis, dict(self.axis.tolerance)
        for stage in ("mechanics", "capacitance", "readout"):
            part = getattr(axis, stage)
            keys = [key for key in self.values if part is not None and hasattr(type(part), "__dataclass_fields__")]
            keys = [key for key in keys if key in part.__dataclass_fields__] if part is not None else []
            if keys:
                axis = replace(axis, **{stage: replace(part, **{key: self.values[key].value for key in keys})})
            tolerance |= {
                key: abs(self.values[key].sd / self.values[key].value) for key in keys if self.values[key].value
            }
        return replace(axis, tolerance=tolerance)


def kind_of(recording: Recording, name: str) -> str | None:
    """``"rest"``, ``"free decay"`` or ``"driven"``: what a recording shows of one axis; None for nothing of use."""
    drive, angle, sense = (recording.channels.get(f"{kind}_{name}") for kind in ("drive", "angle", "sense"))
    oscillates = False
    if drive is not None:
        values = drive.read()
        oscillates = bool(np.std(values) > FLAT * max(np.abs(values).max(), 1e-300))
    if angle is not None and moves(angle.read()):
        return "driven" if oscillates else "free decay"
    if sense is None or oscillates:
        return None
    check_signal(sense)
    return None if moves(sense.read()) else "rest"


def moves(values: Array) -> bool:
    """Whether a signal is more than white noise, whose neighbouring samples differ as much as distant ones."""
    return bool(np.std(values) > 1.2 * np.std(np.diff(values)) / np.sqrt(2.0))


def steady_stretches(angle: Array, voltage: Array, frequency: Array, rate: float) -> list[Driven]:
    """A driven record cut into stretches of one frequency; those whose amplitude changes are left out.

    Args:
        angle: [rad], voltage: [V], frequency: of the motion [Hz], each of shape (n,). rate: [Hz].
    """
    length = block_length(float(np.mean(frequency)), rate, STRETCH_CYCLES)
    found = []
    for first in range(0, max(angle.size - length // 2, 1), length):
        cut = slice(first, min(first + length, angle.size))
        f = float(np.mean(frequency[cut]))
        block = block_length(f, rate, 10.0)
        if angle[cut].size < 4 * block:
            continue
        size = np.abs(block_phasors(angle[cut], rate, 0.0, f, block)[1])
        if np.ptp(size) < STEADY * size.mean():
            found.append(Driven(angle[cut], voltage[cut], f, rate))
    return found
