"""Sign with which an axis goes on after it nearly rested, by the picture.

An even capacitance shows the motion except for its sign. Where the amplitude vanishes, as beside a coupled mode or
between two drives, the noise decides in which direction the estimated phase turns, and with it the sign of the motion
that follows. With the wrong one, the later part of the scan shows the specimen mirrored.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from scipy.ndimage import label

from estimation.optics.correction import beam_motion
from recon.imaging.intensity_gridding import grid_intensity
from recon.imaging.picture import Grid, Picture
from recon.steps.field_check import own_half_angle
from scanner.arrays import Array
from scanner.channel import Channel
from scanner.device import AXES, Device
from scanner.motion import AxisMotion, Motion

REST_AMPLITUDE = 0.25
"""Amplitude over its root mean square below which an axis nearly rests. In scans with a coupled mode the phase turned
in the wrong direction at 0.13 and below."""

PIXELS = 200
"""Pixels of the compared pictures in either direction: half of a usual picture, so that sparse parts meet."""

PIXELS_PER_DETAIL = 25
"""Pixels that deviate together: a detail of the specimen and an error of the phase reach over some pixels each way."""

LISTED_TIMES = 3
"""Times that a note lists."""

MIN_EVIDENCE = 25.0
"""Twice the log likelihood ratio of the two signs from which the picture decides: five standard deviations."""


def follow_signs(motion: Motion, device: Device, intensity: Channel, origin: float) -> tuple[Motion, list[str]]:
    """The motion with the same sign before and after every time at which an axis nearly rests.

    Args:
        motion: of the mirror; only axes whose sign is ambiguous, or was chosen by the user, are changed.
        device: with the terms of its optics.
        intensity: shape (n,) or (n, detectors).
        origin: start of the recording [s].

    Returns:
        The motion, and a line on the times after which a sign was changed, and on those after which it is unknown.
    """
    notes = []
    for name, axis in motion.axes.items():
        rests = find_rests(axis) if axis.sign in ("ambiguous", f"known: --flip-{name}") else []
        inner = [round((time - intensity.start) * intensity.sample_rate) for time in rests]
        edges = np.clip([0, *inner, intensity.size], 0, intensity.size).tolist()
        lead, sign = np.zeros(axis.time.size), 1
        changed, unknown = list[float](), list[float]()
        signs = _signs_of_parts(motion, device, intensity, origin, edges, name)
        for time, (found, is_determined) in zip(rests, signs, strict=True):
            if not is_determined:
                unknown.append(time)
            elif found != sign:
                changed.append(time)
            lead[axis.time >= time] += 0.5 * np.pi * (found - sign)
            sign = found
        if changed:
            notes.append(f"{name} nearly rests {_at(changed)}: its sign after that was changed, as the picture shows")
        if unknown:
            notes.append(f"{name} nearly rests {_at(unknown)}: the picture does not show its sign after that")
        if lead.any():
            motion = replace(motion, axes={**motion.axes, name: axis.advanced(lead)})
    return motion, notes


def _at(times: Sequence[float]) -> str:
    """The first times of a list, and how many more there are."""
    more = f" and {len(times) - LISTED_TIMES} more times" if len(times) > LISTED_TIMES else ""
    return "at " + ", ".join(f"{time:.4g} s" for time in times[:LISTED_TIMES]) + more


def find_rests(axis: AxisMotion) -> list[float]:
    """Times of the smallest amplitudes between parts of a motion between which it nearly rests [s]."""
    moves = axis.amplitude > REST_AMPLITUDE * np.sqrt(np.mean(axis.amplitude**2))
    parts, count = label(moves)
    ends = [np.flatnonzero(parts == part)[[0, -1]] for part in range(1, count + 1)]
    gaps = [np.arange(before[1], after[0] + 1) for before, after in pairwise(ends)]
    return [float(axis.time[gap[np.argmin(axis.amplitude[gap])]]) for gap in gaps]


def _signs_of_parts(
    motion: Motion, device: Device, intensity: Channel, origin: float, edges: Sequence[int], name: str
) -> Iterator[tuple[int, bool]]:
    """Sign by which each later part of a scan shows the scene of the first, and whether the picture determines it.

    A part is compared with the picture of all parts before it. One whose sign is not determined takes that of the part
    before it.

    Args:
        edges: samples at which the parts begin and end.
        name: of the axis.
    """
    if len(edges) < 3:
        return
    beam = beam_motion(motion, device, origin)
    half_x, half_y = (own_half_angle(motion.axes[axis]) for axis in AXES)
    grid = Grid(PIXELS, PIXELS, half_x, half_y)
    parts = (_sums(grid_intensity(beam, intensity, grid, [], first, stop)) for first, stop in pairwise(edges))
    across = 1 if name == "x" else 0
    (total, count), sign = next(parts), 1
    for sums in parts:
        mirrored = [np.flip(values, across) for values in sums]
        evidence = _misfit(total, count, *mirrored) - _misfit(total, count, *sums)
        is_determined = abs(evidence) > MIN_EVIDENCE
        sign = int(np.sign(evidence)) if is_determined else sign
        more, visits = sums if sign > 0 else mirrored
        total, count = total + more, count + visits
        yield sign, is_determined


def _sums(picture: Picture) -> tuple[Array, Array]:
    """Sum of the samples of every pixel, over all detectors, and their number, shape (height, width)."""
    image = picture.image.reshape(*picture.coverage.shape, -1).mean(axis=2, dtype=float)
    return np.where(picture.coverage > 0, image * picture.coverage, 0.0), picture.coverage.astype(float)


def _misfit(total: Array, count: Array, other_total: Array, other_count: Array) -> float:
    """-2 log likelihood that two pictures show one scene with any brightness and contrast, over their common pixels."""
    common = (count > 0.0) & (other_count > 0.0)
    if common.sum() <= PIXELS_PER_DETAIL:
        return 0.0
    first, second = total[common] / count[common], other_total[common] / other_count[common]
    deviation, other = first - first.mean(), second - second.mean()
    scale = float((deviation @ deviation) * (other @ other))
    correlation = max(float(deviation @ other), 0.0) / np.sqrt(scale) if scale > 0.0 else 0.0
    return float(common.sum() / PIXELS_PER_DETAIL * np.log1p(-(min(correlation, 1.0 - 1e-12) ** 2)))
