"""Diagnosis of recordings with their pictures: what ``estimation`` fits, and what only a picture shows."""

from __future__ import annotations

from collections.abc import Sequence

from estimation.complete_diagnosis import diagnose_with_optics
from estimation.diagnosis.diagnose import Diagnosis
from estimation.diagnosis.selection import Progress
from recon.reference_phase import measure_reference_phase
from recon.steps.sign_after_rest import follow_signs
from scanner.device import Device
from scanner.recording import Recording


def diagnose_recordings(recordings: Sequence[Recording], device: Device | None, progress: Progress) -> Diagnosis:
    """Diagnose recordings; the picture gives the phase independently of the readout, and the sign after a rest.

    Args:
        recordings: of one device.
        device: the nominal one; None takes that of the first recording.
        progress: called with one line of text at every step.

    Raises:
        BadInput: no device, or a recording that cannot be compared with it.
    """
    return diagnose_with_optics(recordings, device, progress, measure_reference_phase, follow_signs)
