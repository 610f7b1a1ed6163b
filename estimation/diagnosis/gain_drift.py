"""The confounder that a single free decay cannot exclude: a gain of the readout that drifts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from estimation.device_fit.data import Run, readout_of
from estimation.device_fit.parameters import Candidate
from scanner.device import Device
from scanner.stages import MotionSensor

AMPLITUDE_DAMPING = ("cubic-damping", "quadratic-drag", "coulomb-friction", "damping-drift")
"""Effects that change the rate of decay over a ringdown, as a gain that drifts does."""

GAIN_DRIFT_ADVICE = (
    "gain-drift: in a free decay, amplitude is a function of time: a gain that drifts may fit; record another amplitude"
)


def may_be_gain_drift(runs: Sequence[Run], device: Device, candidate: Candidate) -> bool:
    """Whether a gain that drifts explains the same change of a decay: one ringdown, seen by a sensor of motion only.

    Harmonics of a capacitive signal, an angle channel, a drive or another amplitude exclude it.
    """
    recorded = [run for run in runs if candidate.axis in run.inputs]
    outputs = [output for run in recorded for output in run.outputs if candidate.axis in output.axes]
    return (
        candidate.term.effect in AMPLITUDE_DAMPING
        and len(recorded) == len(outputs) == 1
        and isinstance(readout_of(device, candidate.axis), MotionSensor)
        and outputs[0].kind == "sense"
        and not np.any(recorded[0].inputs[candidate.axis].voltage)
    )
