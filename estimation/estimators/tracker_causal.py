"""Filter on phase and amplitude."""

from __future__ import annotations

from estimation.estimators.estimator import Estimator
from scanner.device import Device
from scanner.motion import Motion
from scanner.recording import Recording


def run(recording: Recording, device: Device) -> Motion:
    from estimation.tracker import track

    return track(recording, device, causal=True)


ESTIMATOR = Estimator(
    name="tracker-causal",
    summary="the tracker without smoothing: each moment is estimated from earlier samples only",
    needs="as tracker",
    use_when="a motion that has to be known while the scan runs; half a block of latency",
    run=run,
    source="docs/explanation/tracker.md",
    treats_clipping=True,
)
