"""Notes of a reconstruction: what a reader of the picture has to know, a line each."""

from __future__ import annotations

import numpy as np

from recon.imaging.picture import Picture
from recon.preparation import PreparedRecording
from recon.quality.clock_jumps import longest_segment
from scanner.device import AXES
from scanner.motion import Motion
from scanner.recording import Recording

MAX_OUTSIDE_FRACTION = 0.05
"""Fraction of the samples outside the field of view from which a note says so. A field that the amplitude fills loses
samples at the turning points only."""


def describe_outside(picture: Picture, motion: Motion) -> list[str]:
    """A warning if many samples fell outside the field of view, with the amplitude and the half angle of each axis."""
    share = picture.outside / max(picture.outside + int(picture.coverage.sum()), 1)
    if share < MAX_OUTSIDE_FRACTION:
        return []
    grid = picture.grid
    half = dict(zip(AXES, grid.reported_half_angles, strict=True))
    sizes = ", ".join(
        f"{name}: amplitude {grid.angle_scale * np.max(motion.axes[name].amplitude):.4g} rad, "
        f"half angle {half[name]:.4g} rad"
        for name in AXES
    )
    what = f"{share:.0%} of the samples lie outside the field of view"
    return [f"{what} ({sizes}; {grid.angle} angles); check [scan] of the device"]


def describe_ambiguous_signs(motion: Motion) -> list[str]:
    """A line for each axis of which the recording does not determine the sign."""
    return [
        f"the sign of {axis} is ambiguous: the picture may be mirrored; --flip-{axis} turns it"
        for axis in AXES
        if motion.axes[axis].sign == "ambiguous"
    ]


def describe_clock_jumps(recording: Recording, prepared: PreparedRecording) -> str:
    """The note on a recording of which only the longest segment between clock jumps is used."""
    begin, end = longest_segment(recording, prepared.clock_jumps)
    return (
        f"a phase jumps as if samples were lost: the longest segment between such jumps is used, {begin:.6g} s to "
        f"{end:.6g} s; cut the recording at the jumps to reconstruct the rest"
    )
