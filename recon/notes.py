"""Notes of a reconstruction: what a reader of the picture has to know, a line each."""

from __future__ import annotations

from recon.preparation import PreparedRecording
from recon.quality.clock_jumps import longest_segment
from scanner.device import AXES
from scanner.motion import Motion
from scanner.recording import Recording


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
