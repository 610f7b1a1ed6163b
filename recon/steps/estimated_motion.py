"""The motion that a reconstruction has estimated, between its steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from estimation.optics.correction import beam_motion
from recon.imaging.intensity_drift import IntensityDrift
from recon.imaging.picture import Grid
from recon.imaging.sample_motion.correction import relative_to_sample
from recon.imaging.sample_motion.rigid_motion import SampleMotion
from recon.imaging.scan_phase.phase_agreement import Contradiction
from recon.imaging.scan_phase.phase_error import PhaseError
from recon.imaging.scan_phase.readout_phase_model import ReadoutPhase
from recon.steps.preparation import PreparedRecording
from scanner.arrays import Array
from scanner.motion import Motion


@dataclass(frozen=True)
class EstimatedMotion:
    """The motion of a prepared recording, and the pixels that it is mapped to.

    Attributes:
        prepared: the recording.
        motion: of the mirror.
        grid: the pixels over the device's field of view, else over the range of the motion.
        field_notes, motion_notes: what a reader has to know of the field and of the motion, a line each.
        phase_errors: of the motion, as the picture shows them; None where they were not measured.
        contradictions: axes whose motion the picture contradicts.
        clock_limits: a line on a clock error of the intensity that was not removed.
        readout_phase, estimator_phase_sd, intensity_drift, sample_motion: as in ``Reconstruction``.
    """

    prepared: PreparedRecording
    motion: Motion
    grid: Grid
    field_notes: list[str]
    motion_notes: list[str]
    phase_errors: list[PhaseError] | None = None
    contradictions: Sequence[Contradiction] = ()
    clock_limits: Sequence[str] = ()
    readout_phase: Mapping[str, ReadoutPhase] = field(default_factory=dict)
    estimator_phase_sd: Mapping[str, Array] = field(default_factory=dict)
    intensity_drift: Sequence[IntensityDrift | None] = ()
    sample_motion: SampleMotion | None = None

    @property
    def beam(self) -> Motion:
        """Motion of the beam over the sample: the mirror's, corrected for the optics and for a motion of the sample."""
        beam = beam_motion(self.motion, self.prepared.device, self.prepared.origin)
        return relative_to_sample(beam, self.sample_motion, self.grid)
