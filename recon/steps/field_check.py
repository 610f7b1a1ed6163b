"""Whether the stated field of view fits the motion: a picture that is empty or tiny is refused or explained."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import acos, log, pi, sqrt

import numpy as np

from recon.imaging.picture import Grid, Picture
from scanner.arrays import Array
from scanner.device import AXES
from scanner.device_templates import MAX_MIRROR_ANGLE_RAD
from scanner.errors import DeviceInvalid
from scanner.motion import AxisMotion, Motion

MAX_OUTSIDE_FRACTION = 0.05
"""Fraction of the samples outside the field of view from which a note says so. A field that the amplitude fills loses
samples at the turning points only."""

MAX_OUTSIDE_FRACTION_ALLOWED = 0.5
"""Fraction from which the picture is refused: most of what was recorded would be missing."""

MAX_CENTRE_FRACTION = 0.2
"""Distance of a motion's centre from that of the field, over its amplitude, above which a note says so: a fifth of the
field is then empty on one side. Scans that are centred on purpose are within a tenth."""

MIN_AMPLITUDE_FRACTION = 0.75
"""Amplitude over half angle below which a note says so: a half of the pixels is then never visited, however long the
scan. Fields are stated to a few percent; a wrong constant of the readout or an optical angle changes more."""

OTHER_UNITS = {"degrees": pi / 180.0, "mrad": 1e-3}
"""Units of angle that half angles are stated in by mistake, in rad."""

INSPECTED_PARTS, INSPECTED_SAMPLES = 64, 4096
"""Parts of a scan and samples of each in which the largest angle is looked for: 0.3 million samples of any scan."""

CENTRE_QUANTILES = (0.1, 0.9)
"""Quantiles of the angle whose mean is the centre of a motion. The noise of single samples does not move them."""

UNIT_MATCH = 2.5
"""Factor within which a half angle, read in another unit, has to agree with the amplitude to be taken for that unit.
Degrees and mrad differ by 17, so that at most one of them agrees."""


def check_units(grid: Grid, motion: Motion) -> None:
    """Check that half angles are no degrees or mrad.

    Raises:
        DeviceInvalid: a half angle far above the amplitude would agree with it in another unit.
    """
    for name, half, amplitude in zip(AXES, grid.reported_half_angles, _amplitudes(grid, motion), strict=True):
        for unit, in_rad in OTHER_UNITS.items():
            if half > 1.0 and 1 / UNIT_MATCH < half * in_rad / amplitude < UNIT_MATCH:
                raise DeviceInvalid(
                    f"is {half:g} rad and looks like {unit}: the amplitude is {amplitude:.4g} rad, and "
                    f"{half:g} {unit} are {half * in_rad:.4g} rad",
                    channel=f"scan.half_angle_{name}",
                    hint="state it in rad",
                )


def check_field(
    picture: Picture,
    motion: Motion,
    allow_outside: bool,
    sample_moved: bool = False,
    clock_notes: Sequence[str] = (),
) -> list[str]:
    """Notes on samples outside the field, and on a field that the motion hardly covers.

    Args:
        picture: with the count of samples outside.
        motion: of the mirror.
        allow_outside: accept that most samples lie outside.
        sample_moved: whether the places of the samples were corrected for a motion of the specimen.
        clock_notes: why the sample rates are doubted; with a wrong one, few samples are mapped, at any place.

    Raises:
        DeviceInvalid: most samples lie outside.
    """
    grid = picture.grid
    half, amplitude = grid.reported_half_angles, _amplitudes(grid, motion)
    sizes = _describe_sizes(amplitude, half)
    share = picture.outside / max(picture.outside + int(picture.coverage.sum()), 1)
    notes = []
    if share > MAX_OUTSIDE_FRACTION:
        what = f"{share:.0%} of the samples lie outside the field of view ({sizes}; {grid.angle} angles)"
        if share > MAX_OUTSIDE_FRACTION_ALLOWED and not allow_outside:
            fields = "half_angle_x and half_angle_y, or angle, in [scan]"
            hint = f"correct {fields}, or the gain of the sensors; --allow-outside makes the picture anyway"
            if max(amplitude) > MAX_MIRROR_ANGLE_RAD:
                hint = (
                    f"no mirror turns so far: check gain in [x.readout], in V/rad, or the unit of the angles; or {hint}"
                )
            raise DeviceInvalid(what, channel="scan", hint="; or: ".join((*clock_notes, hint)))
        notes.append(f"{what}; {_explain_outside(grid, motion, sample_moved)}")
    notes += _describe_centres(grid, motion)
    if any(a < MIN_AMPLITUDE_FRACTION * h for a, h in zip(amplitude, half, strict=True)):
        notes.append(
            f"the motion covers little of the field of view ({sizes}; {grid.angle} angles); check [scan] and the "
            "readout's constants in the device"
        )
    return notes


def _explain_outside(grid: Grid, motion: Motion, sample_moved: bool) -> str:
    """What moves samples out of the field, and what to do: the end of a note."""
    half_angles = dict(zip(AXES, (grid.half_angle_x, grid.half_angle_y), strict=True))
    if sample_moved and _share_outside(half_angles, motion) <= MAX_OUTSIDE_FRACTION:
        return "the sample moved there during the scan; a larger field in [scan] shows them"
    centres = {name: _centre(motion.axes[name]) for name in AXES}
    centred = _share_of_sines(half_angles, motion, dict.fromkeys(AXES, 0.0))
    off_centre = _share_of_sines(half_angles, motion, centres)
    if centred <= MAX_OUTSIDE_FRACTION < off_centre:
        name = max(AXES, key=lambda each: abs(centres[each]) / half_angles[each])
        centre = grid.angle_scale * centres[name]
        return f"{name} is centred at {centre:+.4g} rad: check offset in [{name}.readout] of the device"
    noisy = any(axis.angle_noise_sd for axis in motion.axes.values())
    if noisy and off_centre <= MAX_OUTSIDE_FRACTION:
        return "the noise of the position signals moves them there; --estimator tracker filters it"
    return "check [scan] and the gain, unless intended"


def _share_of_sines(half_angles: Mapping[str, float], motion: Motion, centres: Mapping[str, float]) -> float:
    """Share of the time that sines of the motion's amplitudes about ``centres`` are outside the field, all in rad."""
    share = 0.0
    for name, half in half_angles.items():
        amplitude = float(np.mean(motion.axes[name].amplitude))
        for side in (1.0, -1.0):
            share += acos(min(max((half - side * centres[name]) / amplitude, -1.0), 1.0)) / pi
    return share


def _share_outside(half_angles: Mapping[str, float], motion: Motion) -> float:
    """Share of the inspected samples outside the field of the given half angles [rad]."""
    outside = [np.abs(_inspected_angles(motion.axes[name])) > half for name, half in half_angles.items()]
    return float(np.mean(np.logical_or(*outside)))


def own_half_angle(axis: AxisMotion) -> float:
    """Half angle of the field that a motion covers [rad]: its amplitude, or the largest angle where it is no sine."""
    amplitude, largest = float(np.max(axis.amplitude)), float(np.max(np.abs(_angle_range(axis))))
    return largest if largest > amplitude / (1.0 - MAX_OUTSIDE_FRACTION) else amplitude


def _describe_centres(grid: Grid, motion: Motion) -> list[str]:
    """A note on each axis whose motion is not centred in the field."""
    notes = []
    for name in AXES:
        low, high = _angle_range(motion.axes[name])
        centre, swing = 0.5 * (low + high), 0.5 * (high - low)
        if abs(centre) > MAX_CENTRE_FRACTION * swing:
            notes.append(
                f"{name} is centred at {grid.angle_scale * centre:+.4g} rad, and moves by ±"
                f"{grid.angle_scale * swing:.4g} rad around it: check offset in [{name}.readout] of the device"
            )
    return notes


def _describe_sizes(amplitude: Sequence[float], half: Sequence[float]) -> str:
    return ", ".join(f"{name} up to {a:.4g} of {h:.4g} rad" for name, a, h in zip(AXES, amplitude, half, strict=True))


def _amplitudes(grid: Grid, motion: Motion) -> list[float]:
    """Largest angle of x and y as reports state it [rad], in samples from all over the scan.

    The amplitude itself is that of a sine, which a spiral or a slow scan is not.
    """
    return [grid.angle_scale * _largest_angle(motion.axes[name]) for name in AXES]


def _largest_angle(axis: AxisMotion) -> float:
    """Largest angle of an axis [rad], without the noise of single samples, of which the largest of n is about
    sqrt(2 ln n) standard deviations (Cramér 1946, section 28.6)."""
    largest = max(map(abs, _angle_range(axis)))
    noise = axis.angle_noise_sd * sqrt(2.0 * log(INSPECTED_PARTS * INSPECTED_SAMPLES))
    return min(largest, max(float(np.max(axis.amplitude)), largest - noise))


def _angle_range(axis: AxisMotion) -> tuple[float, float]:
    """Smallest and largest angle of an axis [rad]."""
    angles = _inspected_angles(axis)
    if not np.isfinite(angles).any():
        return -float(np.max(axis.amplitude)), float(np.max(axis.amplitude))
    return float(np.nanmin(angles)), float(np.nanmax(angles))


def _centre(axis: AxisMotion) -> float:
    """Centre of a motion that is symmetric about it [rad], from quantiles, which average over noise."""
    angles = _inspected_angles(axis)
    known = angles[np.isfinite(angles)]
    return float(np.mean(np.quantile(known, CENTRE_QUANTILES))) if known.size else 0.0


def _inspected_angles(axis: AxisMotion) -> Array:
    """Angles of an axis in parts all over the scan, shape (n,) [rad]."""
    firsts = np.linspace(0, max(axis.angle.size - INSPECTED_SAMPLES, 0), INSPECTED_PARTS).astype(int)
    return np.concatenate([axis.angle.read(first, first + INSPECTED_SAMPLES) for first in np.unique(firsts).tolist()])
