"""Smoother on phase and amplitude."""

from __future__ import annotations

from estimation.estimators.estimator import Estimator
from scanner.device import Device
from scanner.motion import Motion
from scanner.recording import Recording


def run(recording: Recording, device: Device) -> Motion:
    from estimation.tracker import track

    return track(recording, device)


def resume(recording: Recording, device: Device, previous: Motion) -> Motion:
    from estimation.tracker import track

    return track(recording, device, previous=previous)


ESTIMATOR = Estimator(
    name="tracker",
    summary="block demodulation and a Rauch-Tung-Striebel smoother on the averaged dynamics of phase and amplitude",
    needs="a sense channel; mechanics and readout of the device, the drive if there is one",
    use_when="the default with a sense signal: the smallest phase error, at the Cramér-Rao bound",
    run=run,
    source="docs/explanation/tracker.md",
    treats_clipping=True,
    resume=resume,
)
