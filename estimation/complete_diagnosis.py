"""The complete diagnosis of a device: motion and readout against the nominal device, then the optics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from estimation.diagnosis.diagnose import Diagnosis, diagnose, nominal_device
from estimation.diagnosis.selection import Progress
from scanner.device import Device
from scanner.recording import Recording


def diagnose_with_optics(
    recordings: Sequence[Recording], device: Device | None = None, progress: Progress = lambda text: None
) -> Diagnosis:
    """Diagnose drive, mechanics and readout of all recordings together, then the optics of each that has an intensity.

    A device that states no mechanics predicts no motion. If its recordings have an intensity, only the optics are
    diagnosed.

    Args:
        recordings: of one device.
        device: the nominal one; None takes that of the first recording.
        progress: called with one line of text at every step.

    Raises:
        BadInput: no device, or a recording that cannot be compared with it.
    """
    nominal = nominal_device(recordings, device)
    with_intensity = [recording for recording in recordings if "intensity" in recording]
    if not with_intensity or any(axis.mechanics for axis in nominal.axes.values()):
        diagnosis = diagnose(recordings, nominal, progress)
    else:
        diagnosis = Diagnosis("consistent", (), None, nominal, None)
    for recording in with_intensity:
        if set(diagnosis.device.axes) == {"x", "y"}:
            progress(f"optics of {recording.name}")
            diagnosis = add_optics(diagnosis, recording)
    return diagnosis


def add_optics(diagnosis: Diagnosis, recording: Recording) -> Diagnosis:
    """Return the diagnosis with the optical effects that the picture of one recording shows.

    The motion is estimated with the improved device of ``diagnosis``, so that its terms are not diagnosed again.
    """
    from estimation.estimate import estimate
    from estimation.optics.correction import beam_motion, correct_intensity
    from estimation.optics.selection import diagnose_optics

    device = diagnosis.device
    corrected = correct_intensity(recording, device)
    motion = beam_motion(estimate(corrected, device), device, corrected.start)
    optics = diagnose_optics(motion, corrected["intensity"], device)
    axes = {
        name: replace(axis, terms={**axis.terms, **optics.terms.get(name, {})}) for name, axis in device.axes.items()
    }
    return replace(
        diagnosis,
        verdict="mismatch" if optics.findings else diagnosis.verdict,
        findings=(*diagnosis.findings, *optics.findings),
        device=replace(device, axes=axes),
        optics=(*diagnosis.optics, {"recording": recording.name, "effects": optics.to_json()}),
    )
