"""Phases of a scan of which only the frequencies and the field are known, from the self-crossings of the picture.

1. In each time slice the phases are searched over half a turn (:mod:`recon.imaging.scan_phase.phase_search`).
2. A motion with these phases is registered (:mod:`recon.imaging.scan_phase.bidirectional_phase`): forward against
   backward half-periods, in short parts of every slice.
3. The measured phases are smoothed, with a random walk of the frequency, and 2 repeats with the new motion.

The amplitude changes during the scan in the same way: :mod:`recon.imaging.scan_phase.amplitude_change`. The scale of
the amplitude and the signs of both axes are not in the picture. The largest amplitude is taken to fill the field.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from estimation.curve_smoother import smooth_curve
from estimation.frequency_motion import SlowCurve, interpolate_curve, missing_for_motion, sine_motion
from estimation.reference import PhaseReference
from estimation.signals import phase_reference
from estimation.tracker.phase_measurements import UNKNOWN_PHASE_SD
from recon.imaging.picture import Grid
from recon.imaging.scan_phase.amplitude_change import measure_amplitude_changes
from recon.imaging.scan_phase.bidirectional_phase import measure_motion_phase_errors, slow_period
from recon.imaging.scan_phase.phase_error import PhaseError
from recon.imaging.scan_phase.phase_search import (
    MIN_FOUND_FRACTION,
    PERIODS_PER_SEARCH,
    PhaseFound,
    continue_phases,
    cut_slices,
    search_phases,
)
from scanner.arrays import Array
from scanner.channel import Channel
from scanner.device import AXES, Device
from scanner.errors import BadInput
from scanner.motion import AxisMotion, Motion
from scanner.recording import Recording

PERIODS_PER_PICTURE = 800
"""Periods of the slower axis that share one picture. It bounds the memory and the change of the specimen within it."""

PERIODS_PER_AMPLITUDE = 6
"""Periods of the slower axis in which a change of the amplitude is measured once."""

MAX_ROUNDS = 6
"""Registrations after which the iteration ends. Three are usual."""

CONVERGENCE_SD = 0.5
"""Change of a phase, relative to its standard deviation, below which it has converged."""

MIN_PERIODS_OF_SEARCH = 0.75 * PERIODS_PER_SEARCH
"""Periods of the slower axis from which a failed search has another cause than its length: a recording is cut into
slices of 0.75 times ``PERIODS_PER_SEARCH`` at least, unless it is shorter as a whole."""

MAX_CLOSED_PERIODS = PERIODS_PER_SEARCH // 4
"""Periods of the slower axis after which a figure that repeats is named as the cause of a failed search."""


def phases_from_picture(
    recording: Recording, device: Device, motion: Motion, intensity: Channel, grid: Grid, flips: Mapping[str, bool]
) -> tuple[Motion, list[str]]:
    """Find the phases of a motion of which only frequencies and amplitudes are known.

    Args:
        recording, device: of the scan.
        motion: by ``estimation.frequency_motion``.
        intensity: shape (n,) or (n, detectors).
        grid: the pixels.
        flips: axes whose sign is inverted.

    Returns:
        The motion, and notes on what was found and what the picture cannot determine.

    Raises:
        BadInput: the samples of opposite directions agree for no phases.
    """
    references = {name: phase_reference(recording, device, name) for name in AXES}
    slices = cut_slices(intensity, slow_period(motion) * PERIODS_PER_SEARCH)
    for name, reference in references.items():
        periods = reference.frequency * intensity.size / intensity.sample_rate
        if periods < 1.0:
            what = f"holds {periods:.2g} periods of a motion at {reference.frequency:.6g} Hz in {name}"
            hint = f"check frequency in [{name}.drive] of the device, in Hz, and the sample rate"
            raise BadInput(what, file=intensity.file, channel=intensity.name, hint=hint)
    found = _search_slices(references, intensity, slices)
    phases, notes = _phases_of_slices(references, intensity, slices, found)
    field = {name: float(np.log(motion.axes[name].amplitude[0])) for name in AXES}
    logs = {name: _constant(field[name], intensity) for name in AXES}
    windows = cut_slices(intensity, slow_period(motion) * PERIODS_PER_PICTURE)
    rounds, converged = 0, False
    while rounds < MAX_ROUNDS and not converged:
        motion = replace(motion, axes=_axes(references, phases, logs, intensity))
        errors = measure_motion_phase_errors(motion, intensity, grid, windows)
        before, phases = phases, {name: _smoothed(errors, motion.axes[name], phases[name], name) for name in AXES}
        logs = _corrected_amplitudes(motion, logs, intensity, grid, windows)
        converged = all(_has_converged(before[name], phases[name]) for name in AXES)
        rounds += 1
    measured = {name: int(np.isfinite([getattr(error, name).sd for error in errors]).sum()) for name in AXES}
    for name, log in logs.items():
        largest = interpolate_curve(log, phases[name].time)[0].max()
        logs[name] = log._replace(value=log.value - largest + field[name])
    for name in AXES:  # a phase that few slices show may be a wrong minimum
        if measured[name] < MIN_FOUND_FRACTION * len(errors):
            phases[name] = phases[name]._replace(sd=np.full(phases[name].time.size, UNKNOWN_PHASE_SD))
    axes = _axes(references, phases, logs, intensity)
    axes = {name: axis.negated() if flips.get(name, False) else axis for name, axis in axes.items()}
    if not any(measured.values()):
        raise _search_failure(references, found, slices, intensity)
    info = {"picture": {"rounds": rounds, "slices": len(errors), "determined": measured}}
    return replace(motion, axes=axes, info={**motion.info, **info}), [
        *_notes(measured, len(errors)),
        *_describe_unused_mechanics(recording, device),
        *notes,
    ]


def _axes(
    references: Mapping[str, PhaseReference],
    phases: Mapping[str, SlowCurve],
    logs: Mapping[str, SlowCurve],
    intensity: Channel,
) -> dict[str, AxisMotion]:
    """The motion of both axes."""
    clock = intensity.sample_rate, intensity.start, intensity.size
    return {name: sine_motion(references[name], phases[name], logs[name], clock) for name in AXES}


class SliceFound(NamedTuple):
    """Phases found in one slice, and the time of its middle [s]."""

    time: float
    x: PhaseFound
    y: PhaseFound


def _search_slices(
    references: Mapping[str, PhaseReference], intensity: Channel, slices: list[tuple[int, int]]
) -> list[SliceFound]:
    """Phases of both axes in the slices that hold a signal."""
    found: list[SliceFound] = []
    for first, stop in slices:
        values, time = intensity.read(first, stop), intensity.time(first, stop)
        values = values.mean(axis=1) if values.ndim == 2 else values
        finite = np.isfinite(values)
        if not finite.any() or np.ptp(values[finite]) == 0.0:
            continue
        x, y = (references[name].phase(time[finite]) for name in AXES)
        found.append(SliceFound(float(time.mean()), *search_phases(x, y, values[finite])))
    return found


def _phases_of_slices(
    references: Mapping[str, PhaseReference],
    intensity: Channel,
    slices: list[tuple[int, int]],
    found: list[SliceFound],
) -> tuple[dict[str, SlowCurve], list[str]]:
    """Phases at the middles of the slices, unknown for an axis of which the search finds none, and notes.

    Raises:
        BadInput: it finds none of either axis.
    """
    phases: dict[str, SlowCurve] = {}
    notes: list[str] = []
    for name in AXES:
        clear = [(each.time, getattr(each, name)) for each in found if getattr(each, name).is_clear]
        if clear and len(clear) >= MIN_FOUND_FRACTION * len(slices):
            value, is_unique = continue_phases([phase for _, phase in clear])
            phases[name] = _knots(np.array([time for time, _ in clear]), value)
            notes += [] if is_unique else [AMBIGUOUS.format(name=name)]
    if not phases:
        raise _search_failure(references, found, slices, intensity)
    return {name: phases.get(name, _constant(0.0, intensity, UNKNOWN_PHASE_SD)) for name in AXES}, notes


AMBIGUOUS = (
    "the scene nearly equals its mirror image in {name}: its phase may be a quarter of a turn off, the picture wrong"
)

SEARCH_HINT = (
    "check the drive frequencies of the device and the sample rate; a scene without features shows no phase, and a "
    "sense or angle channel is then needed"
)

SHORT_HINT = (
    "record for longer, or record a sense or angle channel of both axes; or record both drives and state J, b and k of "
    "both axes, which give phases to about 10 degrees"
)


def _search_failure(
    references: Mapping[str, PhaseReference],
    found: list[SliceFound],
    slices: list[tuple[int, int]],
    intensity: Channel,
) -> BadInput:
    """What the search found, with what it would have needed: a longer recording before anything else."""
    slower = min(AXES, key=lambda name: references[name].frequency)
    length = (slices[0][1] - slices[0][0]) / intensity.sample_rate
    periods = length * references[slower].frequency
    if periods < MIN_PERIODS_OF_SEARCH:
        what = (
            f"holds {periods:.3g} periods of {slower} at {references[slower].frequency:.6g} Hz, and nothing else shows "
            f"the motion; the search of its phases in the picture needs about {PERIODS_PER_SEARCH}"
        )
        return BadInput(what, file=intensity.file, channel=intensity.name, hint=SHORT_HINT)
    best = max((getattr(each, name).correlation for each in found for name in AXES), default=0.0)
    at = " and ".join(f"{references[name].frequency:.8g} Hz in {name}" for name in AXES)
    what = (
        f"forward and backward half-periods agree for no phase, with motions at {at} (best correlation "
        f"{min(best, 1.0):.2f}; frequencies have to be right within {0.1 / length:.2g} Hz)"
        f"{_describe_closed_figure(references, length)}"
    )
    return BadInput(what, file=intensity.file, channel=intensity.name, hint=SEARCH_HINT)


def _describe_closed_figure(references: Mapping[str, PhaseReference], length: float) -> str:
    """Words for a figure that repeats within a slice of ``length`` [s], and so crosses little of the field."""
    x, y = (references[name].frequency for name in AXES)
    for q in range(1, MAX_CLOSED_PERIODS + 1):
        p = round(q * max(x, y) / min(x, y))
        if abs(q * max(x, y) - p * min(x, y)) * length < 1.0:
            repeats = round(length * min(x, y) / q)
            return (
                f"; the frequencies are nearly {p} : {q}, so that the figure repeats itself {repeats} "
                "times while phases are searched, and crosses little of the field: choose others, see lissajous design"
            )
    return ""


def _knots(time: Array, value: Array) -> SlowCurve:
    """Phases of slices, with linear interpolation between them."""
    if time.size == 1:
        time, value = time[0] + np.array([0.0, 1e-3]), np.repeat(value, 2)
    return SlowCurve(time, value, np.gradient(value, time), np.full(time.size, UNKNOWN_PHASE_SD))


def _smoothed(errors: list[PhaseError], axis: AxisMotion, phase: SlowCurve, name: str) -> SlowCurve:
    """The phase plus its errors in short parts, smoothed; unchanged where the picture determines none."""
    parts = [error.parts for error in errors if error.parts is not None]
    time, values, sds = (np.concatenate(column) for column in zip(*parts, strict=True))
    time, value, sd = axis.angle.start + time, values[:, AXES.index(name)], sds[:, AXES.index(name)]
    used = np.isfinite(value) & np.isfinite(sd)
    if used.sum() < 2:
        return phase._replace(sd=np.full(phase.time.size, UNKNOWN_PHASE_SD))
    here, _ = interpolate_curve(phase, time[used])
    return smooth_curve(time[used], here + value[used], sd[used])


def _constant(value: float, intensity: Channel, sd: float = 0.0) -> SlowCurve:
    """A curve of one value."""
    return SlowCurve(np.array([intensity.start, intensity.end]), np.full(2, value), np.zeros(2), np.full(2, sd))


def _corrected_amplitudes(
    motion: Motion, logs: Mapping[str, SlowCurve], intensity: Channel, grid: Grid, windows: list[tuple[int, int]]
) -> dict[str, SlowCurve]:
    """The logarithms of the amplitudes with the changes during the scan that the picture shows."""
    times, changes = [], []
    for first, stop in windows:
        values = intensity.read(first, stop)
        values = values.mean(axis=1) if values.ndim == 2 else values
        finite = np.isfinite(values)
        parts = max(1, round((stop - first) / intensity.sample_rate / slow_period(motion) / PERIODS_PER_AMPLITUDE))
        part = np.arange(stop - first) * parts // (stop - first)
        x, y = (motion.axes[name].angle.read(first, stop)[finite] for name in AXES)
        changes.append(measure_amplitude_changes(x, y, values[finite], part[finite], parts, grid))
        times.append(
            intensity.start + (first + (np.arange(parts) + 0.5) / parts * (stop - first)) / intensity.sample_rate
        )
    time = np.concatenate(times)
    value, sd = (np.concatenate([getattr(change, key) for change in changes]) for key in ("value", "sd"))
    corrected = dict(logs)
    for column, name in enumerate(AXES):
        used = np.isfinite(sd[:, column])
        if used.sum() < 2:
            continue
        here, _ = interpolate_curve(logs[name], time[used])
        corrected[name] = smooth_curve(time[used], here + value[used, column], sd[used, column])
    return corrected


def _has_converged(before: SlowCurve, after: SlowCurve) -> bool:
    change = after.value - interpolate_curve(before, after.time)[0]
    return bool(np.sqrt(np.mean(change**2)) < CONVERGENCE_SD * np.sqrt(np.mean(after.sd**2)))


def _describe_unused_mechanics(recording: Recording, device: Device) -> list[str]:
    """A line on mechanics that the device states and that determine nothing here."""
    missing = missing_for_motion(recording, device)
    if missing is None or not any(axis.mechanics for axis in device.axes.values()):
        return []
    return [f"J, b and k of the device are not used, because {missing}: with the drives they determine the amplitude"]


def _notes(measured: Mapping[str, int], slices: int) -> list[str]:
    """What the picture showed, and what it cannot show."""
    shown = " and ".join(f"of {name} in {measured[name]} of {slices} slices" for name in AXES)
    notes = [
        f"the phases were measured in the picture itself, {shown} of the scan; only the frequencies were used",
        "the picture does not determine the scale of the amplitudes: the largest is taken to fill the field; only its "
        "changes during the scan were measured",
    ]
    notes += [
        f"the picture shows the phase of {name} in {measured[name]} of {slices} slices only (no feature across it, too "
        f"few samples, or a wrong drive frequency): the samples may be mapped to wrong places along {name}"
        for name in AXES
        if measured[name] < MIN_FOUND_FRACTION * slices
    ]
    return notes
