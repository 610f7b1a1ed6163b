"""Candidate terms, and the parameters of a model with their priors."""

from __future__ import annotations

from dataclasses import dataclass

from estimation.device_fit.data import readout_of
from scanner.device import Device
from scanner.stages import Amdm, MotionSensor, Readout
from scanner.terms import Parameter, Term

REFERENCE_GAIN_RELATIVE_SD = 0.02
"""Prior relative standard deviation of the gain of a reference angle: the default tolerance of the device file."""

OFFSET_RELATIVE_SD = 0.05
"""Prior standard deviation of an unstated offset in standard deviations of the signal. An offset of a well-adjusted
readout is a few per cent of the signal."""


@dataclass(frozen=True)
class Candidate:
    """A term on one axis, and the channel on which it acts.

    Attributes:
        cost: -2 log of the prior probability of its free parameters, where they were chosen among others.
    """

    term: Term
    axis: str
    channel: str
    cost: float = 0.0

    @property
    def key(self) -> str:
        """Unique name: ``x.cubic-stiffness``, ``x.channel-delay:angle``."""
        suffix = "" if self.channel == self.term.channels[0] else f":{self.channel}"
        return f"{self.axis}.{self.term.effect}{suffix}"


@dataclass(frozen=True)
class ParameterSpec:
    """One parameter of a model, in prior standard deviations: value = centre + scale x, or by its term's parameter.

    Attributes:
        kind: ``"nominal"``, ``"term"``, ``"start"``, ``"hidden"``, ``"gain"`` or ``"additive"``.
        owner: axis, key of the candidate, or channel.
        name: of the physical value (``"mechanics.k"``, ``"k3"``, ...).
        run: index of its recording, -1 for all.
        precision: 1 / variance of the prior of x, 1 for a standard normal prior.
        parameter: of the term, None for other kinds.
    """

    kind: str
    owner: str
    name: str
    run: int = -1
    precision: float = 1.0
    parameter: Parameter | None = None


def nominal_parameters(device: Device, axis: str) -> list[tuple[str, float | tuple[float, ...], float]]:
    """Uncertain nominal values of an axis: (``stage.key``, nominal value, relative tolerance)."""
    device_axis = device.axis(axis)
    readout = readout_of(device, axis)
    shared = device.readout is not None and axis != next(iter(device.axes))
    parameters: list[tuple[str, float | tuple[float, ...], float]] = []
    stages: list[tuple[str, object, tuple[str, ...]]] = [
        ("mechanics", device_axis.mechanics, ("J", "b", "k")),
        (
            "capacitance",
            device_axis.capacitance,
            ("C0", "theta0", "theta_th", *(("Cb",) if isinstance(readout, Amdm) else ())),
        ),
        ("drive", device_axis.drive, ("torque_per_volt",)),
        ("readout", None if shared else readout, _readout_keys(readout)),
    ]
    for stage, table, keys in stages:
        for key in keys:
            value = getattr(table, key, None)
            tolerance = device.tolerance(axis, key)
            if value and tolerance > 0.0:
                parameters.append((f"{stage}.{key}", value, tolerance))
    return parameters


def _readout_keys(readout: Readout | None) -> tuple[str, ...]:
    if readout is None:
        return ()
    if isinstance(readout, MotionSensor):
        return "gain", "offset"
    return ("a_cir", "b_cir", "lpf_hz") if isinstance(readout, Amdm) else ("R_s",)
