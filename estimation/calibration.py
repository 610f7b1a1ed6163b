"""Recordings in, device out: which recording tells what (chen2020 IV-A: ringdown, then sweep; the output at rest)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimation.identify import Driven, Value, mechanics_from_driven, profile, ringdown
from estimation.reference import drive_reference
from scanner.channel import check_signal
from scanner.clock import on_clock
from scanner.demodulate import block_length, block_phasors
from scanner.device import DEFAULT_TOLERANCE, Amdm, Axis, Device, Position
from scanner.errors import BadInput
from scanner.recording import Recording

Array = NDArray[np.float64]

STRETCH_CYCLES = 200.0  # of the motion: a sweep is cut into stretches that count as one frequency
STEADY = 0.02  # relative change of a stretch's amplitude above which it is not steady motion
TORQUE = (("capacitance", "C0"), ("capacitance", "theta0"), ("drive", "torque_per_volt"), ("mechanics", "J"))
"""Stage and key of what sets the torque's scale, in which J, k and b are measured; J itself where nothing else does."""

Decay = tuple[Array, float, float]
"""Angle of a free decay [rad], shape (n,), its rate [Hz], and the voltage on the combs [V]."""

FLAT = 1e-3  # of its largest value: a drive that varies by less is none


@dataclass(frozen=True)
class Identified:
    """What was found.

    Attributes:
        device: the nominal one with the found values in place. Tolerances of J, b and k are those at the drive's
            nominal torque: a factor that they and the torque share shows in no motion.
        values: axis -> name -> value; a name is a key of the device, ``delay``, ``k_over_J`` or ``b_over_J``. The
            intervals hold what the torque is uncertain by, too.
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
    if any("sense" in recording for recording in recordings):
        notes.append(
            "sense: of an electrode that both axes share nothing is identified, combs and readout stay nominal; "
            "mechanics come from angle_x, angle_y"
        )
    for name, axis in device.axes.items():
        found = _Axis(name, axis)
        for recording in recordings:
            found.look_at(recording)
        found.conclude()
        notes += found.notes
        if found.values:
            axes[name], values[name], used[name] = found.device_axis(), found.marginal(), found.used
    if not values:
        what = "no recording shows a rest, a free decay or a driven motion with a reference angle"
        names = ", ".join(sorted({name for recording in recordings for name in recording.channels}))
        hint = f"record angle_x beside sense_x; there is {names or 'nothing'}"
        raise BadInput(what, file=recordings[0].path if recordings else None, hint=hint)
    return Identified(replace(device, axes=axes), values, used, notes)


class _Axis:
    """One axis while the recordings pass by."""

    def __init__(self, name: str, axis: Axis):
        self.name, self.axis = name, axis
        self.values: dict[str, Value] = {}
        self.used: list[str] = []
        self.notes: list[str] = []
        self.driven: list[Driven] = []
        self.decays: list[Decay] = []
        self.by_torque: dict[str, float] = {}  # standard deviation that the drive's torque adds to a value

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
            self.decays.append((angle, clock.rate, self._volt(recording)))
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
            self.values = together([self.values, found])

    def _rest(self, recording: Recording) -> None:
        sense = recording[f"sense_{self.name}"].read()
        variance = float(sense.var(ddof=1))
        if isinstance(self.axis.require_readout(), Amdm):
            found = {"noise_var": Value(variance, variance * np.sqrt(2.0 / sense.size))}
        else:
            found = {"noise_sd": Value(float(np.sqrt(variance)), float(np.sqrt(0.5 * variance / sense.size)))}
        self.values = together([self.values, found])

    def _volt(self, recording: Recording) -> float:
        """What the combs hold during a free decay [V]."""
        names = [name for name in (f"bias_{self.name}", f"drive_{self.name}") if name in recording]
        return sum((float(recording[name].read().mean()) for name in names), start=0.0)

    def conclude(self) -> None:
        """The torque's scale from driven motion, else what a bias tells of it, else the nominal J."""
        axis = self.device_axis()  # with the bell as found
        if self.decays:
            self._take(axis, lambda axis: decayed(axis, self.decays))
        several = len({round(record.frequency) for record in self.driven}) > 1
        if several:
            self._take(axis, lambda axis: mechanics_from_driven(axis, self.driven))
        elif self.driven:
            self.notes.append(f"{self.name}: one drive frequency does not tell J; record two or more")
        if self.decays and not several and not any(volt for _, _, volt in self.decays):
            self.notes.append(
                f"{self.name}: J is the nominal one; a free decay tells k/J and b/J only, driven motion J"
            )

    def _take(self, axis: Axis, tell: Callable[[Axis], dict[str, Value]]) -> None:
        """The mechanics that ``tell`` finds, and how far each goes with the constants of the torque (linear, 1 sd)."""
        found = tell(axis)
        self.values |= found
        self.by_torque |= dict.fromkeys(found, 0.0)
        for stage, key in TORQUE:
            part = getattr(axis, stage)
            value = getattr(part, key, None)
            if value is None:
                continue
            sd = axis.tolerance.get(key, DEFAULT_TOLERANCE) * abs(value)
            off = tell(replace(axis, **{stage: replace(part, **{key: value + sd})})) if sd else found
            for name in found:
                moved = off[name].value - found[name].value
                self.by_torque[name] = float(np.hypot(self.by_torque[name], moved))

    def marginal(self) -> dict[str, Value]:
        """The values, each with all that is uncertain about it."""
        return {
            key: Value(value.value, float(np.hypot(value.sd, self.by_torque.get(key, 0.0))))
            for key, value in self.values.items()
        }

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


def together(found: Sequence[Mapping[str, Value]]) -> dict[str, Value]:
    """Several recordings' values, those of one constant weighed by their variances."""
    values: dict[str, Value] = {}
    for key in dict.fromkeys(key for each in found for key in each):
        same = [each[key] for each in found if key in each]
        weights = np.array([1.0 / each.sd**2 for each in same]) if len(same) > 1 else np.ones(1)
        mean = float(np.average([each.value for each in same], weights=weights))
        values[key] = Value(mean, float(weights.sum() ** -0.5) if len(same) > 1 else same[0].sd)
    return values


def decayed(axis: Axis, decays: Sequence[Decay]) -> dict[str, Value]:
    """Mechanics from free decays; J is the axis's own where no bias tells it."""
    found = together([ringdown(angle, rate, axis, volt)[0] for angle, rate, volt in decays])
    J = found.setdefault("J", Value(axis.require_mechanics().J, 0.0))
    for key in ("k", "b"):
        ratio = found[f"{key}_over_J"]
        found[key] = Value(ratio.value * J.value, float(np.hypot(ratio.sd * J.value, ratio.value * J.sd)))
    return found


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
