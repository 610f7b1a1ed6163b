"""From slow phase and amplitude straight to the picture: no angle is stored and no sine taken for a sample.

A segment's places are first told in single precision, eight samples at a time, by turning phasors as
``estimation.tracker.angle`` does. Where one lies so near a pixel's edge that this could not tell its pixel, the
segment's angles are made in double precision: counts equal those of ``mapping.accumulate`` on them to the sample.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from estimation.tracker.angle import FINE, SEGMENT, SlowAngle, doubled, segment_angles
from recon.mapping import OUTSIDE, Grid, add_block, added, find_block
from scanner.errors import BadInput

PLACES = 23  # bits of a place across the field: all that single precision has
ROUNDED = 5.0  # roundings of half of the last bit in a place, in amplitudes: of phasors, factors and sums
POWERS = 20.0  # the same for a harmonic, whose phasor is a power of the first one's
TOGETHER = 32  # segments added up at a time: what adding takes of the first cache, tables have to be fetched back into
NEAR = 1e-7  # rad a sample by which a turn may be off its table's
RAMP = np.arange(SEGMENT, dtype=np.float32)


@numba.njit(cache=True, error_model="numpy")
def _bits(pixels):  # type: ignore[no-untyped-def]
    """Bits of a pixel's fraction: as many as leave places across ``pixels`` whole numbers below 2^PLACES."""
    bits = PLACES
    while bits > 0 and pixels << bits > 1 << PLACES:
        bits -= 1
    return bits


@numba.njit(cache=True, error_model="numpy", fastmath={"contract"})
def _tabulated(turn, re, im, table):  # type: ignore[no-untyped-def]
    """Phasors of a segment that begin at 1, the same times the sample's number, and their third and fifth powers.

    ``table``: shape (8 SEGMENT,), real and imaginary parts in turn, in one array so that nothing has to be told apart
    before eight samples are taken together.
    """
    doubled(turn, re, im)
    for i in range(SEGMENT):
        c, s = np.float32(re[i]), np.float32(im[i])
        c2, s2 = c * c - s * s, np.float32(2.0) * c * s
        c3, s3 = c * c2 - s * s2, c * s2 + s * c2
        table[i], table[SEGMENT + i] = c, s
        table[2 * SEGMENT + i], table[3 * SEGMENT + i] = RAMP[i] * c, RAMP[i] * s
        table[4 * SEGMENT + i], table[5 * SEGMENT + i] = c3, s3
        table[6 * SEGMENT + i], table[7 * SEGMENT + i] = c3 * c2 - s3 * s2, c3 * s2 + s3 * c2


@numba.njit(cache=True, error_model="numpy")
def _slip(turn, kept, re, im, table):  # type: ignore[no-untyped-def]
    """By how much a turn is off ``kept``, shape (1,), which ``table`` is made for; where it is much, both change."""
    slip = (turn * kept[0].conjugate()).imag
    if abs(slip) < NEAR:
        return slip
    kept[0] = turn
    _tabulated(turn, re, im, table)
    return 0.0


@numba.njit(cache=True, error_model="numpy", forceinline=True)
def _lines(axis, s):  # type: ignore[no-untyped-def]
    """Of segment ``s`` exp(i u), the first harmonic and its change a sample, the third and fifth in the middle.

    Numbers and no arrays: the references of an array that is handed on are counted, which took a third of the time.
    """
    first, step = axis[2][s, 0], axis[3][s, 0].imag
    third = axis[2][s, 1] + 0.5 * SEGMENT * axis[3][s, 1]
    fifth = axis[2][s, 2] + 0.5 * SEGMENT * axis[3][s, 2]
    return axis[0][s], first, step, third, fifth


@numba.njit(cache=True, error_model="numpy", forceinline=True, fastmath={"contract"})
def _placed(line, scale, across, slip, table, out):  # type: ignore[no-untyped-def]
    """Places of a segment in units of 2^-bits pixels into ``out``, float32; False where they may be off by a unit.

    As ``angle.segment_angles`` for harmonics 1, 3 and 5. ``line``: see ``_lines``. ``scale``: units by radian.
    ``across``: units in the field. ``slip``: see ``_slip``; it bends the first harmonic's ramp.
    """
    u, first, step, third, fifth = line
    size, harmonics = abs(first.imag) + SEGMENT * abs(step), _size(third) + _size(fifth)
    if not scale * (ROUNDED * size + POWERS * harmonics) + across < 1 << (PLACES + 2):  # or is not a number
        return False
    # in real numbers: a factor that is real or imaginary would be multiplied as a complex one
    c, d = u.real, u.imag
    c2, d2 = c * c - d * d, 2.0 * c * d
    c3, d3 = c * c2 - d * d2, c * d2 + d * c2
    c5, d5 = c3 * c2 - d3 * d2, c3 * d2 + d3 * c2
    a1, b1, grows = -scale * first.imag * d, scale * first.imag * c, scale * step
    ramp_a, ramp_b = np.float32(-grows * d - slip * b1), np.float32(grows * c + slip * a1)
    a3 = np.float32(scale * (third.real * c3 - third.imag * d3))
    b3 = np.float32(scale * (third.real * d3 + third.imag * c3))
    a5 = np.float32(scale * (fifth.real * c5 - fifth.imag * d5))
    b5 = np.float32(scale * (fifth.real * d5 + fifth.imag * c5))
    a1, b1, middle = np.float32(a1), np.float32(b1), np.float32(0.5 * across)
    for i in range(SEGMENT):  # one term after the other: each is a product and a sum in one instruction
        place = ramp_a * table[2 * SEGMENT + i]
        place -= ramp_b * table[3 * SEGMENT + i]
        place += a3 * table[4 * SEGMENT + i]
        place -= b3 * table[5 * SEGMENT + i]
        place += a5 * table[6 * SEGMENT + i]
        place -= b5 * table[7 * SEGMENT + i]
        place += a1 * table[i]
        place -= b1 * table[SEGMENT + i]
        out[i] = middle + place
    return True


@numba.njit(cache=True)
def _size(z):  # type: ignore[no-untyped-def]
    """At least the modulus."""
    return abs(z.real) + abs(z.imag)


@numba.njit(cache=True, error_model="numpy", forceinline=True)
def _found(x, y, values, width, height, bits_x, bits_y, index):  # type: ignore[no-untyped-def]
    """As ``mapping.find_block``, from places; False where one is within a unit of a pixel's edge."""
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
        index[i] = pixel if inside else np.int32(OUTSIDE)
    return nearest >= two


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _accumulate(x, y, intensity, half_x, half_y, sums, counts, cells):  # type: ignore[no-untyped-def]
    height, width = counts.shape
    bits_x, bits_y = _bits(width), _bits(height)
    across_x, across_y = float(width << bits_x), float(height << bits_y)
    scale_x, scale_y = 0.5 * across_x / half_x, 0.5 * across_y / half_y
    theta_x, theta_y, index = np.empty(SEGMENT), np.empty(SEGMENT), np.empty(TOGETHER * SEGMENT, np.int32)
    re, im, part_re, part_im = np.empty(FINE), np.empty(FINE), np.empty(SEGMENT), np.empty(SEGMENT)
    place_x, place_y = np.empty(SEGMENT, np.float32), np.empty(SEGMENT, np.float32)
    table_x, table_y = np.empty(8 * SEGMENT, np.float32), np.empty(8 * SEGMENT, np.float32)
    turn_x, turn_y = np.full(1, np.nan + 0j), np.full(1, np.nan + 0j)
    odd = x[2].shape[1] == 3 and y[2].shape[1] == 3
    for some in range(0, x[0].size, TOGETHER):
        for s in range(some, min(some + TOGETHER, x[0].size)):
            values, own = intensity[s * SEGMENT : (s + 1) * SEGMENT], index[(s - some) * SEGMENT :]
            told = odd
            if told:
                slip_x = _slip(x[1][s], turn_x, part_re, part_im, table_x)
                slip_y = _slip(y[1][s], turn_y, part_re, part_im, table_y)
                told = _placed(_lines(x, s), scale_x, across_x, slip_x, table_x, place_x)
                told = told and _placed(_lines(y, s), scale_y, across_y, slip_y, table_y, place_y)
            if not (told and _found(place_x, place_y, values, width, height, bits_x, bits_y, own)):
                segment_angles(x[0][s], x[1][s], x[2][s], x[3][s], re, im, theta_x)
                segment_angles(y[0][s], y[1][s], y[2][s], y[3][s], re, im, theta_y)
                find_block(theta_x, theta_y, values, half_x, half_y, width, height, own)
        add_block(index, intensity[some * SEGMENT : (some + TOGETHER) * SEGMENT], sums, counts, cells)


def accumulate_slow(
    x: SlowAngle,
    y: SlowAngle,
    first: int,
    intensity: NDArray[Any],
    grid: Grid,
    sums: NDArray[np.float64] | None = None,
    counts: NDArray[np.uint32] | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.uint32]]:
    """Add samples ``first`` on to the sums and counts of their pixels; otherwise as ``mapping.accumulate``.

    Args:
        x, y: angles on the intensity's clock.
        intensity: shape (n,); NaN is left out.

    Raises:
        BadInput: an intensity that is not one-dimensional, or goes on beyond the angles.
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

    added(kernel, intensity, sums, counts)
    return sums, counts


def _segments(axis: SlowAngle, run: tuple[int, int]) -> tuple[NDArray[np.complex128], ...]:
    own = axis.segments(*run)
    return own.first, own.turn, own.lines, own.line_steps
