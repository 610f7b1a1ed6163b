"""Angles as a sensor measured them."""

from __future__ import annotations

from estimation.estimators.estimator import Estimator
from scanner.device import Device
from scanner.motion import Motion
from scanner.recording import Recording


def run(recording: Recording, device: Device) -> Motion:
    from estimation.filters.baselines import estimate_from_sensor

    return estimate_from_sensor(recording, device)


ESTIMATOR = Estimator(
    name="sensor",
    summary="angles as the angle channels or the position readouts give them, without a filter",
    needs="an angle channel, a position readout, or `amplitude_x` with `phase_x`, of every axis",
    use_when="a position sensor whose noise is smaller than a pixel, or a motion that is not a sine",
    run=run,
    source="none",
    is_model_based=False,
)
