"""Pauses of a recorded drive that the motion contradicts: the mirror was driven, and the record lacks the drive.

A generator whose buffer runs empty or a probe that comes off is recorded as a drive that is off. Without a drive the
motion decays at a rate that the device states. Each pause is therefore tracked twice: with the drive as recorded, and
with a drive that continues through the pause. Where the innovations are more probable with the second one, the record
is left out as a gap. A drive that was switched off leaves a motion that decays, and is used as recorded.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from estimation.held_samples import without_samples
from estimation.reference import DRIVE_ON_RATIO, PhaseReference, drive_phasors
from estimation.signals import is_capacitive, phase_reference
from estimation.tracker.filter_run import filter_blocks
from estimation.tracker.initial_state import choose_signs, initial_estimate
from estimation.tracker.linearisation import empty_linearisation
from estimation.tracker.observations import BlockLayout, BlockObservations, demodulate_blocks, lay_out_blocks
from estimation.tracker.process_noise import INITIAL_DENSITIES
from scanner.channel import Channel
from scanner.device import Device
from scanner.recording import Recording
from scanner.sample_ranges import runs_of_true

PAUSE_CYCLES = 1
"""Cycles of the drive in whose blocks a pause is searched: a shorter one changes the motion by 1 / Q at most."""

CONTEXT_BLOCKS = 32
"""Blocks before and after a pause that are tracked with it: several decay times of ``BLOCK_DECAY_TIMES`` each, after
which the track no longer depends on the first state."""

MAX_PAUSE_BLOCKS = 128
"""Blocks of a pause that are tracked: 20 decay times, in which a free motion has vanished."""

MIN_LOG_LIKELIHOOD_GAIN = 10.0
"""Gain in log-likelihood, by a drive that continues, from which a pause is contradicted: odds of 2e4. At 40 dB,
pauses of 0.08 to 10 ms in the record alone gained 80 to 460, and a drive that was off for 0.3 to 10 ms lost 3 to 500,
whether the damping of the device was right or 30 % wrong."""


def without_contradicted_pauses(
    recording: Recording, device: Device, layout: BlockLayout
) -> tuple[BlockLayout, dict[str, list[tuple[int, int]]]]:
    """The layout with a drive that continues through the pauses that the motion contradicts, and these by axis.

    Args:
        recording: with the drives.
        layout: blocks of a sense channel of the recording.

    Returns:
        the layout, and ranges (first, stop) of samples of the drives.
    """
    drives = {name: recording[f"drive_{name}"] for name in layout.sense.axes if f"drive_{name}" in recording}
    found: dict[str, list[tuple[int, int]]] = {}
    for name in [*drives, *list(drives)[:-1]]:  # a wrong drive of one axis hides that of another, tested before it
        drive = drives[name]
        pauses = [] if name in found else _find_pauses(drive, layout.references[name])
        if not pauses:
            continue
        continued = _lay_out_again(recording.with_channel(without_samples(drive, pauses)), device, layout)
        parts = _test_parts(layout, drive, pauses)
        gains = [_log_likelihood_gain(layout, continued, part, device) for part in parts]
        contradicted = [pause for pause, gain in zip(pauses, gains, strict=True) if gain > MIN_LOG_LIKELIHOOD_GAIN]
        if contradicted:
            found[name] = contradicted
            recording = recording.with_channel(without_samples(drive, contradicted))
            layout = _lay_out_again(recording, device, layout)
    return layout, found


def _lay_out_again(recording: Recording, device: Device, layout: BlockLayout) -> BlockLayout:
    """The same blocks with the drives of another recording."""
    sense, even = layout.sense, is_capacitive(layout.sense.readout)
    references = {
        name: phase_reference(recording, device, name, sense.channel, even, reference.frequency)
        for name, reference in layout.references.items()
    }
    begin = sense.channel.start + float(layout.starts[0]) / sense.channel.sample_rate
    return lay_out_blocks(recording, device, sense, references, (begin, layout.length))


def _find_pauses(drive: Channel, reference: PhaseReference) -> list[tuple[int, int]]:
    """Ranges of samples in which a drive is off, with the blocks beside them, of which a part may be off."""
    frequency = reference.frequency * (2.0 if reference.kind == "half-drive" else 1.0)
    _, phasors, block = drive_phasors(drive, frequency, PAUSE_CYCLES)
    size = np.abs(phasors)
    off = size < DRIVE_ON_RATIO * np.nanmax(size)  # False in gaps
    return [
        (max(first - 1, 0) * block, drive.size if stop >= size.size - 1 else (stop + 1) * block)
        for first, stop in runs_of_true(off)
    ]


def _test_parts(layout: BlockLayout, drive: Channel, pauses: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """First and stop block of the part that is tracked to test each pause. It contains no other pause."""
    limits = layout.time.size
    edges = [
        np.searchsorted(layout.time, [drive.start + at / drive.sample_rate for at in pause]).tolist()
        for pause in pauses
    ]
    before = [0, *(stop for _, stop in edges[:-1])]
    after = [*(first for first, _ in edges[1:]), limits]
    return [
        (max(first - CONTEXT_BLOCKS, low), min(stop + CONTEXT_BLOCKS, first + MAX_PAUSE_BLOCKS, high, limits))
        for (first, stop), low, high in zip(edges, before, after, strict=True)
    ]


def _log_likelihood_gain(recorded: BlockLayout, continued: BlockLayout, part: tuple[int, int], device: Device) -> float:
    """Log-likelihood of the blocks ``part`` with a drive that continues, less that with the drive as recorded."""
    if part[1] <= part[0]:
        return 0.0
    observations = demodulate_blocks(recorded, *part)
    same_samples = replace(continued, switches=recorded.switches)  # a switch cuts the block that contains it
    alternative = demodulate_blocks(same_samples, *part, observations.signal.spectrum)
    return _log_likelihood(alternative, device) - _log_likelihood(observations, device)


def _log_likelihood(observations: BlockObservations, device: Device) -> float:
    """Log-likelihood of all blocks at the usual process noise."""
    start, _ = choose_signs(observations, initial_estimate(observations, device))
    densities = np.tile(INITIAL_DENSITIES, (len(observations.parameters), 1))
    signal = observations.signal
    return filter_blocks(observations, signal, empty_linearisation(signal), start, densities).log_likelihood
