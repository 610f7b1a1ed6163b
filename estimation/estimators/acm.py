"""Process model without measurements."""

from __future__ import annotations

from estimation.estimators.estimator import Estimator
from scanner.device import Device
from scanner.motion import Motion
from scanner.recording import Recording


def run(recording: Recording, device: Device) -> Motion:
    from estimation.filters.run import estimate_with_filter

    return estimate_with_filter(recording, device, "acm")


ESTIMATOR = Estimator(
    name="acm",
    summary="process model alone, started from the first cycles; no measurement is used",
    needs="a sense channel, the drive; drive, mechanics, capacitance and readout of the device",
    use_when="a baseline: how far the nominal model alone predicts the motion",
    run=run,
    source="chen2020, ACM of table III",
)
