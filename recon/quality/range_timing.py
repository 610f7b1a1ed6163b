"""Whether the ranges belong to the mirror's angles: ranges of one place, passed forward and backward, have to agree.

A range that is stored late is located at an angle that the mirror has left. This is determined where the scene has
relief and the phase is off by more than the registration reaches (15°); a smaller delay is removed with the phase error
of the readout where the ranges, or an intensity on their clock, determine it. A plane wall square to the beam, and a
scene equal to its mirror image, determine no delay.
"""

from __future__ import annotations

from recon.imaging.scan_phase.phase_agreement import find_contradictions
from recon.imaging.scan_phase.start_shift import describe_start_shift
from scanner.channel import Channel
from scanner.motion import Motion
from scanner.recording import Recording


def describe_range_timing(recording: Recording, beam: Motion, ranges: Channel) -> list[str]:
    """Lines on ranges that contradict the motion; none where they agree or determine nothing.

    Args:
        recording: with unmodified channels.
        beam: motion whose angles are on the clock of ``ranges``.
        ranges: distance along the beam, shape (n,) [m]; nan where nothing returned.
    """
    found, _ = find_contradictions(beam, ranges)
    if lines := describe_start_shift(recording, beam, found, "range"):
        return [f"{line}; the points are displaced until then" for line in lines]
    return [
        f"range: forward and backward half-periods of {each.axis} disagree (correlation {each.agreement:.2f}, and "
        f"{each.best:.2f} at another phase of {each.axis}), so that the points are displaced: check start and "
        "sample_rate of range and of the sensors, and that they share one clock"
        for each in found
    ]
