"""Effects of the readout on the estimated phases, as :mod:`estimation.optics.readout_selection` compares them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from estimation.estimate import estimate
from estimation.optics.measurement import MAX_PHASE_ERROR_RAD, readout_delay_sd
from scanner.arrays import Array
from scanner.device import AXES, Device
from scanner.motion import Motion
from scanner.recording import Recording
from scanner.stages import Amdm
from scanner.terms import NaturalScales, Term, catalogue

READOUT_EFFECTS = ("channel-delay", "readout-lag", "filter-lag", "feedthrough")
"""Effects that shift the phase of the sense signal, and of which the sense signal alone shows little."""


@dataclass(frozen=True)
class ReferencePhase:
    """Phase errors of the motion from the sense signal, measured without the readout.

    Attributes:
        recording: segment that was used.
        device: that the motion was estimated with.
        motion: from the sense signal alone.
        value, sd: phase errors of x and y, averages over the scan, true minus estimated, shape (2,) [rad]; (nan, inf)
            where undetermined.
        part_value, part_sd: the same in parts of the scan, shape (n, 2).
    """

    recording: Recording
    device: Device
    motion: Motion
    value: Array
    sd: Array
    part_value: Array
    part_sd: Array


@dataclass(frozen=True, eq=False)
class ReadoutEffect:
    """An effect of k parameters, linear about one size: it changes the phases by response + slope (x - anchor).

    Attributes:
        term: of the catalogue; None for one that has no term.
        name: of the term, ``"lpf_hz"`` for the calibration of the corner frequencies, or ``"unknown"`` for a phase
            error of one axis without a known cause.
        axis: that it is stated for.
        anchor: shape (k,).
        response: shape (2,) [rad].
        slope: shape (2, k) [rad].
    """

    term: Term | None
    name: str
    axis: str
    anchor: Array
    response: Array
    slope: Array

    @property
    def is_readout(self) -> bool:
        """Whether the effect is a finding of the readout. Others belong to the diagnosis of the optics."""
        return self.name in READOUT_EFFECTS

    @property
    def is_in_device(self) -> bool:
        """Whether the improved device states the effect."""
        return self.is_readout or self.name == "lpf_hz"

    def has_wrong_sign(self, size: Array) -> bool:
        """Whether physics does not allow a size."""
        parameters = self.term.free_parameters if self.term is not None else ()
        return any(p.sign * x < 0.0 for p, x in zip(parameters, size, strict=False))

    def change(self, size: Array) -> Array:
        """Change of both phases at a size, shape (2,) [rad]."""
        return self.response + self.slope @ (size - self.anchor)


def _rates(motion: Motion) -> Array:
    """Angular frequencies of both axes, shape (2,) [rad/s]."""
    return np.array([2.0 * np.pi * np.median(motion.axes[axis].frequency) for axis in AXES])


def natural_scales(reference: ReferencePhase, axis: str) -> NaturalScales:
    """Natural sizes of an axis, as far as the terms of the readout use them."""
    recording, device = reference.recording, reference.device
    motion, mechanics = reference.motion.axes[axis], device.axis(axis).mechanics
    sense = recording["sense" if "sense" in recording else f"sense_{axis}"].read()
    drive = recording[f"drive_{axis}"].read() if f"drive_{axis}" in recording else np.zeros(1)
    actuator = device.axis(axis).drive
    rate = 2.0 * np.pi * float(np.median(motion.frequency))
    return NaturalScales(
        amplitude=float(np.median(motion.amplitude)),
        rate=rate,
        J=mechanics.J if mechanics else 1.0,
        b=mechanics.b if mechanics else 1.0,
        k=mechanics.k if mechanics else 1.0,
        duration=recording.duration,
        voltage_mean=float(drive.mean()),
        voltage_rms=float(drive.std()),
        drive_rate=rate * (2.0 if actuator is not None and actuator.kind == "electrostatic" else 1.0),
        sense_rms=float(np.nanstd(sense)),
        sense_peak=float(np.nanmax(np.abs(sense))),
        readout=device.readout or device.axis(axis).readout,
        two_axes=True,
    )


def candidate_terms(reference: ReferencePhase, scales: Mapping[str, NaturalScales]) -> list[tuple[str, Term]]:
    """Axes and terms that may be added to the device; a shared readout has each effect once."""
    device, known = reference.device, catalogue()
    return [
        (axis, known[effect])
        for effect in READOUT_EFFECTS
        for axis in AXES
        if effect not in device.axis(axis).terms
        and known[effect].applies(device.axis(axis), scales[axis])
        and (device.readout is None or axis == AXES[0] or known[effect].per_axis)
    ]


def calibrations_of(reference: ReferencePhase) -> list[ReadoutEffect]:
    """Corner frequencies of the readout within their tolerance: of both axes together where they share one."""
    rates, device = _rates(reference.motion), reference.device
    tolerance = rates * [readout_delay_sd(device, axis, rate) for axis, rate in zip(AXES, rates, strict=True)]
    columns = [-tolerance] if device.readout is not None else list(-np.diag(tolerance))
    return [
        ReadoutEffect(None, "lpf_hz", axis, np.zeros(1), np.zeros(2), column[:, None])
        for axis, column in zip(AXES, columns, strict=False)
        if column.any()
    ]


def effects_beside_the_readout(scales: Mapping[str, NaturalScales]) -> list[ReadoutEffect]:
    """A late intensity, and a phase error of one axis without a known cause."""
    delay = catalogue()["intensity-delay"]
    size = delay.parameters[0].scale(scales["x"])
    late = np.array([[-size * scales[axis].rate] for axis in AXES])
    zero = np.zeros(1), np.zeros(2)
    unknown = [
        ReadoutEffect(None, "unknown", axis, *zero, MAX_PHASE_ERROR_RAD * row[:, None])
        for axis, row in zip(AXES, np.eye(2), strict=True)
    ]
    return [ReadoutEffect(delay, delay.effect, "x", *zero, late), *unknown]


def term_values(term: Term, x: Array, scales: NaturalScales) -> dict[str, float]:
    """Physical values of a term's parameters."""
    return dict(zip((p.name for p in term.parameters), map(float, term.values(list(x), scales)), strict=True))


def phase_change(reference: ReferencePhase, device: Device) -> Array:
    """Change of the estimated phases, averages over the scan, with another device, shape (2,) [rad]."""
    channels = {name: each for name, each in reference.recording.channels.items() if name != "intensity"}
    motion = estimate(replace(reference.recording, channels=channels), device, reference.motion.estimator)
    changes = []
    for axis in AXES:
        old, new = reference.motion.axes[axis], motion.axes[axis]
        change = np.interp(old.time, new.time, new.phase) - old.phase
        changes.append(np.mean(change - np.pi * np.round(np.median(change) / np.pi)))  # the sign may be ambiguous
    return np.array(changes)


def with_readout_effects(
    device: Device, effects: Sequence[ReadoutEffect], sizes: Sequence[Array], scales: Mapping[str, NaturalScales]
) -> Device:
    """The device with the terms of the effects of the readout, and with calibrated corner frequencies."""
    for effect, size in zip(effects, sizes, strict=True):
        if effect.name == "lpf_hz":
            device = _with_corners(device, effect.axis, 1.0 + device.tolerance(effect.axis, "lpf_hz") * float(size[0]))
        elif effect.is_readout and effect.term is not None:
            values = term_values(effect.term, size, scales[effect.axis])
            device = device.with_terms({effect.axis: {effect.name: values}})
    return device


def _with_corners(device: Device, axis: str, factor: float) -> Device:
    """The device with the corner frequencies of the readout of an axis, or of the shared one, times a factor."""
    readout = device.sensed_axis(axis).readout
    if not isinstance(readout, Amdm):
        return device
    readout = replace(readout, lpf_hz=tuple(factor * corner for corner in readout.lpf_hz))
    if device.readout is not None:
        return replace(device, readout=readout)
    return replace(device, axes={**device.axes, axis: replace(device.axes[axis], readout=readout)})


def estimator_variance(motion: Motion) -> Array:
    """Mean variance of the estimated phases, shape (2,) [rad²]."""
    return np.array([np.nanmean(np.square(motion.axes[axis].phase_sd)) for axis in AXES])
