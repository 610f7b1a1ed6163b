"""Unscented Kalman filter on the phase of a sine."""

from __future__ import annotations

from estimation.estimators.estimator import Estimator
from scanner.device import Device
from scanner.motion import Motion
from scanner.recording import Recording


def run(recording: Recording, device: Device) -> Motion:
    from estimation.filters.sine_ukf import estimate_sine_ukf

    return estimate_sine_ukf(recording, device)


ESTIMATOR = Estimator(
    name="sine-ukf",
    summary="unscented Kalman filter on the phase of a sine of constant amplitude",
    needs="an angle channel or a position readout of every axis",
    use_when="a noisy position sensor and a motion of constant amplitude",
    run=run,
    source="wang2019, eq 14 and 16",
    is_model_based=False,
)
