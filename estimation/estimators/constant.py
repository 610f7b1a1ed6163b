"""Constant phase and amplitude."""

from __future__ import annotations

from estimation.estimators.estimator import Estimator
from scanner.device import Device
from scanner.motion import Motion
from scanner.recording import Recording


def run(recording: Recording, device: Device) -> Motion:
    from estimation.filters.baselines import estimate_constant

    return estimate_constant(recording, device)


ESTIMATOR = Estimator(
    name="constant",
    summary="phase and amplitude of the first cycles, held for the whole recording",
    needs="a sense channel; drive, mechanics and readout of the device",
    use_when="a baseline: what a calibration before the scan gives",
    run=run,
    source="common practice",
)
