"""Motion from the drive, with phases measured in the picture."""

from __future__ import annotations

from estimation.estimators.estimator import Estimator
from scanner.device import Device
from scanner.motion import Motion
from scanner.recording import Recording


def run(recording: Recording, device: Device) -> Motion:
    from estimation.frequency_motion import frequency_motion, is_motion_computable

    if not is_motion_computable(recording, device):
        return frequency_motion(recording, device)
    from estimation.tracker.drive_only import track_drive_only

    return track_drive_only(recording, device)


ESTIMATOR = Estimator(
    name="picture",
    summary="averaged dynamics under the drive; a reconstruction measures the remaining phase errors in the picture",
    needs="an intensity; drives, and drive and mechanics of the device; or drive frequencies and field alone",
    use_when="no sense signal was recorded",
    run=run,
    source="docs/explanation/image_phase.md",
)
