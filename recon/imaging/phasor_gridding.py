"""Gridding directly from slow phase and amplitude: no angle is stored and no sine is computed for a sample.

The positions of a segment are first computed in single precision, eight samples at a time, by rotation of phasors as in
``estimation.tracker.angle_synthesis``. If a position is too close to a pixel's edge for this precision, the angles of
the segment are computed in double precision. The counts so equal those of ``gridding.accumulate_samples`` exactly.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from estimation.tracker.angle_synthesis import (
    PHASOR_BATCH,
    SEGMENT_SAMPLES,
    fill_phasor_powers,
    synthesise_segment,
)
from recon.imaging.gridding import OUTSIDE_INDEX, accumulate_in_parts, add_to_pixels, find_pixels
from recon.imaging.picture import Grid
from scanner.angle_tracks import PhasorTrack
from scanner.errors import BadInput

POSITION_BITS = 23
"""Bits of a position across the field: all bits of a single-precision mantissa."""

PHASOR_ROUNDINGS = 5.0
"""Bound on the rounding error of a position, in halves of the last bit of the amplitude: phasors, factors and sums."""

HARMONIC_ROUNDINGS = 20.0
"""The same bound for the third and fifth harmonics, whose phasors are powers of the first one's."""

SEGMENTS_PER_BLOCK = 32
"""Segments gridded before their values are added. Adding evicts the phasor tables from the first-level cache, so it is
done rarely."""

MAX_ROTATION_OFFSET_RAD = 1e-7
"""Difference of the rotation per sample from that of the phasor table up to which the table is used again, with a
first-order correction. Over 256 samples the neglected term is below single precision."""

RAMP = np.arange(SEGMENT_SAMPLES, dtype=np.float32)


@numba.njit(cache=True, error_model="numpy")
def _fraction_bits(pixels):  # type: ignore[no-untyped-def]
    """Bits for the fraction of a pixel: as many as keep positions across ``pixels`` below 2^POSITION_BITS."""
    bits = POSITION_BITS
    while bits > 0 and pixels << bits > 1 << POSITION_BITS:
        bits -= 1
    return bits


@numba.njit(cache=True, error_model="numpy", fastmath={"contract"})
def _fill_table(turn, re, im, table):  # type: ignore[no-untyped-def]
    """Tabulate the phasors of a segment that begin at 1, their products with the sample number, third and fifth powers.

    ``table``: shape (8 SEGMENT_SAMPLES,), real and imaginary parts in turn. One array needs no check for overlap before
    eight samples are computed at a time.
    """
    fill_phasor_powers(turn, re, im)
    for i in range(SEGMENT_SAMPLES):
        c, s = np.float32(re[i]), np.float32(im[i])
        c2, s2 = c * c - s * s, np.float32(2.0) * c * s
        c3, s3 = c * c2 - s * s2, c * s2 + s * c2
        table[i], table[SEGMENT_SAMPLES + i] = c, s
        table[2 * SEGMENT_SAMPLES + i], table[3 * SEGMENT_SAMPLES + i] = RAMP[i] * c, RAMP[i] * s
        table[4 * SEGMENT_SAMPLES + i], table[5 * SEGMENT_SAMPLES + i] = c3, s3
        table[6 * SEGMENT_SAMPLES + i], table[7 * SEGMENT_SAMPLES + i] = c3 * c2 - s3 * s2, c3 * s2 + s3 * c2


@numba.njit(cache=True, error_model="numpy")
def _rotation_offset(turn, tabulated, re, im, table):  # type: ignore[no-untyped-def]
    """Difference [rad] of a rotation from ``tabulated``, shape (1,), for which ``table`` was filled.

    If it exceeds ``MAX_ROTATION_OFFSET_RAD``, the table is recomputed.
    """
    offset = (turn * tabulated[0].conjugate()).imag
    if abs(offset) < MAX_ROTATION_OFFSET_RAD:
        return offset
    tabulated[0] = turn
    _fill_table(turn, re, im, table)
    return 0.0


@numba.njit(cache=True, error_model="numpy", forceinline=True)
def _segment_lines(axis, s):  # type: ignore[no-untyped-def]
    """First phasor of segment ``s``, its first harmonic and change per sample, its third and fifth at the middle.

    Returns numbers, not arrays: reference counting of passed arrays took a third of the time.
    """
    first, step = axis[2][s, 0], axis[3][s, 0].imag
    third = axis[2][s, 1] + 0.5 * SEGMENT_SAMPLES * axis[3][s, 1]
    fifth = axis[2][s, 2] + 0.5 * SEGMENT_SAMPLES * axis[3][s, 2]
    return axis[0][s], first, step, third, fifth


@numba.njit(cache=True, error_model="numpy", forceinline=True, fastmath={"contract"})
def _find_positions(line, scale, across, offset, table, out):  # type: ignore[no-untyped-def]
    """Write the positions of a segment [2^-bits pixels] into ``out``, float32; False if rounding may exceed a unit.

    The law is that of ``synthesise_segment`` for harmonics 1, 3 and 5. ``line``: see ``_segment_lines``. ``scale``:
    units by radian. ``across``: units in the field. ``offset``: see ``_rotation_offset``; its first-order effect is
    added to the ramp of the first harmonic.
    """
    u, first, step, third, fifth = line
    size, harmonics = abs(first.imag) + SEGMENT_SAMPLES * abs(step), _size(third) + _size(fifth)
    rounding = scale * (PHASOR_ROUNDINGS * size + HARMONIC_ROUNDINGS * harmonics)
    if not rounding + across < 1 << (POSITION_BITS + 2):  # "not <" also rejects NaN
        return False
    # Real arithmetic: numba would multiply real and imaginary factors as complex numbers.
    c, d = u.real, u.imag
    c2, d2 = c * c - d * d, 2.0 * c * d
    c3, d3 = c * c2 - d * d2, c * d2 + d * c2
    c5, d5 = c3 * c2 - d3 * d2, c3 * d2 + d3 * c2
    a1, b1, grows = -scale * first.imag * d, scale * first.imag * c, scale * step
    ramp_a, ramp_b = np.float32(-grows * d - offset * b1), np.float32(grows * c + offset * a1)
    a3 = np.float32(scale * (third.real * c3 - third.imag * d3))
    b3 = np.float32(scale * (third.real * d3 + third.imag * c3))
    a5 = np.float32(scale * (fifth.real * c5 - fifth.imag * d5))
    b5 = np.float32(scale * (fifth.real * d5 + fifth.imag * c5))
    a1, b1, middle = np.float32(a1), np.float32(b1), np.float32(0.5 * across)
    for i in range(SEGMENT_SAMPLES):  # one term after the other: each is one fused multiply-add
        place = ramp_a * table[2 * SEGMENT_SAMPLES + i]
        place -= ramp_b * table[3 * SEGMENT_SAMPLES + i]
        place += a3 * table[4 * SEGMENT_SAMPLES + i]
        place -= b3 * table[5 * SEGMENT_SAMPLES + i]
        place += a5 * table[6 * SEGMENT_SAMPLES + i]
        place -= b5 * table[7 * SEGMENT_SAMPLES + i]
        place += a1 * table[i]
        place -= b1 * table[SEGMENT_SAMPLES + i]
        out[i] = middle + place
    return True


@numba.njit(cache=True)
def _size(z):  # type: ignore[no-untyped-def]
    """Upper bound on the modulus."""
    return abs(z.real) + abs(z.imag)


@numba.njit(cache=True, error_model="numpy", forceinline=True)
def _find_pixels_fast(x, y, values, width, height, bits_x, bits_y, index):  # type: ignore[no-untyped-def]
    """As ``gridding.find_pixels``, from positions; False if one is within a unit of a pixel's edge."""
    bits_x, bits_y = np.int32(bits_x), np.int32(bits_y)
    one, two, stride, nearest = np.int32(1), np.int32(2), np.int32(width), np.int32(2)
    last_x, last_y = np.int32((width << bits_x) - 1), np.int32((height << bits_y) - 1)
    fraction_x, fraction_y = np.int32((1 << bits_x) - 1), np.int32((1 << bits_y) - 1)
    for i in range(values.size):
        column, row = np.int32(x[i]), np.int32(y[i])
        beside_x, beside_y = np.int32(np.int32(column + one) & fraction_x), np.int32(np.int32(row + one) & fraction_y)
        nearest = min(nearest, beside_x, beside_y)
        beyond = np.int32(np.int32(column | np.int32(last_x - column)) | np.int32(row | np.int32(last_y - row)))
        inside = (beyond >= 0) & (values[i] == values[i])
        pixel = np.int32(np.int32(np.int32(row >> bits_y) * stride) + np.int32(column >> bits_x))
        index[i] = pixel if inside else np.int32(OUTSIDE_INDEX)
    return nearest >= two


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _accumulate(x, y, intensity, half_x, half_y, sums, counts, cells):  # type: ignore[no-untyped-def]
    height, width = counts.shape
    bits_x, bits_y = _fraction_bits(width), _fraction_bits(height)
    across_x, across_y = float(width << bits_x), float(height << bits_y)
    scale_x, scale_y = 0.5 * across_x / half_x, 0.5 * across_y / half_y
    theta_x, theta_y = np.empty(SEGMENT_SAMPLES), np.empty(SEGMENT_SAMPLES)
    index = np.empty(SEGMENTS_PER_BLOCK * SEGMENT_SAMPLES, np.int32)
    re, im = np.empty(PHASOR_BATCH), np.empty(PHASOR_BATCH)
    part_re, part_im = np.empty(SEGMENT_SAMPLES), np.empty(SEGMENT_SAMPLES)
    place_x, place_y = np.empty(SEGMENT_SAMPLES, np.float32), np.empty(SEGMENT_SAMPLES, np.float32)
    table_x, table_y = np.empty(8 * SEGMENT_SAMPLES, np.float32), np.empty(8 * SEGMENT_SAMPLES, np.float32)
    turn_x, turn_y = np.full(1, np.nan + 0j), np.full(1, np.nan + 0j)
    odd = x[2].shape[1] == 3 and y[2].shape[1] == 3
    for block in range(0, x[0].size, SEGMENTS_PER_BLOCK):
        for s in range(block, min(block + SEGMENTS_PER_BLOCK, x[0].size)):
            values = intensity[s * SEGMENT_SAMPLES : (s + 1) * SEGMENT_SAMPLES]
            segment_index = index[(s - block) * SEGMENT_SAMPLES :]
            certain = odd
            if certain:
                offset_x = _rotation_offset(x[1][s], turn_x, part_re, part_im, table_x)
                offset_y = _rotation_offset(y[1][s], turn_y, part_re, part_im, table_y)
                certain = _find_positions(_segment_lines(x, s), scale_x, across_x, offset_x, table_x, place_x)
                certain = certain and _find_positions(
                    _segment_lines(y, s), scale_y, across_y, offset_y, table_y, place_y
                )
            certain = certain and _find_pixels_fast(
                place_x, place_y, values, width, height, bits_x, bits_y, segment_index
            )
            if not certain:
                synthesise_segment(x[0][s], x[1][s], x[2][s], x[3][s], re, im, theta_x)
                synthesise_segment(y[0][s], y[1][s], y[2][s], y[3][s], re, im, theta_y)
                find_pixels(theta_x, theta_y, values, half_x, half_y, width, height, segment_index)
        values = intensity[block * SEGMENT_SAMPLES : (block + SEGMENTS_PER_BLOCK) * SEGMENT_SAMPLES]
        add_to_pixels(index, values, sums, counts, cells)


def accumulate_phasors(
    x: PhasorTrack,
    y: PhasorTrack,
    first: int,
    intensity: NDArray[Any],
    grid: Grid,
    sums: NDArray[np.float64] | None = None,
    counts: NDArray[np.uint32] | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.uint32]]:
    """Add samples to the sums and counts of their pixels, as ``gridding.accumulate_samples`` but from phasors.

    Args:
        x, y: angles on the intensity's clock.
        first: number of the first sample.
        intensity: shape (n,); NaN is left out.
        grid: the pixels.
        sums: shape (height, width); changed in place. New when None.
        counts: shape (height, width); changed in place. New when None.

    Returns:
        ``sums``, float64, and ``counts``, uint32.

    Raises:
        BadInput: an intensity that is not one-dimensional, or that is longer than the angles.
    """
    intensity = np.asarray(intensity)
    size = min(x.size, y.size)
    if intensity.ndim != 1 or first + intensity.size > size:
        raise BadInput(
            f"an intensity of shape {intensity.shape} from sample {first} on, for angles of {size} samples",
            hint="give one intensity for each angle",
        )
    sums = np.zeros((grid.height, grid.width)) if sums is None else sums
    counts = np.zeros((grid.height, grid.width), np.uint32) if counts is None else counts
    field = grid.half_angle_x, grid.half_angle_y, sums, counts

    def kernel(part: slice, cells: NDArray[np.int64]) -> None:
        values = intensity[part]
        run = first + part.start, first + part.start + values.size
        _accumulate(_segments(x, run), _segments(y, run), values, *field, cells)

    accumulate_in_parts(kernel, intensity, sums, counts)
    return sums, counts


def _segments(axis: PhasorTrack, run: tuple[int, int]) -> tuple[NDArray[np.complex128], ...]:
    """The segments of a run of samples as arrays, which compiled code takes."""
    segments = axis.cut_segments(*run)
    return segments.first_phasor, segments.step_phasor, segments.harmonics, segments.harmonic_steps
