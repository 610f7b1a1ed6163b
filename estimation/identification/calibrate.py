"""Identification of a device: which recording determines which parameters, and their combination.

The order is that of chen2020 IV-A: readout noise at rest, ringdowns, then driven motion.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from estimation.identification.decay_without_angle import fit_decay_without_angle
from estimation.identification.fits import (
    DrivenRecord,
    IdentifiedValue,
    fit_capacitance_profile,
    fit_mechanics,
    fit_ringdown,
)
from estimation.reference import drive_reference
from estimation.slow.response import Response, frequency_responses
from estimation.slow.response_selection import select_effects
from scanner.arrays import Array
from scanner.channel import check_signal
from scanner.clock import on_clock
from scanner.device import DEFAULT_TOLERANCE, Axis, Device
from scanner.errors import BadInput
from scanner.lock_in import block_length, block_phasors
from scanner.recording import Recording
from scanner.stages import Amdm, MotionSensor

SEGMENT_CYCLES = 200.0
"""Cycles per segment of a driven recording: a sweep changes little within one, which counts as one frequency."""

MAX_AMPLITUDE_CHANGE = 0.02
"""Relative change of amplitude within a segment above which it is no steady motion and is left out."""
TORQUE_SCALE = (("capacitance", "C0"), ("capacitance", "theta0"), ("drive", "torque_per_volt"), ("mechanics", "J"))
"""Stage and key of the constants that scale the torque, and with it J, k and b; J itself where no torque is known."""

Decay = tuple[Array, float, float]
"""Angle of a free decay [rad], shape (n,), its rate [Hz], and the voltage on the combs [V]."""

UNREFERENCED_DECAY = "free decay without a reference angle"

MIN_DRIVE_VARIATION = 1e-3
"""Standard deviation of a drive relative to its largest value below which it counts as constant."""

WHITE_NOISE_MARGIN = 1.2
"""Standard deviation of a signal over that of white noise with the same differences, above which it shows motion."""


@dataclass(frozen=True)
class Identification:
    """The identified device.

    Attributes:
        device: the nominal one with the identified values. Tolerances of J, b and k hold at the drive's nominal
            torque: a factor common to them and to the torque changes no motion.
        values: axis -> name -> value; a name is a key of the device, ``delay``, ``k_over_J``, ``b_over_J`` or
            ``amplitude_over_theta0``. The intervals include the uncertainty of the torque.
        used: axis -> recordings and how each was used.
        notes: parameters that could not be determined, and the recording that would determine them.
    """

    device: Device
    values: Mapping[str, Mapping[str, IdentifiedValue]]
    used: Mapping[str, Sequence[str]]
    notes: Sequence[str]

    def __repr__(self) -> str:
        lines = [f"Identified {self.device.name!r}"]
        for axis, values in self.values.items():
            lines += [f"  {axis} {name} = {value.value:.6g} ± {value.sd:.2g}" for name, value in values.items()]
        return "\n".join([*lines, *(f"  note: {note}" for note in self.notes)])


def identify(recordings: Sequence[Recording], device: Device) -> Identification:
    """Identify every axis of ``device`` that the recordings show.

    Raises:
        BadInput: no recording determines a parameter of any axis, or one cannot be used.
    """
    axes, values, used, notes = dict(device.axes), {}, {}, []
    if any("sense" in recording for recording in recordings):
        notes.append(
            "sense: the electrode is shared by both axes, so that capacitances and readout are not identified and keep "
            "their nominal values; the mechanics are identified from angle_x, angle_y"
        )
    for name, axis in device.axes.items():
        result = _AxisIdentification(name, axis)
        for recording in recordings:
            result.add(recording)
        result.conclude()
        notes += result.notes
        if result.values:
            axes[name], values[name], used[name] = result.device_axis(), result.marginal(), result.used
    if not values:
        what = "no recording shows a rest, a free decay, steady tones or a driven motion with a reference angle"
        names = ", ".join(sorted({name for recording in recordings for name in recording.channels}))
        hint = f"record angle_x together with sense_x; the recording contains {names or 'nothing'}"
        raise BadInput(what, file=recordings[0].path if recordings else None, hint=hint)
    return Identification(replace(device, axes=axes), values, used, notes)


class _AxisIdentification:
    """Values of one axis, collected from one recording after the other."""

    def __init__(self, name: str, axis: Axis):
        self.name, self.axis = name, axis
        self.values: dict[str, IdentifiedValue] = {}
        self.used: list[str] = []
        self.notes: list[str] = []
        self.driven: list[DrivenRecord] = []
        self.decays: list[Decay] = []
        self.by_torque: dict[str, float] = {}  # standard deviation that the drive's torque adds to a value

    def add(self, recording: Recording) -> None:
        """Use one recording, if it shows this axis."""
        responses = frequency_responses(recording, Device("", {self.name: self.axis}))
        if responses:
            self.used.append(f"{recording.name}: frequency response")
            self.values = combine_values([self.values, fit_steady_tones(responses[0])])
            self.notes.append(f"{self.name}: J is the nominal one; steady tones determine only k/J and b/J")
            return
        kind = classify_recording(recording, self.name)
        if kind is None:
            return
        self.used.append(f"{recording.name}: {kind}")
        if kind == "rest":
            self._rest(recording)
            return
        if kind == UNREFERENCED_DECAY:
            self._unreferenced(recording)
            return
        names = [f"angle_{self.name}", *[n for n in (f"sense_{self.name}", f"drive_{self.name}") if n in recording]]
        clock, values = on_clock(recording, names)
        angle = values[f"angle_{self.name}"]
        if kind == "free decay":
            self.decays.append((angle, clock.rate, self._volt(recording)))
            frequency = self.axis.resonance
        else:
            reference = drive_reference(
                recording[f"drive_{self.name}"],
                "half-drive" if self.axis.require_drive().kind == "electrostatic" else "drive",
            )
            frequency = reference.frequency
            time = clock.time
            self.driven += steady_segments(
                angle, values[f"drive_{self.name}"], reference.frequency_at(time), clock.rate
            )
        sense = values.get(f"sense_{self.name}")
        if sense is not None and not isinstance(self.axis.require_readout(), MotionSensor):
            found = fit_capacitance_profile(self.axis, angle, sense, clock.rate, frequency).values
            self.values = combine_values([self.values, found])

    def _unreferenced(self, recording: Recording) -> None:
        """Ratios of the mechanics from a free decay of the readout's signal alone, with a note on the other values."""
        readout = self.axis.require_readout()
        found = fit_decay_without_angle(self.axis, recording[f"sense_{self.name}"])
        self.values = combine_values([self.values, found])
        open_values = "J, and the gain of the readout"
        if not isinstance(readout, MotionSensor):
            open_values = "J, theta0, C0, the gain of the readout, and the sign of the angle"
        self.notes.append(
            f"{self.name}: without a reference angle a free decay determines k/J and b/J (resonance and Q) only; "
            f"{open_values} stay as stated; record angle_{self.name}, and driven motion for J"
        )

    def _rest(self, recording: Recording) -> None:
        sense = recording[f"sense_{self.name}"].read()
        variance = float(sense.var(ddof=1))
        if isinstance(self.axis.require_readout(), Amdm):
            found = {"noise_var": IdentifiedValue(variance, variance * np.sqrt(2.0 / sense.size))}
        else:
            found = {"noise_sd": IdentifiedValue(float(np.sqrt(variance)), float(np.sqrt(0.5 * variance / sense.size)))}
        self.values = combine_values([self.values, found])

    def _volt(self, recording: Recording) -> float:
        """Voltage on the combs during a free decay [V]."""
        names = [name for name in (f"bias_{self.name}", f"drive_{self.name}") if name in recording]
        return sum((float(recording[name].read().mean()) for name in names), start=0.0)

    def conclude(self) -> None:
        """Determine the mechanics: scaled by driven motion, else by a bias during a decay, else by the nominal J."""
        if not self.decays and "k_over_J" in self.values:
            J = self.axis.require_mechanics().J
            for key in ("k", "b"):
                ratio = self.values[f"{key}_over_J"]
                self.values[key] = IdentifiedValue(ratio.value * J, ratio.sd * J)
                self.by_torque[key] = ratio.value * self.axis.tolerance.get("J", DEFAULT_TOLERANCE) * J
        axis = self.device_axis()  # with the capacitance as identified
        if self.decays:
            self._take(axis, lambda axis: mechanics_from_decays(axis, self.decays))
        several = len({round(record.frequency) for record in self.driven}) > 1
        if several:
            self._take(axis, lambda axis: fit_mechanics(axis, self.driven))
        elif self.driven:
            self.notes.append(f"{self.name}: one drive frequency does not determine J; record two or more")
        if self.decays and not several and not any(volt for _, _, volt in self.decays):
            self.notes.append(
                f"{self.name}: J is the nominal one; a free decay determines only k/J and b/J, driven motion also J"
            )

    def _take(self, axis: Axis, fit: Callable[[Axis], dict[str, IdentifiedValue]]) -> None:
        """Take the mechanics that ``fit`` returns, and how far one sd of each constant of the torque changes them."""
        found = fit(axis)
        self.values |= found
        self.by_torque |= dict.fromkeys(found, 0.0)
        for stage, key in TORQUE_SCALE:
            part = getattr(axis, stage)
            value = getattr(part, key, None)
            if value is None:
                continue
            sd = axis.tolerance.get(key, DEFAULT_TOLERANCE) * abs(value)
            off = fit(replace(axis, **{stage: replace(part, **{key: value + sd})})) if sd else found
            for name in found:
                moved = off[name].value - found[name].value
                self.by_torque[name] = float(np.hypot(self.by_torque[name], moved))

    def marginal(self) -> dict[str, IdentifiedValue]:
        """The values with their complete uncertainty, that of the torque included."""
        return {
            key: IdentifiedValue(value.value, float(np.hypot(value.sd, self.by_torque.get(key, 0.0))))
            for key, value in self.values.items()
        }

    def device_axis(self) -> Axis:
        """The axis with the identified values."""
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


def combine_values(found: Sequence[Mapping[str, IdentifiedValue]]) -> dict[str, IdentifiedValue]:
    """Values of several recordings; those of one parameter are averaged with inverse variances as weights."""
    values: dict[str, IdentifiedValue] = {}
    for key in dict.fromkeys(key for each in found for key in each):
        same = [each[key] for each in found if key in each]
        weights = np.array([1.0 / each.sd**2 for each in same]) if len(same) > 1 else np.ones(1)
        mean = float(np.average([each.value for each in same], weights=weights))
        values[key] = IdentifiedValue(mean, float(weights.sum() ** -0.5) if len(same) > 1 else same[0].sd)
    return values


def fit_steady_tones(response: Response) -> dict[str, IdentifiedValue]:
    """k/J and b/J from the first mode of a frequency response."""
    fit = select_effects(response)
    (frequency, quality), (frequency_sd, quality_sd) = fit.modes[0], fit.mode_sd[0]
    rate, floor = 2.0 * np.pi * float(frequency), np.finfo(float).tiny
    relative = float(np.hypot(frequency_sd / frequency, quality_sd / quality))
    return {
        "k_over_J": IdentifiedValue(rate**2, max(2.0 * rate**2 * float(frequency_sd / frequency), floor)),
        "b_over_J": IdentifiedValue(rate / float(quality), max(rate / float(quality) * relative, floor)),
    }


def mechanics_from_decays(axis: Axis, decays: Sequence[Decay]) -> dict[str, IdentifiedValue]:
    """Mechanics from free decays; J is the nominal one where no bias determines it."""
    found = combine_values([fit_ringdown(angle, rate, axis, volt)[0] for angle, rate, volt in decays])
    J = found.setdefault("J", IdentifiedValue(axis.require_mechanics().J, 0.0))
    for key in ("k", "b"):
        ratio = found[f"{key}_over_J"]
        found[key] = IdentifiedValue(ratio.value * J.value, float(np.hypot(ratio.sd * J.value, ratio.value * J.sd)))
    return found


def classify_recording(recording: Recording, name: str) -> str | None:
    """What a recording shows of one axis; None if nothing is of use.

    ``"rest"``, ``"free decay"`` or ``"driven"`` with a reference angle, or ``UNREFERENCED_DECAY``.
    """
    drive, angle, sense = (recording.channels.get(f"{kind}_{name}") for kind in ("drive", "angle", "sense"))
    oscillates = False
    if drive is not None:
        values = drive.read()
        oscillates = bool(np.std(values) > MIN_DRIVE_VARIATION * max(np.abs(values).max(), 1e-300))
    if angle is not None and shows_motion(angle.read()):
        return "driven" if oscillates else "free decay"
    if sense is None or oscillates:
        return None
    check_signal(sense)
    return UNREFERENCED_DECAY if shows_motion(sense.read()) else "rest"


def shows_motion(values: Array) -> bool:
    """Whether a signal is more than white noise: neighbouring samples of noise differ as much as distant ones."""
    return bool(np.std(values) > WHITE_NOISE_MARGIN * np.std(np.diff(values)) / np.sqrt(2.0))


def steady_segments(angle: Array, voltage: Array, frequency: Array, rate: float) -> list[DrivenRecord]:
    """Segments of one frequency of a driven record; those whose amplitude changes are left out.

    Args:
        angle: [rad], voltage: [V], frequency: of the motion [Hz], each of shape (n,). rate: [Hz].
    """
    length = block_length(float(np.mean(frequency)), rate, SEGMENT_CYCLES)
    found = []
    for first in range(0, max(angle.size - length // 2, 1), length):
        cut = slice(first, min(first + length, angle.size))
        f = float(np.mean(frequency[cut]))
        block = block_length(f, rate, 10.0)
        if angle[cut].size < 4 * block:
            continue
        size = np.abs(block_phasors(angle[cut], rate, 0.0, f, block)[1])
        if np.ptp(size) < MAX_AMPLITUDE_CHANGE * size.mean():
            found.append(DrivenRecord(angle[cut], voltage[cut], f, rate))
    return found
