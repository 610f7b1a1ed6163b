"""Extended Kalman filter."""

from __future__ import annotations

from estimation.estimators.estimator import Estimator
from scanner.device import Device
from scanner.motion import Motion
from scanner.recording import Recording


def run(recording: Recording, device: Device) -> Motion:
    from estimation.filters.run import estimate_with_filter

    return estimate_with_filter(recording, device, "ekf")


ESTIMATOR = Estimator(
    name="ekf",
    summary="extended Kalman filter on angle and rate, sample by sample",
    needs="a sense channel, the drive; drive, mechanics, readout of the device; capacitance for a capacitive readout",
    use_when="a comparison with the paper, or a filter that runs sample by sample",
    run=run,
    source="chen2020, algorithm 1",
)
