"""Reconstruction of a recording that is still being written, frame by frame: ``lissajous reconstruct --follow``.

Each poll opens the file again and reads what is there: HDF5 that another program writes (SWMR), or an instrument's file
that a reader reads up to its current end. A frame is reconstructed in parts while it arrives (``live_frames``), so its
cost does not grow with the recording. Frames are shown in order. If more than ``MAX_PENDING_FRAMES`` are complete, all
but the newest are dropped. The phase error of the readout, which takes longer to measure than a frame may last, is
measured by another thread; the frames that begin after its end use it.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field, replace
from math import floor, pi
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from estimation.estimate import estimate
from recon.imaging import blur
from recon.imaging.scan_phase.bidirectional_phase import slow_period
from recon.imaging.scan_phase.readout_phase_model import ReadoutPhase
from recon.io.output import check_folder
from recon.live.growing_recording import Snapshot, common_time_span, poll_recording
from recon.live.live_frames import (
    FrameSums,
    LiveScan,
    add_part,
    finish_frame,
    first_picture,
    measure_readout,
    next_measurement,
    part_edges,
    replace_display_and_sd,
    replace_picture,
    wants_measurement,
)
from recon.runtime.interrupts import acknowledge_stop
from recon.steps.preparation import select_device
from recon.steps.reconstruction import Options
from scanner.errors import BadInput
from scanner.hdf5 import check_ends
from scanner.motion import AxisMotion, Motion
from scanner.recording import Recording

MAX_PENDING_FRAMES = 2
"""Complete frames that may wait. One slow frame then delays the next one and drops none."""

FIRST_REPEAT_SEARCH_S = 0.01
"""Length of the recording at which the scan's repeat time is first estimated. It doubles after each failure."""

QUIET_TIME_S = 5.0
"""Time without new samples after which the recording has ended, unless another one is given."""

MAX_REPEAT_PERIODS = 4000
"""Periods of the slower axis within which the figure has to repeat."""


@dataclass
class FollowSummary:
    """Summary of a followed recording; its keys in summary.json are the names of all attributes but ``shown``.

    Attributes:
        frame_s: duration of a frame [s]; NaN until it is known.
        frames: number of frames shown.
        dropped: number of frames not shown, because newer ones were complete or their motion could not be estimated.
        overtaken: number of those that arrived later and that newer ones had overtaken: the machine is too slow for the
            frames.
        recorded_before: number of those that were complete when the recording was opened.
        latency_s: time from the arrival of a frame's last sample to its picture, for each frame shown [s].
        ended: why following ended.
        shown: end of each frame shown [s], and when its picture was complete [s on the monotonic clock].
    """

    frame_s: float
    frames: int = 0
    dropped: int = 0
    overtaken: int = 0
    recorded_before: int = 0
    latency_s: list[float] = field(default_factory=list)
    ended: str = "interrupted"
    shown: list[tuple[float, float]] = field(default_factory=list)

    def summary(self) -> dict[str, Any]:
        """Return the part "live" of summary.json."""
        values = np.array(self.latency_s or [np.nan])
        latency = {"median": float(np.median(values)), "max": float(values.max()), "first": float(values[0])}
        keys = ("frame_s", "frames", "dropped", "overtaken", "recorded_before", "ended")
        return {key: getattr(self, key) for key in keys} | {"latency_s": latency}


def follow_recording(
    path: Path,
    output: Path,
    options: Options,
    mapping: Path | None = None,
    frame_time: float | None = None,
    quiet_time: float = QUIET_TIME_S,
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
    summary = FollowSummary(frame_time or np.nan)
    with (
        suppress(KeyboardInterrupt),
        ThreadPoolExecutor(1) as background,
        tqdm(desc="follow", unit=" frames", file=sys.stderr, disable=quiet or None) as bar,
    ):
        follower = _Follower(output, options, summary, background)
        for snapshot in poll_recording(path, mapping, quiet_time):
            follower.arrive(snapshot)
            while follower.advance(snapshot.recording):
                bar.update(summary.frames - bar.n)
                bar.set_postfix_str(follower.describe())
    acknowledge_stop()
    return summary


@dataclass
class _Follower:
    """State of a followed recording.

    Attributes:
        output, options, summary: as for ``follow_recording``.
        background: measures the phase error of the readout.
        scan: motion and readout so far; None before the first part of the first frame.
        frame: samples of the frame in progress; None before its first part.
        done: number of frames that were shown or dropped.
        part: number of parts of the frame in progress.
        edges: of its parts [s]. They are fixed when it begins: a part that does not begin where the one before ended is
            not tracked from its end.
        span: begin and end of the recording [s].
        opened_end: end of the recording when it was opened [s]; NaN before.
        search: length of the recording at which the repeat time is estimated next [s].
        arrivals: end of the recording [s on its clock], and when it was read [s].
        refusal: why the last frame was not shown.
        measurement: of the readout's phase error, in progress; None while there is none.
    """

    output: Path
    options: Options
    summary: FollowSummary
    background: Executor
    scan: LiveScan | None = None
    frame: FrameSums | None = None
    done: int = 0
    part: int = 0
    edges: list[float] = field(default_factory=list)
    span: tuple[float, float] = (0.0, 0.0)
    opened_end: float = np.nan
    search: float = FIRST_REPEAT_SEARCH_S
    arrivals: list[tuple[float, float]] = field(default_factory=list)
    refusal: str = ""
    measurement: Future[Mapping[str, ReadoutPhase]] | None = None

    def arrive(self, snapshot: Snapshot) -> None:
        """Note the end of the recording, and find the repeat time of the scan once enough was recorded."""
        begin, end = self.span = common_time_span(snapshot.recording)
        self.opened_end = end if np.isnan(self.opened_end) else self.opened_end
        self.arrivals.append((end, snapshot.read))
        self.summary.ended = snapshot.ended or self.summary.ended
        if np.isnan(self.summary.frame_s) and end - begin >= self.search:
            self.summary.frame_s, self.search = _first_repeat(snapshot.recording, self.options), 2 * (end - begin)

    def advance(self, recording: Recording) -> bool:
        """Reconstruct the next part if its samples are there; False if they are not."""
        (begin, end), length = self.span, self.summary.frame_s
        complete = self._complete_frames(end)
        if self.part == 0 and complete - self.done > MAX_PENDING_FRAMES:
            self._drop_until(complete - 1)
        start, stop = begin + self.done * length, begin + (self.done + 1) * length
        if self.part == 0:
            self.edges = part_edges(start, stop, slow_period(self.scan.motion)) if self.scan else [start, stop]
        if np.isnan(length) or (complete <= self.done and not self.edges[self.part + 1] <= end):
            return False
        try:
            if self.part == 0:
                self._use_measurement()
            self.scan, self.frame = add_part(
                recording, self.edges[self.part], self.edges[self.part + 1], self.scan, self.frame, self.options
            )
            self.part += 1
            if self.part == len(self.edges) - 1:
                self._show(stop)
        except BadInput as error:  # no motion in this frame; the next one may have one
            self.refusal = f": {error}"
            self.summary.dropped += 1
            self._begin_next()
        return True

    def _complete_frames(self, end: float) -> int:
        """Number of frames that are complete by ``end`` [s]; 0 while their length is unknown."""
        length = self.summary.frame_s
        return 0 if np.isnan(length) else floor((end - self.span[0]) / length + 1e-9)

    def _drop_until(self, frame: int) -> None:
        """Leave out the frames before number ``frame``."""
        before = max(0, min(frame, self._complete_frames(self.opened_end)) - self.done)
        self.summary.dropped += frame - self.done
        self.summary.recorded_before += before
        self.summary.overtaken += frame - self.done - before
        self.done = frame

    def _show(self, stop: float) -> None:
        """Write the picture of the complete frame, then whatever takes longer."""
        assert self.scan is not None
        assert self.frame is not None
        quick = first_picture(self.scan, self.frame, self.options)
        if quick is not None:
            replace_picture(self.output, quick)
            self._note_latency(stop)
        self.scan = finish_frame(self.scan, self.frame, self.options)
        assert self.scan.estimate is not None
        if quick is None:
            replace_picture(self.output, self.scan.estimate.picture)
            self._note_latency(stop)
        replace_display_and_sd(self.output, self.scan.estimate)
        if self.measurement is None and wants_measurement(self.scan, self.options):
            self.measurement = self.background.submit(measure_readout, self.frame.longest, self.scan.readout_phase)
        self._begin_next()

    def _use_measurement(self) -> None:
        """Take over the phase error of the readout if its measurement has ended."""
        if self.scan is None or self.measurement is None or not self.measurement.done():
            return
        with suppress(BadInput):  # this frame determines no phase error; what is known remains
            self.scan = replace(self.scan, readout_phase=self.measurement.result())
        self.scan = replace(self.scan, measure_at=next_measurement(self.scan.frames))
        self.measurement = None

    def _note_latency(self, stop: float) -> None:
        self.summary.frames += 1
        self.summary.shown.append((stop, now := time.monotonic()))
        self.summary.latency_s.append(now - float(np.interp(stop, *np.array(self.arrivals).T)))
        self.arrivals = [arrival for arrival in self.arrivals if arrival[0] >= stop]

    def _begin_next(self) -> None:
        self.done, self.part, self.frame = self.done + 1, 0, None

    def describe(self) -> str:
        """Number of dropped frames, with the latency of the last one shown or the reason why none is."""
        late = f", {self.summary.latency_s[-1]:.2f} s late" if self.summary.latency_s else self.refusal
        return f"{self.summary.dropped} dropped{late}"


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
