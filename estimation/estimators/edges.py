"""Phase from the edges of a detector that the beam crosses."""

from __future__ import annotations

from estimation.estimators.estimator import Estimator
from scanner.device import Device
from scanner.motion import Motion
from scanner.recording import Recording


def run(recording: Recording, device: Device) -> Motion:
    from estimation.sync.edge_estimator import estimate_from_edges

    return estimate_from_edges(recording, device)


ESTIMATOR = Estimator(
    name="edges",
    summary="phase and frequency from edge times by a smoother, with the detector's asymmetry as a parameter",
    needs="`sync_x`, `sync_y`; an axis without edges needs a position sensor",
    use_when="a photodiode or a sync output is all that shows the motion",
    run=run,
    source="Rauch, Tung and Striebel 1965",
    is_model_based=False,
)
"""From edge times to a motion."""
