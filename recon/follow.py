"""Reconstruction of a recording that is still being written, frame by frame: ``lissajous reconstruct --follow``.

Each poll opens the file again and reads what is there: HDF5 that another program writes (SWMR), or an instrument's file
that a reader reads up to its current end. A frame is reconstructed from its own segment of the recording and a short
lead-in, so its cost does not grow with the recording. Frames are shown in order. If more than ``MAX_PENDING_FRAMES``
are complete, all but the newest are dropped.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from math import floor, pi
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from tqdm import tqdm

from estimation.estimate import estimate
from recon.imaging import blur
from recon.imaging.bidirectional_phase import slow_period
from recon.imaging.intensity_gridding import grid_intensity
from recon.imaging.picture import Grid
from recon.imaging.picture_estimate import EstimatedPicture, estimate_picture
from recon.imaging.pixel_noise import measure_noise
from recon.imaging.readout_phase import ReadoutPhase, apply_readout_phase, update_readout_phase
from recon.interrupts import acknowledge_stop
from recon.io.convert import convert
from recon.io.output import check_folder, write_tiff
from recon.pipeline import estimate_motion, measure_phase_errors, wants_readout_phase
from recon.preparation import prepare_frame, select_device
from recon.quality.defects import unrecoverable_intervals
from recon.quality.sensor_noise import check_sensor_noise
from recon.reconstruction import Options
from recon.report.figures import save_picture
from recon.sample_ranges import to_sample_ranges
from scanner.errors import BadInput
from scanner.files import replacing
from scanner.hdf5 import check_ends
from scanner.motion import AxisMotion, Motion
from scanner.recording import Recording

MIN_POLL_INTERVAL_S = 0.05
"""Shortest time between two polls of the file. It bounds the load; the delay is too short to be noticed."""

MAX_PENDING_FRAMES = 2
"""Complete frames that may wait. One slow frame then delays the next one and drops none."""

FIRST_REPEAT_SEARCH_S = 0.01
"""Length of the recording at which the scan's repeat time is first estimated. It doubles after each failure."""

LEAD_IN_PERIODS = 30.0
"""Periods of the slower axis before a frame, in which its motion connects to the previous frame's."""

MAX_REPEAT_PERIODS = 4000
"""Periods of the slower axis within which the figure has to repeat."""

NOISE_SAMPLES = 1 << 17
"""Samples of a frame from which its noise is measured, in some 10 ms: 10^4 pairs determine a variance to 1.5 %."""

MAX_FRAMES_BETWEEN_MEASUREMENTS = 64
"""Frames between two measurements of the readout's phase error: seconds, in which temperature changes it little."""

SIGN_TEST_SAMPLES = 4096
"""Samples over which the signs of two motions are compared."""

FINISHED_ATTRIBUTE = "finished"
"""Attribute of a file by which its writer states that the recording is complete."""


class Snapshot(NamedTuple):
    """The recording up to its current end.

    Attributes:
        recording: open while the snapshot is used.
        ended: reason why the recording is complete; None while further samples may be written.
    """

    recording: Recording
    ended: str | None


class PreviousFrame(NamedTuple):
    """What the next frame takes over from a frame.

    Attributes:
        motion: of the mirror in the frame.
        grid: shared by all frames.
        readout_phase: phase error of the readout by axis, from all frames so far.
        estimate: picture of the frame.
        number: of the frame, from 1 on.
    """

    motion: Motion
    grid: Grid
    readout_phase: Mapping[str, ReadoutPhase]
    estimate: EstimatedPicture
    number: int


@dataclass
class FollowSummary:
    """Summary of a followed recording; its keys in summary.json are the attributes' names.

    Attributes:
        frame_s: duration of a frame [s]; NaN until it is known.
        frames: number of frames shown.
        dropped: number of frames not shown, because newer ones were complete or their motion could not be estimated.
        latency_s: time from the arrival of a frame's last sample to its picture, for each frame shown [s].
        ended: why following ended.
    """

    frame_s: float
    frames: int = 0
    dropped: int = 0
    latency_s: list[float] = field(default_factory=list)
    ended: str = "interrupted"

    def summary(self) -> dict[str, Any]:
        """Return the part "live" of summary.json."""
        values = np.array(self.latency_s or [np.nan])
        latency = {"median": float(np.median(values)), "max": float(values.max()), "first": float(values[0])}
        return {key: getattr(self, key) for key in ("frame_s", "frames", "dropped", "ended")} | {"latency_s": latency}


def follow_recording(
    path: Path,
    output: Path,
    options: Options,
    mapping: Path | None = None,
    frame_time: float | None = None,
    quiet_time: float = 5.0,
    quiet: bool = False,
) -> FollowSummary:
    """Write the frames of a growing recording as image.tif, image_sd.tif and image.png, each over the previous one.

    It ends when the writer closes the file, when the file's attribute ``finished`` is true, when the file did not grow
    for ``quiet_time``, or at an interrupt.

    Args:
        path: of the recording.
        output: folder for the pictures.
        options: as for :func:`recon.pipeline.reconstruct`.
        mapping: as for :func:`recon.io.convert.convert`.
        frame_time: duration of a frame [s]; the repeat time of the scan if None.
        quiet_time: [s].
        quiet: show no progress.

    Raises:
        BadInput: no recording appears within ``quiet_time``, or ``output`` cannot be a folder.
    """
    check_folder(output)
    check_ends(path)  # only once, because a poll has to be fast
    summary, previous, frames_done, refusal = FollowSummary(frame_time or np.nan), None, 0, ""
    needed = FIRST_REPEAT_SEARCH_S
    arrivals: list[tuple[float, float]] = []  # end of the recording [s on its clock], and when it was read [s]
    with (
        suppress(KeyboardInterrupt),
        tqdm(desc="follow", unit=" frames", file=sys.stderr, disable=quiet or None) as bar,
    ):
        for recording, ended in poll_recording(path, mapping, quiet_time):
            begin, end = common_time_span(recording)
            arrivals.append((end, time.monotonic()))
            if np.isnan(summary.frame_s) and end - begin >= needed:
                summary.frame_s, needed = _first_repeat(recording, options), 2 * (end - begin)
            complete = 0 if np.isnan(summary.frame_s) else floor((end - begin) / summary.frame_s + 1e-9)
            while complete > frames_done:
                due = frames_done + 1 if complete - frames_done <= MAX_PENDING_FRAMES else complete
                stop = begin + due * summary.frame_s
                try:
                    previous = reconstruct_frame(recording, stop - summary.frame_s, stop, previous, output, options)
                except BadInput as error:  # no motion in this frame; the next one may have one
                    summary.dropped, refusal = summary.dropped + 1, f": {error}"
                else:
                    summary.frames += 1
                    summary.latency_s.append(time.monotonic() - float(np.interp(stop, *np.array(arrivals).T)))
                summary.dropped += due - 1 - frames_done
                frames_done = due
                bar.update(summary.frames - bar.n)
                late = f", {summary.latency_s[-1]:.2f} s late" if summary.latency_s else refusal
                bar.set_postfix_str(f"{summary.dropped} dropped{late}")
            summary.ended = ended or summary.ended
    acknowledge_stop()
    return summary


def poll_recording(path: Path, mapping: Path | None, quiet_time: float) -> Iterator[Snapshot]:
    """Yield snapshots of a growing file until it ends. Each recording is closed before the next poll.

    Raises:
        BadInput: the path holds no readable recording for ``quiet_time`` [s].
    """
    last_growth, size, writing = time.monotonic(), -np.inf, False
    while True:
        polled = time.monotonic()
        try:
            recording, still_written = _open_growing(path, mapping)
        except BadInput:  # not there yet, or read during a change
            if time.monotonic() - last_growth > quiet_time:
                raise
            time.sleep(MIN_POLL_INTERVAL_S)
            continue
        with recording:
            _, end = common_time_span(recording)
            if end > size:
                last_growth, size = time.monotonic(), end
            ended = None
            if writing and not still_written:
                ended = "its writer closed the file"
            elif recording.attrs.get(FINISHED_ATTRIBUTE):
                ended = "the file says that it is finished"
            elif time.monotonic() - last_growth > quiet_time:
                ended = f"nothing came for {quiet_time:g} s"
            yield Snapshot(recording, ended)
        if ended:
            return
        writing = still_written
        time.sleep(max(0.0, MIN_POLL_INTERVAL_S - (time.monotonic() - polled)))


def reconstruct_frame(
    recording: Recording, start: float, stop: float, previous: PreviousFrame | None, output: Path, options: Options
) -> PreviousFrame:
    """Reconstruct the frame from ``start`` to ``stop`` [s] and write its picture into ``output``.

    Args:
        recording: up to its current end.
        start, stop: of the frame [s].
        previous: None for the first frame.
        output: folder for the pictures.
        options: as for :func:`recon.pipeline.reconstruct`.

    Raises:
        BadInput: the motion of the frame cannot be estimated, or in the first frame a sensor holds only noise.
    """
    device = select_device(recording, options.device)
    lead_in = LEAD_IN_PERIODS * slow_period(previous.motion) if previous else 0.0
    prepared = prepare_frame(recording, device, start - lead_in, stop, options.undo_lag)
    if previous is None:
        check_sensor_noise(prepared.recording, device, options.estimator)
    estimated = estimate_motion(prepared, options, previous.motion if previous else None)
    if previous:
        motion = match_signs(estimated.motion, previous.motion)
        estimated = replace(estimated, motion=motion, grid=previous.grid)
    known = previous.readout_phase if previous else {}
    sensed = estimated.motion
    estimated = replace(estimated, motion=apply_readout_phase(sensed, known))
    intensity = prepared.intensity
    first = max(0, round((start - intensity.start) * intensity.sample_rate))
    unlocated = to_sample_ranges(unrecoverable_intervals(estimated.motion, prepared.defects), intensity)
    means = grid_intensity(estimated.beam, intensity, estimated.grid, unlocated, first)
    noise = measure_noise(estimated.beam, intensity, estimated.grid, NOISE_SAMPLES)
    before = previous.estimate if previous and not options.independent_frames else None
    data = estimated.beam, intensity, unlocated, first
    picture = estimate_picture(options.picture, means, noise, *data, before=before)
    _replace_pictures(output, picture)
    number = previous.number + 1 if previous else 1
    if measures_readout_phase(number) and wants_readout_phase(sensed, options):  # after the picture, to delay none
        known = update_readout_phase(sensed, estimated.motion, measure_phase_errors(estimated), known)
    return PreviousFrame(sensed, estimated.grid, known, picture, number)


def measures_readout_phase(number: int) -> bool:
    """Whether the phase error of the readout is measured in the frame of this number, from 1 on.

    It takes longer than a short frame lasts. Frames at doubling numbers find it early and then refine it; in a long
    scan every ``MAX_FRAMES_BETWEEN_MEASUREMENTS`` follow it.
    """
    return number & (number - 1) == 0 or number % MAX_FRAMES_BETWEEN_MEASUREMENTS == 0


def match_signs(motion: Motion, before: Motion) -> Motion:
    """Return the motion with the signs of the previous one on axes whose own signal leaves the sign ambiguous."""
    axes = {}
    for name, axis in motion.axes.items():
        invert = axis.sign == "ambiguous" and _is_opposite(before.axes[name], axis)
        axes[name] = axis.negated() if invert else axis
    return replace(motion, axes=axes)


def repeat_time(motion: Motion, bound: float) -> float:
    """Return the shortest time [s] after which the figure repeats.

    Args:
        motion: of the scan.
        bound: largest difference of the faster axis's phase after that time [rad].
    """
    slow, fast = sorted(_reference_frequency(axis) for axis in motion.axes.values())
    turns = np.arange(1, MAX_REPEAT_PERIODS + 1)
    off = 2 * pi * np.abs(turns * fast / slow - np.round(turns * fast / slow))
    return float(turns[np.argmax(off <= max(bound, off.min()))] / slow)


def common_time_span(recording: Recording) -> tuple[float, float]:
    """Return begin and end [s] of the time that all channels cover."""
    channels = recording.channels.values()
    return max(channel.start for channel in channels), min(channel.end for channel in channels)


def _open_growing(path: Path, mapping: Path | None) -> tuple[Recording, bool]:
    """The recording up to its current end, and whether another program has it open for writing."""
    try:
        return (Recording.open(path) if mapping is None else convert(path, mapping)), False
    except BadInput:
        if mapping is not None:
            raise
        return Recording.open(path, growing=True), True


def _first_repeat(recording: Recording, options: Options) -> float:
    """The repeat time of the scan [s]; NaN while the recording is too short for it."""
    try:
        device = select_device(recording, options.device)
        motion = estimate(recording, device, options.estimator)
    except BadInput:
        return np.nan
    return repeat_time(motion, min(blur.phase_bound(options.p, n / 2) for n in options.pixels))


def _reference_frequency(axis: AxisMotion) -> float:
    """Frequency of the phase reference [Hz]. It does not drift, unlike that of the motion."""
    return float(np.mean(axis.frequency - np.gradient(axis.phase, axis.time) / (2 * pi)))


def _is_opposite(old: AxisMotion, new: AxisMotion) -> bool:
    """Whether the new motion has the opposite sign of the old one at its begin."""
    before, after = old.angle.phasors(), new.angle.phasors()
    if before is not None and after is not None:  # phasors can be extrapolated beyond the end of the old motion
        time = new.angle.start + np.arange(min(SIGN_TEST_SAMPLES, new.angle.size)) / new.angle.sample_rate
        return float(np.mean(np.cos(before.phase(time) - after.phase(time)))) < 0.0
    first = round((new.angle.start - old.angle.start) * old.angle.sample_rate)
    shared = min(SIGN_TEST_SAMPLES, max(old.angle.size - first, 0), new.angle.size)
    return float(np.nansum(old.angle.read(first, first + shared) * new.angle.read(0, shared))) < 0.0


def _replace_pictures(output: Path, estimate: EstimatedPicture) -> None:
    """Replace image.tif, image_sd.tif and image.png, and remove the summary.json of an older run."""
    output.mkdir(exist_ok=True)
    (output / "summary.json").unlink(missing_ok=True)
    with replacing(output / "image.tif") as path:
        write_tiff(path, estimate.picture.image, estimate.picture.grid)
    with replacing(output / "image_sd.tif") as path:
        write_tiff(path, estimate.sd, estimate.picture.grid)
    with replacing(output / "image.png") as path:
        save_picture(path, estimate.picture)
