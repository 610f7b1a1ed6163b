"""Confounders that a single free decay cannot exclude: in it, amplitude is a function of time."""

from __future__ import annotations

from collections.abc import Sequence

from estimation.device_fit.data import Run, readout_of
from estimation.device_fit.parameters import Candidate
from estimation.device_fit.undriven import is_moved_by_drive
from scanner.device import Device
from scanner.stages import MotionSensor

AMPLITUDE_DAMPING = ("cubic-damping", "quadratic-drag", "coulomb-friction")
"""Effects by which the rate of decay depends on amplitude."""

AMPLITUDE_STIFFNESS = ("cubic-stiffness", "quintic-stiffness", "gravity-stiffness")
"""Effects by which the frequency of a decay depends on amplitude."""

CHANGES_IN_TIME = ("gain-drift", "damping-drift")
"""Effects by which a decay changes with time. Either may fit where the rate depends on amplitude, and conversely."""


def decay_advice(confounders: Sequence[str]) -> str:
    """The measurement that separates confounders of a free decay from what was found."""
    names = ", ".join(confounders)
    return f"{names}: in a free decay, amplitude is a function of time, so that both may fit; record another amplitude"


def confounders_in_one_decay(effect: str, gain_is_known: bool = False) -> tuple[str, ...]:
    """Effects that may explain the same change of one decay as ``effect``.

    Damping that drifts has ``cubic-damping``, the simplest law of amplitude, as confounder, and a resonance that drifts
    ``cubic-stiffness``.

    Args:
        gain_is_known: whether a gain that drifts would show otherwise.
    """
    confounders: tuple[str, ...] = ()
    if effect in AMPLITUDE_DAMPING:
        confounders = CHANGES_IN_TIME
    elif effect == "damping-drift":
        confounders = ("gain-drift", "cubic-damping")
    elif effect in AMPLITUDE_STIFFNESS:
        confounders = ("resonance-drift",)
    elif effect == "resonance-drift":
        confounders = ("cubic-stiffness",)
    return tuple(each for each in confounders if not (gain_is_known and each == "gain-drift"))


def decay_confounders(runs: Sequence[Run], device: Device, candidate: Candidate) -> tuple[str, ...]:
    """Confounders of a candidate, where one ringdown of its axis is all that was recorded.

    A drive that moves the axis or another amplitude excludes them, and harmonics of a capacitive signal or an angle
    channel a gain that drifts.
    """
    recorded = [run for run in runs if candidate.axis in run.inputs]
    if len(recorded) != 1 or is_moved_by_drive(recorded[0], device, candidate.axis):
        return ()
    outputs = [output for output in recorded[0].outputs if candidate.axis in output.axes]
    motion_only = len(outputs) == 1 and outputs[0].kind == "sense"
    gain_is_known = not (motion_only and isinstance(readout_of(device, candidate.axis), MotionSensor))
    return confounders_in_one_decay(candidate.term.effect, gain_is_known)
