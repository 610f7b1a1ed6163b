"""Identification of a device: which recording determines which parameters, and their combination.

The order is that of chen2020 IV-A: readout noise at rest, ringdowns, then driven motion.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from estimation.identification.agreement import IdentifiedValue
from estimation.identification.axis_identification import MECHANICS_KEYS, AxisIdentification
from estimation.slow.response import Response, ResponseFit
from scanner.device import Device
from scanner.errors import BadInput
from scanner.recording import Recording


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
        responses: axis -> frequency responses, each with its fit.
        nonlinear: axes whose motion contradicts the linear law that is fitted.
    """

    device: Device
    values: Mapping[str, Mapping[str, IdentifiedValue]]
    used: Mapping[str, Sequence[str]]
    notes: Sequence[str]
    responses: Mapping[str, Sequence[tuple[Response, ResponseFit]]]
    nonlinear: Sequence[str] = ()

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
    axes, values, used, notes, responses = dict(device.axes), {}, {}, [], {}
    scaled: list[str] = []  # axes whose torque is uncertain
    nonlinear: list[str] = []
    if any("sense" in recording for recording in recordings):
        notes.append(
            "sense: the electrode is shared by both axes, so that capacitances and readout are not identified and keep "
            "their nominal values; the mechanics are identified from angle_x, angle_y"
        )
    for name, axis in device.axes.items():
        result = AxisIdentification(name, axis)
        for recording in recordings:
            result.add(recording)
        result.conclude()
        notes += result.notes
        if result.values:
            axes[name], values[name], used[name] = result.device_axis(), result.marginal(), result.used
            responses[name] = result.responses
            nonlinear += [name] if result.nonlinear else []
            if any(result.by_torque.get(key) for key in MECHANICS_KEYS):
                scaled.append(name)
            if axis.terms:
                notes.append(
                    f"{name}: the constants are fitted without the terms that the device states "
                    f"({', '.join(axis.terms)}); they contain the effect of these terms, and their intervals do not "
                    "allow for it; `lissajous diagnose` fits constants and terms together"
                )
    if scaled:
        notes.append(
            f"{', '.join(scaled)}: the intervals of J, b and k contain the uncertainty of the torque, of the readout's "
            "gain or of the nominal J, which scales all three together; this factor changes no motion, so that their "
            "tolerances in device.toml do not contain it"
        )
    if not values:
        what = "no recording shows a rest, a free decay, steady tones or a driven motion with a reference angle"
        names = ", ".join(sorted({name for recording in recordings for name in recording.names}))
        hint = f"record angle_x together with sense_x; the recording contains {names or 'nothing'}"
        if notes:
            what, hint = "the recordings determine no constant", "; ".join(notes)
        raise BadInput(what, file=recordings[0].path if recordings else None, hint=hint)
    return Identification(replace(device, axes=axes), values, used, notes, responses, nonlinear)
