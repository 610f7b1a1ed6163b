"""From a recording to a sharp picture: estimate, map, register, compare."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from estimation.estimate import default_estimator, estimate
from estimation.signals import device_of
from estimation.tracker.angle import SlowAngle
from recon import blur
from recon.leaps import leaps, longest_stretch, passed
from recon.lost_light import apart, lost_light, on_time, put_back, torn
from recon.mapping import Grid, Picture, accumulate, mean_picture
from recon.picture_phase import refined
from recon.registration import PhaseError, registered, slow_period
from recon.score import AxisError, Truth, axis_error
from recon.slow_mapping import accumulate_slow
from recon.trouble import Ranges, Trouble, samples, told, troubles, unknown, without
from recon.undo import placed, with_light
from scanner.channel import CHANNEL_UNITS, Channel, check_signal
from scanner.demodulate import plain
from scanner.device import Device
from scanner.errors import DeviceInvalid
from scanner.motion import Motion
from scanner.recording import Recording

Array = NDArray[np.float64]

AXES = ("x", "y")
REGISTERED = 200  # periods of the slower axis that are registered at the most: as many as a scan of 60 ms has
CHUNK = 1 << 22  # samples mapped at a time


@dataclass(frozen=True)
class Options:
    """What a user may ask of a reconstruction.

    Attributes:
        device: TOML file in place of the recording's own device.
        estimator: by name; by what was recorded where None.
        pixels: width, height. p: pixels of shift that are tolerated.
        flips: axes whose sign is turned.
        fill_radius: holes up to this many pixels are filled, and marked as fill; 0 fills none.
        spot: standard deviation of the beam's spot [px], for the blur's account; the recording does not tell it.
        frames: pictures of successive parts of the scan, as many; None for none. frame_time: or one for so long [s].
    """

    device: Path | None = None
    estimator: str | None = None
    pixels: tuple[int, int] = (400, 400)
    p: float = 1.0
    flips: Mapping[str, bool] = field(default_factory=dict)
    fill_radius: int = 0
    spot: float | None = None
    frames: int | None = None
    frame_time: float | None = None


@dataclass(frozen=True)
class Reconstruction:
    """One recording's picture and all that was found on the way.

    Attributes:
        motion, picture: the result.
        p: pixels tolerated. spot: as in ``Options``.
        seen: phase error of each time slice as forward and backward sweeps show it.
        errors: estimate against truth by axis; empty without a truth.
        truth: None without one.
        trouble: what is wrong with the recording. dropped: samples of which no one can say where they belong.
        affected: pixels that hold samples from a stretch of trouble, shape (height, width).
        notes: what a reader has to know, a line each.
        intensity: as it was mapped: its light undone, and between leaps of the clock.
        name: of the recording.
        seconds: taken, without writing.
    """

    motion: Motion
    picture: Picture
    p: float
    spot: float | None
    seen: list[PhaseError]
    errors: Mapping[str, AxisError]
    truth: Truth | None
    trouble: list[Trouble]
    dropped: int
    affected: NDArray[np.bool_]
    notes: list[str]
    intensity: Channel
    name: str
    seconds: float = 0.0

    @property
    def recorded(self) -> float:
        """Length of the intensity [s]."""
        return self.intensity.size / self.intensity.sample_rate

    def pixels(self, axis: str) -> int:
        """Pixels of the picture along an axis."""
        return self.picture.grid.width if axis == "x" else self.picture.grid.height

    def bound(self, axis: str) -> float:
        """p/m of an axis [rad] (chen2020 eq 7)."""
        return blur.bound(self.p, self.pixels(axis) / 2)


def reconstruct(
    recording: Recording, options: Options, truth: Truth | None = None, quiet: bool = False
) -> Reconstruction:
    """Track the motion, map the intensity, register forward against backward, compare with the truth if there is one.

    Raises:
        BadInput: the recording or the device does not serve.
    """
    began = time.perf_counter()
    check_signal(recording.require("intensity", "a picture needs it"), gaps_ok=True)
    device = device_of(recording, Device.load(options.device) if options.device else None)
    jumped = leaps(recording)
    begin, end = longest_stretch(recording, jumped)
    if jumped:
        recording = recording.slice(begin, end)

    def once(recording: Recording) -> Reconstruction:
        return _reconstruct(recording, device, options, truth, quiet, jumped)

    result = _put_right(once, recording, once(recording))
    if jumped:
        cut = (
            f"a phase leaps as where samples were lost: {begin:.6g} s to {end:.6g} s are used, the longest stretch "
            "between leaps; cut the recording there to see the rest"
        )
        result = replace(result, notes=[*result.notes, cut])
    return replace(result, seconds=time.perf_counter() - began)


def _put_right(
    once: Callable[[Recording], Reconstruction], recording: Recording, result: Reconstruction
) -> Reconstruction:
    """``result``; where the picture shows that samples of the intensity were lost, once more with room for them."""
    if len(_windows(result.motion, result.intensity)) > 1:  # slices with stretches between them that no one looked at
        return result
    channel, slices = recording["intensity"], len(result.seen)
    mapping = result.motion, result.intensity, result.picture.grid
    if on_time(result.seen, result.motion).all():
        return result
    torn_at = torn(apart(*mapping, slices), result.motion)
    if torn_at is None:
        return result
    loss = lost_light(*mapping, slices, torn_at)
    again = None if loss is None else once(put_back(recording, loss))
    if loss is None or again is None or not on_time(again.seen, again.motion).all():
        when = channel.start + torn_at * channel.size / slices / channel.sample_rate
        doubt = (
            f"from about {when:.4g} s on forward and backward sweeps agree no more: the phase drifted away, samples of "
            "the intensity were lost, or the sample changed"
        )
        return replace(result, notes=[*result.notes, doubt])
    start, stop = (channel.start + at / channel.sample_rate for at in (loss.first, loss.stop))
    number = f"{abs(loss.missing)} sample{'s' if abs(loss.missing) > 1 else ''}"
    what = f"{number} lost" if loss.missing > 0 else f"{number} too many"
    note = f"intensity: {what} at {start:.6g} s, as the picture shows; what comes later was put back in time"
    leap = Trouble("intensity", "leap", start, stop)
    return replace(again, trouble=[*again.trouble, leap], notes=[*again.notes, note])


def _reconstruct(
    recording: Recording,
    device: Device,
    options: Options,
    truth: Truth | None,
    quiet: bool,
    jumped: Sequence[Trouble],
) -> Reconstruction:
    """:func:`reconstruct` of a stretch between leaps of the phase."""
    with tqdm(total=4, desc="reconstruct", file=sys.stderr, leave=False, disable=quiet or None) as progress:
        recording = with_light(recording, device)
        intensity = recording["intensity"]
        for axis in AXES:
            device.axis(axis)
        options = replace(options, estimator=options.estimator or default_estimator(recording, device))
        progress.set_postfix_str(f"{options.estimator} (compiled once, at the first run)")
        motion, told_of_motion = moved(recording, device, options)
        progress.update()
        progress.set_postfix_str("mapping")
        grid, notes = field_of(device, motion, options)
        beam = placed(motion, device, recording.start)
        trouble = [*jumped, *troubles(recording)]
        lost = samples(unknown(motion, trouble), intensity)
        picture = mapped(beam, intensity, grid, lost)
        touched = samples(((each.start, each.stop) for each in trouble), intensity)
        affected = _visited(beam, without(touched, lost), grid) | passed(beam, jumped, grid)
        if not picture.coverage.any():
            raise DeviceInvalid(
                "no sample lies in the field of view", channel="scan", hint="check half_angle_x and half_angle_y"
            )
        progress.update()
        progress.set_postfix_str("registration")
        windows = _windows(motion, intensity)
        seen = registered(beam, intensity, grid, windows)
        progress.update()
        errors = {axis: axis_error(motion.axes[axis], *truth.angles[axis]) for axis in truth.angles} if truth else {}
        progress.update()
    notes += [*unused(recording, device), *told_of_motion]
    for axis in AXES:
        if motion.axes[axis].sign == "ambiguous":
            notes.append(f"the sign of {axis} is ambiguous: the picture may be mirrored; --flip-{axis} turns it")
    notes += told(trouble)
    return Reconstruction(
        motion=motion,
        picture=picture,
        p=options.p,
        spot=options.spot,
        seen=seen,
        errors=errors,
        truth=truth,
        trouble=trouble,
        dropped=sum(stop - first for first, stop in lost),
        affected=affected,
        notes=notes,
        intensity=intensity,
        name=recording.name,
    )


def moved(
    recording: Recording, device: Device, options: Options, before: Motion | None = None
) -> tuple[Motion, list[str]]:
    """The estimator's motion, refined by the picture where that helps, and what a reader has to know of it.

    Args:
        before: as in ``estimate``.
    """
    motion = estimate(recording, device, options.estimator, options.flips, before)
    grid, _ = field_of(device, motion, options)
    motion, notes = refined(recording, device, motion, recording["intensity"], grid, options.flips)
    return motion, notes + list(motion.notes)


def field_of(device: Device, motion: Motion, options: Options) -> tuple[Grid, list[str]]:
    """The pixels over the device's field of view, else over the motion's own, which a note then says."""
    if device.scan is not None:
        scan = device.scan
        return Grid(*options.pixels, scan.half_angle_x, scan.half_angle_y, scan.metres_per_radian), []
    half = {axis: float(np.max(motion.axes[axis].amplitude)) for axis in AXES}
    note = (
        f"the device states no [scan]: the field is the motion's own, {half['x']:.4g} x {half['y']:.4g} rad half angles"
    )
    return Grid(*options.pixels, half["x"], half["y"]), [note]


def mapped(
    motion: Motion, intensity: Channel, grid: Grid, lost: Ranges, begin: int = 0, end: int | None = None
) -> Picture:
    """The picture, a chunk at a time: memory does not grow with the recording.

    Args:
        motion: its angles on the intensity's clock.
        lost: samples (first, stop) that belong to no pixel. begin, end: samples that are mapped.
    """
    x, y = (motion.axes[axis].angle for axis in AXES)
    sums = np.zeros((grid.height, grid.width, *intensity.shape[1:]))
    counts = np.zeros((grid.height, grid.width), np.uint32)
    for low, high in without([(begin, intensity.size if end is None else end)], lost):
        for first in range(low, high, CHUNK):
            stop = min(first + CHUNK, high)
            seen = plain(intensity.stored(first, stop))
            if seen.dtype.kind == "f" and not np.isfinite(seen).all():
                seen = np.where(np.isinf(seen), np.nan, seen)  # which is left out
            if isinstance(x, SlowAngle) and isinstance(y, SlowAngle) and seen.ndim == 1:
                accumulate_slow(x, y, first, seen, grid, sums, counts)
            else:
                accumulate(x.read(first, stop), y.read(first, stop), seen, grid, sums, counts)
    shown = counts if sums.ndim == 2 else counts[..., None]
    return mean_picture(intensity.gain * sums + intensity.offset * shown, counts, grid)


def _visited(motion: Motion, ranges: Ranges, grid: Grid) -> NDArray[np.bool_]:
    """Pixels that the beam passed over during ranges of samples, shape (height, width)."""
    x, y = (motion.axes[axis].angle for axis in AXES)
    counts = np.zeros((grid.height, grid.width), np.uint32)
    for low, high in ranges:
        for first in range(low, high, CHUNK):
            part = first, min(first + CHUNK, high)
            accumulate(x.read(*part), y.read(*part), np.zeros(part[1] - part[0]), grid, counts=counts)
    return counts > 0


def unused(recording: Recording, device: Device) -> list[str]:
    """A line for every channel and every key of the device that nothing here knows: most of them are slips."""
    channels = [name for name in recording.channels if name not in CHANNEL_UNITS and name != "intensity"]
    keys = _leaves({**device.extra, **{name: axis.extra for name, axis in device.axes.items()}})
    told = [f"{name}: a channel of this name is not used" for name in channels]
    return [*told, *(f"{key}: is no key of a device, and not used" for key in keys)]


def _leaves(table: Mapping[str, Any], where: str = "") -> Iterator[str]:
    """Dotted keys of all values in tables within tables."""
    for key, value in table.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{where}{key}.")
        else:
            yield where + key


def _windows(motion: Motion, intensity: Channel) -> list[tuple[int, int]]:
    """Samples (first, stop) in which sweeps are registered: all of a short recording, three parts of a long one."""
    whole = round(REGISTERED * slow_period(motion) * intensity.sample_rate)
    if intensity.size <= whole:
        return [(0, intensity.size)]
    part = whole // 3
    return [(first, first + part) for first in (0, (intensity.size - part) // 2, intensity.size - part)]
