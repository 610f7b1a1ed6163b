"""Options and result of a reconstruction."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from recon.evaluation import AxisEvaluation, Truth
from recon.imaging import blur
from recon.imaging.intensity_drift import IntensityDrift
from recon.imaging.intensity_drift_equations import DriftKind
from recon.imaging.picture import Picture
from recon.imaging.picture_kinds.picture_estimate import PictureKind
from recon.imaging.pixel_noise import SampleNoise
from recon.imaging.sample_motion.rigid_motion import SampleMotion
from recon.imaging.scan_phase.phase_error import PhaseError
from recon.imaging.scan_phase.readout_phase_model import ReadoutPhase
from recon.quality.defects import Defect
from recon.steps.preparation import DeviceSource
from scanner.arrays import Array
from scanner.channel import Channel
from scanner.motion import Motion


@dataclass(frozen=True)
class Options:
    """Options of a reconstruction.

    Attributes:
        device: in place of the recording's own: a device, the path of its TOML file, or the name of a device that
            comes with the program.
        estimator: name of an estimator; None chooses one by the channels that were recorded.
        pixels: width and height of the picture.
        p: tolerated displacement [px], for the phase bound p/m.
        flips: axes whose sign is inverted.
        picture: how a pixel's value is found: "mean" of its samples, "kernel"-weighted mean with the samples around, or
            "posterior" mean under a smoothness prior.
        fill_radius: unvisited pixels at most so many rows and columns from a visited one are filled and marked as
            filled, thus holes up to twice as wide wholly; 0 fills none.
        spot: standard deviation of the beam's spot [px] for the account of the blur. A recording does not contain it.
        allow_outside: make the picture although most samples lie outside the field of view.
        sense_only: keep the phase of the estimator, without the correction by the phase error that the picture shows.
        intensity_drift: drift of the detector to remove, "offset" or "gain"; None removes none.
        sample_motion: estimate the motion of the sample and remove it.
        frames: number of frames to write; None for none.
        frame_time: duration of a frame to write [s], instead of ``frames``.
        z_stack: write a slice for each position at which ``position_z`` rests, instead of frames.
        z_step: thickness of the slices [m]: the samples are sorted by ``position_z``, whether it rests or not.
        independent_frames: frames of posterior pictures use no samples of earlier frames.
        zarr: write the frames as OME-Zarr too.
        movie: write the frames as a movie too, ``"mp4"`` or ``"gif"``.
    """

    device: DeviceSource | None = None
    estimator: str | None = None
    pixels: tuple[int, int] = (400, 400)
    p: float = 1.0
    flips: Mapping[str, bool] = field(default_factory=dict)
    picture: PictureKind = "mean"
    fill_radius: int = 0
    spot: float | None = None
    sense_only: bool = False
    allow_outside: bool = False
    intensity_drift: DriftKind | None = None
    sample_motion: bool = False
    frames: int | None = None
    frame_time: float | None = None
    z_stack: bool = False
    z_step: float | None = None
    independent_frames: bool = False
    zarr: bool = False
    movie: str | None = None

    @property
    def wants_stack(self) -> bool:
        """Whether slices by z are to be written."""
        return self.z_stack or self.z_step is not None

    @property
    def wants_frames(self) -> bool:
        """Whether frames or slices are to be written."""
        return self.frames is not None or self.frame_time is not None or self.wants_stack

    @property
    def undo_lag(self) -> bool:
        """Whether the low-pass of a slow detector is undone: not in means, in which electronic noise would grow."""
        return self.picture != "mean"


@dataclass(frozen=True)
class Reconstruction:
    """The picture of a recording, its motion, and the assessment of both.

    Attributes:
        motion: of the mirror.
        beam: motion of the beam over the sample, which the picture is made with; relative to a sample that moves.
        picture: intensity and sample count of each pixel.
        picture_kind: as ``picture`` in ``Options``.
        picture_sd: standard deviation of each pixel, of the shape of the picture; NaN where it is unknown.
        data_share: weight of the pixel's own samples in its value; None for a picture of means.
        resolution_px: distance between independent values [px]; None for a picture of means.
        sample_noise: noise of a sample by detector; None where too few pixels were visited twice to measure it.
        amplitude_calibration: relative standard deviation of the amplitude by the calibration, by axis; None where
            nothing calibrates it.
        p, spot: as in ``Options``.
        phase_errors: phase error of each time slice that forward and backward half-periods show.
        readout_phase: phase error of the readout that the picture showed and that was removed, by axis; without the
            axes of which nothing determined it.
        estimator_phase_sd: standard deviation of the phase by the estimator alone, by axis, shape (n,) [rad]: without
            the uncertainty of the readout's phase, which that of ``motion`` contains. Empty where no readout's phase
            was searched.
        intensity_drift: drift that was removed, by detector; empty unless it was asked for.
        sample_motion: motion of the sample; None unless it was asked for and can be determined.
        evaluation: estimate against the truth, by axis; empty without a truth.
        truth: of a simulation; None without one.
        defects: clock jumps, gaps, clipping and missing parts of the recording.
        unlocated_samples: number of samples left out because the mirror's angle is unknown there.
        affected: pixels that hold samples from defects, shape (height, width).
        limits: reasons why the picture does not show the scene, or only a part, a line each.
        notes: what else a reader has to know, a line each.
        clock_doubted: whether a note doubts the sample rate of the intensity. The standard deviations of the phase are
            those at a right one.
        intensity: the channel that was gridded: the segment in use, corrected for the device's optics.
        position_z: position of the objective or the stage; None where it was not recorded.
        name: of the recording.
        seconds: computing time without writing [s].
    """

    motion: Motion
    beam: Motion
    picture: Picture
    picture_kind: PictureKind
    picture_sd: NDArray[np.float32]
    data_share: NDArray[np.float32] | None
    resolution_px: float | None
    sample_noise: Sequence[SampleNoise | None]
    amplitude_calibration: Mapping[str, float | None]
    p: float
    spot: float | None
    phase_errors: list[PhaseError]
    readout_phase: Mapping[str, ReadoutPhase]
    estimator_phase_sd: Mapping[str, Array]
    intensity_drift: Sequence[IntensityDrift | None]
    sample_motion: SampleMotion | None
    evaluation: Mapping[str, AxisEvaluation]
    truth: Truth | None
    defects: list[Defect]
    unlocated_samples: int
    affected: NDArray[np.bool_]
    limits: list[str]
    notes: list[str]
    intensity: Channel
    position_z: Channel | None
    name: str
    clock_doubted: bool = False
    seconds: float = 0.0

    def __repr__(self) -> str:
        lines = [f"Reconstruction of {self.name!r}: {self.picture!r}", repr(self.motion)]
        lines += [
            f"  {axis}: phase error against the truth {np.degrees(error.phase_rmse):.4f}° rms"
            for axis, error in self.evaluation.items()
        ]
        return "\n".join([*lines, *(f"  note: {note}" for note in [*self.limits, *self.notes])])

    @property
    def duration(self) -> float:
        """Length of the intensity [s]."""
        return self.intensity.size / self.intensity.sample_rate

    def pixels(self, axis: str) -> int:
        """Pixels of the picture along an axis."""
        return self.picture.grid.width if axis == "x" else self.picture.grid.height

    def phase_bound(self, axis: str) -> float:
        """p/m of an axis [rad] (chen2020 eq 7)."""
        return blur.phase_bound(self.p, self.pixels(axis) / 2)
