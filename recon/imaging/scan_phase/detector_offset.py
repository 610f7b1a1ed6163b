"""The place of a detector with edges of one direction, and the change of the amplitude, from the picture.

The beam passes a detector at the angle a at the phase α = arcsin(a / A). Edges of both directions show α by their long
and short intervals; edges of one direction do not, and their phase is wrong by α. While the amplitude A falls, α grows.
Samples of one place in opposite directions show α in each slice of the scan, at any amplitude (``phase_search``), and
sin α = a / A(t) then states the amplitude up to a factor, as a is not known.

A constant α is a late signal as well, which ``readout_phase`` measures, so that only one that changes is removed here.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from recon.imaging.picture import Grid
from recon.imaging.scan_phase.phase_search import (
    MIN_CORRELATION_SD,
    MIN_FOUND_FRACTION,
)
from recon.imaging.scan_phase.slice_search import SEARCH_ROUNDING_SD_RAD, search_slices, searched_slices
from scanner.angle_tracks import SampledAngle
from scanner.arrays import Array
from scanner.channel import Channel
from scanner.device import AXES
from scanner.motion import AxisMotion, Motion

MIN_SLICES = 4
"""Slices from which a change is estimated: a line and the scatter about it."""

MAX_DEGREE = 2
"""Largest degree of the polynomial of sin α in time: within 1 % of one over an exponential that falls to a half."""

SIGNIFICANT_SDS = 5.0
"""Standard deviations from which sin α changes, and from which it determines the amplitude: by chance once in 1e6."""

MIN_COSINE = 0.2
"""Least cos α in the standard deviation of α: within 12 degrees of the turning point, α is not linear in sin α."""

SCATTER_CELLS = 64
"""Cells along each axis of the field in which samples are compared, as few as visit each of them several times."""


class DetectorOffset(NamedTuple):
    """Phase α at which the beam passes the detector of an axis.

    Attributes:
        value, sd: at the times of the motion, shape (n,) [rad].
        relative_amplitude: amplitude over its largest value, shape (n,); None where sin α does not determine it.
    """

    value: Array
    sd: Array
    relative_amplitude: Array | None


def one_direction_axes(motion: Motion) -> list[str]:
    """Names of the axes whose phase is that of edges of one direction."""
    return [name for name in motion.axes if stated_event(motion, name).startswith("zero-crossing")]


def stated_event(motion: Motion, name: str) -> str:
    """What the edges of an axis state that an edge is; empty for an axis without edges."""
    stated = motion.info.get(f"sync_{name}")
    return str(stated.get("event", "")) if isinstance(stated, dict) else ""


def remove_detector_offsets(
    motion: Motion, to_beam: Callable[[Motion], Motion], intensity: Channel, grid: Grid
) -> tuple[Motion, list[str]]:
    """The motion without the changing phase at which detectors of one direction are passed, and a line for each axis.

    A correction, and the amplitude that belongs to it, are used if samples of one place then differ less.

    Args:
        motion: of the mirror.
        to_beam: the motion of the beam for a motion of the mirror.
        intensity: shape (n,) or (n, detectors); detectors are averaged.
        grid: the pixels.
    """
    notes: list[str] = []
    names = one_direction_axes(motion) if set(motion.axes) == set(AXES) else []
    for _ in AXES:  # an axis whose amplitude is followed makes the other one clearer
        if not names:
            break
        offsets = measure_detector_offsets(motion, to_beam(motion), intensity, names)
        found = [name for name in names if name in offsets]
        for name in found:
            motion, line = _better_motion(motion, name, offsets[name], to_beam, intensity, grid)
            notes += line
        names = [name for name in names if name not in found]
        if not found:
            break
    return motion, notes


def _better_motion(
    motion: Motion,
    name: str,
    offset: DetectorOffset,
    to_beam: Callable[[Motion], Motion],
    intensity: Channel,
    grid: Grid,
) -> tuple[Motion, list[str]]:
    """The motion with the least scatter: as it is, without the offset of one axis, or with its amplitude too."""
    amplitudes = [None] if offset.relative_amplitude is None else [None, offset.relative_amplitude]
    axes = [_without_offset(motion.axes[name], offset, amplitude) for amplitude in amplitudes]
    candidates = [motion, *(replace(motion, axes={**motion.axes, name: axis}) for axis in axes)]
    best = int(np.argmin([place_scatter(to_beam(each), intensity, grid) for each in candidates]))
    return candidates[best], [_describe(name, offset, amplitudes[best - 1])] if best else []


def measure_detector_offsets(
    motion: Motion, beam: Motion, intensity: Channel, names: Collection[str]
) -> dict[str, DetectorOffset]:
    """The phases α that change during the scan.

    Args:
        motion, beam: of the mirror and of the beam, whose angles are on the intensity's clock.
        intensity: shape (n,) or (n, detectors); detectors are averaged.
        names: of the axes whose edges are of one direction.
    """
    slices = searched_slices(beam, intensity)
    searched = search_slices(beam, intensity, slices)
    offsets = {}
    for name in names:
        found = [(intensity.start + each.time, each.phase(name)) for each in searched]
        pairs = [(time, phase.value) for time, phase in found if phase.significance >= MIN_CORRELATION_SD]
        if len(pairs) >= max(MIN_SLICES, MIN_FOUND_FRACTION * len(slices)):
            time, value = np.array(pairs).T
            offset = fit_offset(time, value, motion.axes[name].time)
            if offset is not None:
                offsets[name] = offset
    return offsets


def fit_offset(time: Array, value: Array, at: Array) -> DetectorOffset | None:
    """Fit sin α as a polynomial of time, of the degree with the least Bayesian information criterion.

    Args:
        time, value: middle of each slice and its α, shape (n,) [s, rad].
        at: times of the result, shape (m,) [s].

    Returns:
        None if α does not change significantly.
    """
    scale = max(float(np.ptp(time)), np.finfo(float).tiny) / 2.0
    u, v, sine = (time - time.mean()) / scale, (at - time.mean()) / scale, np.sin(value)
    sd = SEARCH_ROUNDING_SD_RAD * np.maximum(np.cos(value), MIN_COSINE)

    def fit(degree: int) -> tuple[float, Array, Array]:
        """Criterion, coefficients and their covariance; the scatter about the fit may widen the errors."""
        design = np.vander(u, degree + 1, increasing=True)
        normal = np.linalg.inv((design / sd[:, None] ** 2).T @ design)
        coefficients = normal @ (design / sd[:, None] ** 2).T @ sine
        chi2 = float(np.sum(((sine - design @ coefficients) / sd) ** 2))
        excess = max(1.0, chi2 / (time.size - degree - 1))
        return chi2 + (degree + 1) * np.log(time.size), coefficients, normal * excess

    fits = [fit(degree) for degree in range(min(MAX_DEGREE, time.size - 3) + 1)]
    _, coefficients, covariance = min(fits, key=lambda each: each[0])
    design = np.vander(v, coefficients.size, increasing=True)
    steps = design - design[:1]
    change = np.abs(steps @ coefficients)
    change_sd = np.sqrt(np.einsum("ij,jk,ik->i", steps, covariance, steps))
    if not np.any(change > SIGNIFICANT_SDS * np.maximum(change_sd, np.finfo(float).tiny)):
        return None
    fitted = np.clip(design @ coefficients, -1.0, 1.0)
    fitted_sd = np.sqrt(np.einsum("ij,jk,ik->i", design, covariance, design))
    is_known = bool(np.all(np.abs(fitted) > SIGNIFICANT_SDS * fitted_sd) and np.ptp(np.sign(fitted)) == 0.0)
    alpha = np.arcsin(fitted)
    alpha_sd = fitted_sd / np.maximum(np.cos(alpha), MIN_COSINE)
    return DetectorOffset(alpha, alpha_sd, np.abs(fitted).min() / np.abs(fitted) if is_known else None)


def place_scatter(beam: Motion, intensity: Channel, grid: Grid) -> float:
    """Mean variance of the samples of one cell of the field: of those that the beam takes at one place."""
    values = intensity.read()
    values = values.mean(axis=1) if values.ndim == 2 else values
    x, y = (
        np.floor((beam.axes[name].angle.read() / half + 1.0) / 2.0 * SCATTER_CELLS)
        for name, half in zip(AXES, (grid.half_angle_x, grid.half_angle_y), strict=True)
    )
    known = np.isfinite(x) & np.isfinite(y) & np.isfinite(values)
    known &= (np.minimum(x, y) >= 0) & (np.maximum(x, y) < SCATTER_CELLS)
    if not known.any():
        return np.inf
    cell = (y[known] * SCATTER_CELLS + x[known]).astype(np.int64)
    centred = values[known] - values[known].mean()
    count, first, second = (np.bincount(cell, centred**power) for power in range(3))
    repeated = count > 1
    squares = second[repeated] - first[repeated] ** 2 / count[repeated]
    return float(squares.sum() / max(np.sum(count[repeated] - 1), 1))


def describe_unstated_place(name: str, event: str) -> str:
    """The line on an axis whose phase rests on the stated event of its edges alone."""
    return (
        f"sync_{name}: the phase of {name} rests on event = {event}, because the picture determines none. Edges of one "
        "direction do not show how far the detector is from the centre: an offset of 1 % of the amplitude shifts the "
        "phase by 0.6°, more while the amplitude falls. If it is not in the centre, record the edges of both "
        "directions and state angle in rad"
    )


def _without_offset(axis: AxisMotion, offset: DetectorOffset, relative_amplitude: Array | None) -> AxisMotion:
    """The motion ahead by α, with an amplitude that changes by ``relative_amplitude``, shape (n,), if it is given."""
    ahead = replace(axis.advanced(offset.value), phase_sd=np.hypot(axis.phase_sd, offset.sd))
    if relative_amplitude is None:
        return ahead
    angle = ahead.angle
    time = angle.start + np.arange(angle.size) / angle.sample_rate
    values = angle.read() * np.interp(time, axis.time, relative_amplitude)
    scaled = SampledAngle(values, angle.sample_rate, angle.start)
    return replace(ahead, amplitude=axis.amplitude * relative_amplitude, angle=scaled)


def _describe(name: str, offset: DetectorOffset, relative_amplitude: Array | None) -> str:
    """The line on an axis from which an offset was removed."""
    first, last = np.degrees(offset.value[[0, -1]])
    line = (
        f"sync_{name}: the picture shows that the beam passes the detector {first:.3g}° after the centre at the "
        f"beginning and {last:.3g}° after it at the end of the scan; the phase was corrected by it"
    )
    if relative_amplitude is None:
        return line + "; the amplitude does not change with it: check the sample rate of the intensity"
    ratio = relative_amplitude[-1] / relative_amplitude[0]
    return line + (
        f", and the amplitude, which {'falls' if ratio < 1.0 else 'grows'} to {ratio:.3g} of its first value as the "
        "angle of the detector is constant. Its scale is not determined"
    )
