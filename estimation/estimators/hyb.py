"""Extended Kalman filter with threshold crossings."""

from __future__ import annotations

from estimation.estimators.estimator import Estimator
from scanner.device import Device
from scanner.motion import Motion
from scanner.recording import Recording


def run(recording: Recording, device: Device) -> Motion:
    from estimation.filters.hybrid import estimate_hybrid

    return estimate_hybrid(recording, device)


ESTIMATOR = Estimator(
    name="hyb",
    summary="extended Kalman filter that also measures the angle at each crossing of the threshold angle",
    needs="sense channels with transimpedance readouts; drive, mechanics, capacitance and readout of the device",
    use_when="a transimpedance readout, whose signal gives the rate well and the angle only at crossings",
    run=run,
    source="chen2019, table I",
)
