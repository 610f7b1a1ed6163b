"""Identification of one axis: values of recordings, one after the other, and their combination."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from estimation.identification.agreement import Found, IdentifiedValue, combine_values, contradiction_notes
from estimation.identification.capacitance_profile import fit_capacitance_profile
from estimation.identification.classification import (
    UNREFERENCED_DECAY,
    UNREFERENCED_DRIVE,
    classify_recording,
    lock_in_only,
)
from estimation.identification.combination import (
    Decay,
    average_ratios,
    axis_with_values,
    conflict_notes,
    fit_decays,
    mechanics_from_decays,
    values_of_mode,
)
from estimation.identification.decay_without_angle import fit_decay_without_angle
from estimation.identification.fits import (
    DrivenRecord,
    fit_mechanics,
)
from estimation.identification.lock_in_decay import fit_lock_in_decay
from estimation.identification.reference_angle import ReferenceAngle, find_reference_angle, with_angle
from estimation.identification.steady_segments import steady_segments
from estimation.identification.swept_motion import fit_swept_motion, lock_in_output
from estimation.identification.swept_record import SweptRecord, has_one_frequency
from estimation.reference import drive_reference
from estimation.slow.response import Response, ResponseFit
from estimation.slow.response_selection import MAX_CONSISTENT_ERROR, prediction_error, select_response_effects
from estimation.slow.steady_tones import frequency_responses
from scanner.arrays import Array
from scanner.clock import on_clock
from scanner.device import DEFAULT_TOLERANCE, Axis, Device
from scanner.recording import Recording
from scanner.signal_check import check_signal
from scanner.stages import Amdm, MotionSensor, Readout

TORQUE_SCALE = (("capacitance", "C0"), ("capacitance", "theta0"), ("drive", "torque_per_volt"), ("mechanics", "J"))
"""Stage and key of the constants that scale the torque, and with it J, k and b; J itself where no torque is known."""

MECHANICS_KEYS = ("J", "b", "k")
"""Constants that the torque scales together."""


class AxisIdentification:
    """Values of one axis, collected from one recording after the other."""

    def __init__(self, name: str, axis: Axis):
        self.name, self.axis = name, axis
        self.found: list[Found] = []  # values of single recordings, before ``conclude`` combines them
        self.values: dict[str, IdentifiedValue] = {}
        self.used: list[str] = []
        self.notes: list[str] = []
        self.responses: list[tuple[Response, ResponseFit]] = []
        self.driven: list[DrivenRecord] = []
        self.swept: list[SweptRecord] = []
        self.gain_tolerance = 0.0  # of the reference angle of driven motion
        self.decays: list[Decay] = []
        self.open_after_decay: str | None = None  # beside J, after a free decay without a reference angle
        self.nonlinear = False
        self.by_torque: dict[str, float] = {}  # standard deviation that the drive's torque adds to a value

    def add(self, recording: Recording) -> None:
        """Use one recording, if it shows this axis."""
        responses = frequency_responses(recording, Device("", {self.name: self.axis}))
        if responses:
            self.used.append(f"{recording.name}: frequency response")
            fit = select_response_effects(responses[0])
            self.responses.append((responses[0], fit))
            self.found.append(Found(recording.name, values_of_mode(fit)))
            self.notes.append(f"{self.name}: J is the nominal one; steady tones determine only k/J and b/J")
            missed = prediction_error(responses[0], fit)
            if missed.error > MAX_CONSISTENT_ERROR * missed.deviation:
                self.notes.append(
                    f"{self.name}: the fitted modes miss the response of {recording.name} by "
                    f"{missed.error / missed.deviation:.1%} (rms), which the intervals do not allow for; see the "
                    "frequency response in the report"
                )
            return
        kind = classify_recording(recording, self.name)
        if kind is None:
            quiet = [each for each in recording.channels if each.endswith(f"_{self.name}")]
            if quiet := [each for each in quiet if not each.startswith(("bias", "drive"))]:
                self.notes.append(
                    f"{self.name}: {recording.name} shows no motion above white noise in {', '.join(quiet)}"
                )
            return
        if kind == UNREFERENCED_DRIVE and not isinstance(self.axis.require_readout(), MotionSensor):
            self.notes.append(
                f"{self.name}: {recording.name} is not used: driven motion behind a capacitive readout needs a "
                f"reference angle; record angle_{self.name} or velocity_{self.name}"
            )
            return
        source = "" if kind in ("rest", UNREFERENCED_DECAY) else self._use_reference(recording, kind)
        self.used.append(f"{recording.name}: {kind}{source}")
        if kind == "rest":
            self._rest(recording)
        elif kind == UNREFERENCED_DECAY:
            channel, readout = recording[f"sense_{self.name}"], self.axis.require_readout()
            found = fit_decay_without_angle(self.axis, channel)
            self._take_ratios(recording, self._with_bias_stiffness(found, self._volt(recording)), readout)

    def _use_reference(self, recording: Recording, kind: str) -> str:
        """Use a free decay or driven motion with a reference; the words that name it if it is no angle channel."""
        if kind == "free decay" and lock_in_only(recording, self.name):
            self._take_ratios(recording, fit_lock_in_decay(recording, self.axis), None)
            return f", from amplitude_{self.name} and phase_{self.name}"
        reference = find_reference_angle(recording, self.axis, DEFAULT_TOLERANCE)
        if reference is None:
            raise AssertionError(f"{kind} without a reference")
        sense_shows_comb = f"sense_{self.name}" in recording and not isinstance(
            self.axis.require_readout(), MotionSensor
        )
        if sense_shows_comb:
            check_signal(recording[f"sense_{self.name}"])
        recording = with_angle(recording, reference)
        names = [f"angle_{self.name}", *[n for n in (f"sense_{self.name}", f"drive_{self.name}") if n in recording]]
        clock, values = on_clock(recording, names)
        angle = values[f"angle_{self.name}"]
        frequency = self.axis.resonance
        if kind == "free decay" and reference.sensor is None:
            self.decays.append(Decay(recording.name, angle, clock.rate, self._volt(recording)))
        elif kind == "free decay":
            measured = replace(self.axis, readout=reference.sensor)
            self._take_ratios(
                recording, fit_decay_without_angle(measured, recording[reference.source]), reference.sensor
            )
        else:
            frequency = self._use_driven(recording, clock.time, angle, values[f"drive_{self.name}"], reference)
        if sense_shows_comb:
            sense = values[f"sense_{self.name}"]
            found = fit_capacitance_profile(self.axis, angle, sense, clock.rate, frequency).values
            self.found.append(Found(recording.name, found))
            if reference.order:
                self.notes.append(
                    f"{self.name}: {reference.source} does not contain the mean angle; theta_th is relative to it"
                )
        return "" if reference.source.startswith("angle") else f", from {reference.source}"

    def _use_driven(
        self, recording: Recording, time: Array, angle: Array, drive: Array, reference: ReferenceAngle
    ) -> float:
        """Keep driven motion for ``conclude``; the frequency of the motion [Hz]."""
        electrostatic = self.axis.require_drive().kind == "electrostatic"
        phase = drive_reference(recording[f"drive_{self.name}"], "half-drive" if electrostatic else "drive")
        rate = 1.0 / float(time[1] - time[0])
        lock_in = lock_in_output(recording, self.axis) if reference.source.startswith("amplitude") else None
        driven = DrivenRecord(angle, drive, phase.frequency, rate)
        self.swept.append(SweptRecord(driven, time, phase, lock_in, recording.name))
        if lock_in is None:
            self.driven += steady_segments(angle, drive, phase.frequency_at(time), rate)
        self.gain_tolerance = max(self.gain_tolerance, reference.gain_tolerance)
        return phase.frequency

    def _with_bias_stiffness(self, found: dict[str, IdentifiedValue], volt: float) -> dict[str, IdentifiedValue]:
        """Widen the interval of k/J by the stiffness of a bias, which depends on the amplitude in rad; with a note."""
        comb, ratio = self.axis.capacitance, found["k_over_J"]
        if comb is None or not volt:
            return found
        stiffness = comb.C0 * (volt / comb.theta0) ** 2 / self.axis.require_mechanics().J  # of small motions
        self.notes.append(
            f"{self.name}: the bias of {volt:.3g} V on the comb stiffens the decay by up to "
            f"{stiffness / ratio.value:.2%}; k/J contains this, and its interval allows for it; record "
            f"angle_{self.name}, with which it is separated"
        )
        return found | {"k_over_J": IdentifiedValue(ratio.value, float(np.hypot(ratio.sd, stiffness)))}

    def _take_ratios(self, recording: Recording, found: dict[str, IdentifiedValue], readout: Readout | None) -> None:
        """Take ratios of the mechanics from a free decay without an angle; ``conclude`` names the values left open."""
        self.found.append(Found(recording.name, found))
        self.open_after_decay = ""
        if isinstance(readout, MotionSensor) and readout is self.axis.readout:
            self.open_after_decay = ", and the gain of the readout"
        elif readout is not None and not isinstance(readout, MotionSensor):
            self.open_after_decay = ", theta0, C0, the gain of the readout, and the sign of the angle"

    def _rest(self, recording: Recording) -> None:
        sense = recording[f"sense_{self.name}"].read()
        variance = float(sense.var(ddof=1))
        if isinstance(self.axis.require_readout(), Amdm):
            found = {"noise_var": IdentifiedValue(variance, variance * np.sqrt(2.0 / sense.size))}
        else:
            found = {"noise_sd": IdentifiedValue(float(np.sqrt(variance)), float(np.sqrt(0.5 * variance / sense.size)))}
        self.found.append(Found(recording.name, found))

    def _volt(self, recording: Recording) -> float:
        """Voltage on the combs during a free decay [V], on which the voltage of a linear actuator is not.

        Raises:
            BadInput: a sample of it is not finite.
        """
        is_linear = self.axis.drive is not None and self.axis.drive.kind == "linear"
        kinds = ("bias",) if is_linear else ("bias", "drive")
        voltages = [recording[f"{kind}_{self.name}"] for kind in kinds if f"{kind}_{self.name}" in recording]
        for voltage in voltages:
            check_signal(voltage, constant_ok=True)
        return sum((float(voltage.read().mean()) for voltage in voltages), start=0.0)

    def conclude(self) -> None:
        """Determine the mechanics: scaled by driven motion, else by a bias during a decay, else by the nominal J."""
        self.values = combine_values([each.values for each in self.found])
        if self.values.keys() <= {"noise_var", "noise_sd"} and self.values and not self.swept:
            self.notes.append(
                f"{self.name}: no recording shows a motion: resonance, Q and all other constants stay as stated; "
                "record a free decay or driven motion"
            )
        if not self.decays and "k_over_J" in self.values:
            J = self.axis.require_mechanics().J
            for key in ("k", "b"):
                ratio = self.values[f"{key}_over_J"]
                self.values[key] = IdentifiedValue(ratio.value * J, ratio.sd * J)
                self.by_torque[key] = ratio.value * self.axis.tolerance.get("J", DEFAULT_TOLERANCE) * J
        axis = self.device_axis()  # with the capacitance as identified
        fits = fit_decays(axis, self.decays)
        if fits:
            others = [each for each in self.found if "k_over_J" in each.values]  # without an angle
            self._take(
                axis,
                lambda each: mechanics_from_decays(
                    each, [*others, *(fits if each is axis else fit_decays(each, self.decays))]
                ),
            )
        self.notes += [f"{self.name}: {note}" for note in contradiction_notes([*self.found, *fits])]
        decay = {key: value for key, value in self.values.items() if key in ("k_over_J", "b_over_J")}
        # in a slow sweep at a high Q, segments of steady amplitude are no steady motion: the decay time is longer
        frequencies = (
            {round(record.frequency) for record in self.driven},
            {round(record.driven.frequency) for record in self.swept},
        )
        several = min(map(len, frequencies)) > 1 and all(has_one_frequency(record) for record in self.swept)
        if several:
            self._take(axis, lambda axis: fit_mechanics(axis, self.driven))
        elif self.swept:
            before = dict(self.values)
            fit = fit_swept_motion(axis, self.swept)
            self._take(axis, lambda each: (fit if each is axis else fit_swept_motion(each, self.swept)).values)
            several = self.values != before
            self.notes += [f"{self.name}: {line}" for line in fit.notes]
        if self.swept and not several:
            self.notes.append(
                f"{self.name}: the driven motion does not determine J; record two or more drive frequencies, or a "
                "sweep through the resonance"
            )
        conflicts = conflict_notes([decay, self.values])
        self.nonlinear = bool(conflicts)
        self.notes += [f"{self.name}: {note}" for note in conflicts]
        if several:
            self._average_ratios(decay)
        elif self.open_after_decay is not None:
            self.notes.append(
                f"{self.name}: without a reference angle a free decay determines k/J and b/J (resonance and Q) only; "
                f"J{self.open_after_decay} stay{'' if self.open_after_decay else 's'} as stated; record "
                f"angle_{self.name}, and driven motion for J"
            )
        if several and self.gain_tolerance:
            for key in MECHANICS_KEYS:
                self.by_torque[key] = float(np.hypot(self.by_torque[key], self.gain_tolerance * self.values[key].value))
        if self.decays and not several and not self.values["J"].sd:
            has_bias = any(each.volt for each in self.decays)
            cause = "the bias has no visible effect, without which " if has_bias else ""
            self.notes.append(
                f"{self.name}: J is the nominal one; {cause}a free decay determines only k/J and b/J, driven motion "
                "also J"
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
                moved = off[name].value - found[name].value if name in off else 0.0
                self.by_torque[name] = float(np.hypot(self.by_torque[name], moved))

    def _average_ratios(self, decay: Mapping[str, IdentifiedValue]) -> None:
        """Average the ratios of driven motion with those of free decays; k and b follow from them and the driven J."""
        values, weights, notes = average_ratios(decay, self.values)
        self.values |= values
        self.notes += [f"{self.name}: {note}" for note in notes]
        for key, weight in weights.items():
            self.by_torque[key] *= weight
            self.by_torque[key[0]] = values[key].value * self.by_torque["J"]

    def marginal(self) -> dict[str, IdentifiedValue]:
        """The values with their complete uncertainty, that of the torque included."""
        return {
            key: replace(value, sd=float(np.hypot(value.sd, self.by_torque.get(key, 0.0))))
            for key, value in self.values.items()
        }

    def device_axis(self) -> Axis:
        """The axis with the identified values."""
        return axis_with_values(self.axis, self.values)
