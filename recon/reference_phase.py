"""Phase of the mirror by the picture, as a reference for the diagnosis of the readout."""

from __future__ import annotations

import numpy as np

from estimation.optics.readout_effects import ReferencePhase
from recon.imaging.scan_phase.readout_phase import measured_phase_error
from recon.pipeline import estimate_motion
from recon.steps.phase_and_drift import correct_readout_phase
from recon.steps.preparation import prepare
from recon.steps.reconstruction import Options
from scanner.device import AXES, Device
from scanner.recording import Recording


def measure_reference_phase(recording: Recording, device: Device) -> ReferencePhase | None:
    """Measure the phase errors that the self-crossings show in the motion from the sense signal.

    Args:
        recording: with an intensity.
        device: to estimate the motion with.

    Returns:
        The phase errors; None if the picture determines none, or the motion does not come from a sense signal.
    """
    if not any(name.startswith("sense") for name in recording.channels):
        return None
    prepared = prepare(recording, device)
    sensed = estimate_motion(prepared, Options())
    corrected = correct_readout_phase(sensed, Options())
    found = {axis: error for axis, error in corrected.readout_phase.items() if error.measured}
    errors = corrected.phase_errors
    if not found or not errors:
        return None
    value = np.array([found[axis].value if axis in found else np.nan for axis in AXES])
    sd = np.array([found[axis].sd if axis in found else np.inf for axis in AXES])
    parts = [
        measured_phase_error(errors, column, sensed.motion.axes[axis], corrected.motion.axes[axis])
        for column, axis in enumerate(AXES)
    ]
    part_value, part_sd = (np.stack([part[i] for part in parts], axis=1) for i in (1, 2))
    return ReferencePhase(prepared.recording, device, sensed.motion, value, sd, part_value, part_sd)
