"""A recording that is still being written, a frame at a time: ``lissajous reconstruct --follow``.

Each look opens the file anew and takes what is there: HDF5 that another program writes (SWMR), or an instrument's file
that a reader reads as far as it goes. A frame is reconstructed from its own stretch of the recording and a little
before it, so that its cost does not grow with the recording. Frames are shown in turn; where more than WAITING are
whole by then, all but the newest are dropped.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from math import floor, pi
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from tqdm import tqdm

from estimation.estimate import estimate
from estimation.signals import device_of
from estimation.tracker.angle import SlowAngle
from recon import blur
from recon.convert import convert
from recon.mapping import Grid, Picture
from recon.output import check_folder, write_tiff
from recon.pipeline import Options, field_of, mapped, moved
from recon.registration import slow_period
from recon.stopping import heard
from recon.trouble import samples, troubles, unknown
from recon.undo import placed, with_light
from recon.views import save_picture
from scanner.device import Device
from scanner.errors import BadInput
from scanner.files import replacing
from scanner.hdf5 import check_ends
from scanner.motion import AxisMotion, Motion
from scanner.recording import Recording

POLL = 0.05  # s from look to look at the least
WAITING = 2  # frames that may be whole at once: one that took long delays the next and loses none
FIRST = 0.01  # s: the stretch in which the scan's repeat is looked for; twice as long each time it is too short
BEFORE = 30.0  # periods of the slower axis before a frame, in which a motion is found that goes on from the last one
MOST_TURNS = 4000  # of the slower axis, in which the figure may repeat
COMPARED = 4096  # samples by which signs are told
FINISHED = "finished"  # attribute of a file by which its writer says that it is done


class Look(NamedTuple):
    """What there is of a recording, and why nothing will follow; None where something may."""

    recording: Recording
    ended: str | None


class Shown(NamedTuple):
    """The last frame's motion, and the grid that all frames share."""

    motion: Motion
    grid: Grid


@dataclass
class Live:
    """What following amounted to.

    Attributes:
        frame_s: length of a frame [s]; NaN as long as it is not known.
        frames: shown. dropped: not shown, because newer ones were whole by their turn or they could not be tracked.
        latency_s: of each frame shown, from its last sample's arrival in the file to its picture's [s].
        ended: why following ended.
    """

    frame_s: float
    frames: int = 0
    dropped: int = 0
    latency_s: list[float] = field(default_factory=list)
    ended: str = "interrupted"

    def summary(self) -> dict[str, Any]:
        """For summary.json."""
        told = np.array(self.latency_s or [np.nan])
        latency = {"median": float(np.median(told)), "max": float(told.max()), "first": float(told[0])}
        return {key: getattr(self, key) for key in ("frame_s", "frames", "dropped", "ended")} | {"latency_s": latency}


def follow(
    path: Path,
    output: Path,
    options: Options,
    mapping: Path | None = None,
    frame_time: float | None = None,
    quiet_time: float = 5.0,
    quiet: bool = False,
) -> Live:
    """Show a recording's frames while it is written, as image.tif and image.png in ``output``.

    It ends when the writer closes the file, when the file's attribute ``finished`` is true, when nothing has come for
    ``quiet_time``, or at an interrupt.

    Args:
        mapping: as for :func:`recon.convert.convert`.
        frame_time: of a frame [s]; the scan's repeat if not given.
        quiet_time: [s]. quiet: no progress.

    Raises:
        BadInput: there is still no recording after ``quiet_time``, or ``output`` is no place for a folder.
    """
    check_folder(output)
    check_ends(path)  # once: a look has to be quick
    live, shown, turn, wanted = Live(frame_time or np.nan), None, 0, FIRST
    arrivals: list[tuple[float, float]] = []  # samples up to ... [s on the recording's clock] were there at ... [s]
    with (
        suppress(KeyboardInterrupt),
        tqdm(desc="follow", unit=" frames", file=sys.stderr, disable=quiet or None) as bar,
    ):
        for recording, ended in looks(path, mapping, quiet_time):
            begin, end = common(recording)
            arrivals.append((end, time.monotonic()))
            if np.isnan(live.frame_s) and end - begin >= wanted:
                live.frame_s, wanted = _first_repeat(recording, options), 2 * (end - begin)
            whole = 0 if np.isnan(live.frame_s) else floor((end - begin) / live.frame_s + 1e-9)
            while whole > turn:
                due = turn + 1 if whole - turn <= WAITING else whole
                stop = begin + due * live.frame_s
                try:
                    shown = show(recording, stop - live.frame_s, stop, shown, output, options)
                except BadInput:  # no motion in this stretch; the next may have one, and the whole will tell
                    live.dropped += 1
                else:
                    live.frames += 1
                    live.latency_s.append(time.monotonic() - float(np.interp(stop, *np.array(arrivals).T)))
                live.dropped += due - 1 - turn
                turn = due
                bar.update(live.frames - bar.n)
                late = f", {live.latency_s[-1]:.2f} s late" if live.latency_s else ""
                bar.set_postfix_str(f"{live.dropped} dropped{late}")
            live.ended = ended or live.ended
    heard()
    return live


def looks(path: Path, mapping: Path | None, quiet_time: float) -> Iterator[Look]:
    """Look at a file again and again until nothing more comes. Each recording is closed before the next look.

    Raises:
        BadInput: there is no recording there for ``quiet_time`` [s].
    """
    grown, size, writing = time.monotonic(), -np.inf, False
    while True:
        looked = time.monotonic()
        try:
            recording, still_written = _opened(path, mapping)
        except BadInput:  # not there yet, or caught in the middle of a change
            if time.monotonic() - grown > quiet_time:
                raise
            time.sleep(POLL)
            continue
        with recording:
            _, end = common(recording)
            if end > size:
                grown, size = time.monotonic(), end
            ended = None
            if writing and not still_written:
                ended = "its writer closed the file"
            elif recording.attrs.get(FINISHED):
                ended = "the file says that it is finished"
            elif time.monotonic() - grown > quiet_time:
                ended = f"nothing came for {quiet_time:g} s"
            yield Look(recording, ended)
        if ended:
            return
        writing = still_written
        time.sleep(max(0.0, POLL - (time.monotonic() - looked)))  # none after a frame, whose time was enough


def show(
    recording: Recording, start: float, stop: float, before: Shown | None, output: Path, options: Options
) -> Shown:
    """Reconstruct the frame from ``start`` to ``stop`` [s] and put its picture into ``output``.

    Raises:
        BadInput: no motion can be told there.
    """
    device = device_of(recording, Device.load(options.device) if options.device else None)
    lead = BEFORE * slow_period(before.motion) if before else 0.0
    part = with_light(recording, device).slice(start - lead, stop)
    motion, _ = moved(part, device, options, before.motion if before else None)
    if before:
        motion = continued(motion, before.motion)
    grid = before.grid if before else field_of(device, motion, options)[0]
    intensity = part.require("intensity", "a picture needs it")
    begin = max(0, round((start - intensity.start) * intensity.sample_rate))
    beam = placed(motion, device, recording.start)
    picture = mapped(beam, intensity, grid, samples(unknown(motion, troubles(part)), intensity), begin)
    _replace_pictures(output, picture)
    return Shown(motion, grid)


def continued(motion: Motion, before: Motion) -> Motion:
    """The motion with the signs of the one before it where its own signal cannot tell them."""
    axes = {}
    for name, axis in motion.axes.items():
        turn = axis.sign == "ambiguous" and _opposed(before.axes[name], axis)
        axes[name] = axis.turned() if turn else axis
    return replace(motion, axes=axes)


def repeat_time(motion: Motion, bound: float) -> float:
    """Shortest time after which the figure is back to within ``bound`` [rad] of the faster axis's phase [s]."""
    slow, fast = sorted(_driven_frequency(axis) for axis in motion.axes.values())
    turns = np.arange(1, MOST_TURNS + 1)
    off = 2 * pi * np.abs(turns * fast / slow - np.round(turns * fast / slow))
    return float(turns[np.argmax(off <= max(bound, off.min()))] / slow)


def common(recording: Recording) -> tuple[float, float]:
    """Begin and end [s] of the time that all channels cover."""
    channels = recording.channels.values()
    return max(channel.start for channel in channels), min(channel.end for channel in channels)


def _opened(path: Path, mapping: Path | None) -> tuple[Recording, bool]:
    """The recording as far as it goes, and whether another program has it open to write."""
    try:
        return (Recording.open(path) if mapping is None else convert(path, mapping)), False
    except BadInput:
        if mapping is not None:
            raise
        return Recording.open(path, growing=True), True


def _first_repeat(recording: Recording, options: Options) -> float:
    """The scan's repeat [s], NaN where what there is of the recording does not tell it yet."""
    try:
        device = device_of(recording, Device.load(options.device) if options.device else None)
        motion = estimate(recording, device, options.estimator)
    except BadInput:
        return np.nan
    return repeat_time(motion, min(blur.bound(options.p, n / 2) for n in options.pixels))


def _driven_frequency(axis: AxisMotion) -> float:
    """Of the reference that the phase is told against: unlike the motion's own, it does not drift [Hz]."""
    return float(np.mean(axis.frequency - np.gradient(axis.phase, axis.time) / (2 * pi)))


def _opposed(old: AxisMotion, new: AxisMotion) -> bool:
    """Whether the new motion, where it begins, runs against the old one."""
    if isinstance(old.angle, SlowAngle) and isinstance(new.angle, SlowAngle):  # the old one goes on beyond its end
        time = new.angle.start + np.arange(min(COMPARED, new.angle.size)) / new.angle.sample_rate
        return float(np.mean(np.cos(old.angle.motion.at(time)[0] - new.angle.motion.at(time)[0]))) < 0.0
    first = round((new.angle.start - old.angle.start) * old.angle.sample_rate)
    shared = min(COMPARED, max(old.angle.size - first, 0), new.angle.size)
    return float(np.nansum(old.angle.read(first, first + shared) * new.angle.read(0, shared))) < 0.0


def _replace_pictures(output: Path, picture: Picture) -> None:
    """image.tif and image.png; an older run's summary would not belong to them."""
    output.mkdir(exist_ok=True)
    (output / "summary.json").unlink(missing_ok=True)
    with replacing(output / "image.tif") as path:
        write_tiff(path, picture.image, picture.grid)
    with replacing(output / "image.png") as path:
        save_picture(path, picture)
