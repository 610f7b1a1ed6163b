"""Mapping from slow motion in single precision against the pixels of the angles themselves, to the sample."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from estimation.reference import absolute
from estimation.tracker.angle import SlowAngle, SlowMotion
from recon import mapping, slow_mapping
from recon.mapping import Grid, accumulate
from recon.pipeline import mapped
from recon.slow_mapping import accumulate_slow
from scanner.channel import checked_channel
from scanner.motion import AxisMotion, Motion

SIZE = 300_000


def swinging(frequency: float, amplitude: float, grows: float = 0.0, slip: float = 0.0, third: float = 1e-3):
    """Angles of 60 ms at 5 MS/s: the amplitude grows by exp(grows t), the frequency by ``slip`` [rad/s^2]."""
    time = np.linspace(0.0, SIZE / 5e6, 101)
    phase, rate = 0.3 + 0.5 * slip * time**2, slip * time
    log = np.log(amplitude) + grows * time
    lines = np.tile([-1j, third, 1e-2j * third], (time.size, 1))
    reference = absolute(frequency, time[0], time[-1])
    slow = SlowMotion(reference, time, phase, rate, log, np.full(time.size, grows), lines)
    return SlowAngle(slow, 5e6, 0.0, SIZE)


CASES = {
    "steady": (swinging(13840.0, 0.185), swinging(3270.0, 0.185), Grid(400, 400, 0.18, 0.18)),
    "drifting": (swinging(13840.0, 0.15, 3.0, 1e4), swinging(3270.0, 0.17, -3.0, -1e4), Grid(400, 300, 0.18, 0.17)),
    "wide": (swinging(13840.0, 0.185), swinging(3270.0, 0.185), Grid(4096, 1000, 0.18, 0.16)),
    "strong harmonics": (swinging(13840.0, 0.1, third=0.2), swinging(3270.0, 0.185), Grid(7, 400, 0.18, 0.18)),
    "far beyond the field": (swinging(13840.0, 0.185), swinging(3270.0, 0.185), Grid(400, 400, 0.002, 0.18)),
    "one pixel": (swinging(13840.0, 0.185), swinging(3270.0, 0.185), Grid(1, 1, 0.18, 0.18)),
    "ringdown": (swinging(13840.0, 0.3, -60.0, 3e6), swinging(3270.0, 0.3, -60.0), Grid(400, 400, 0.18, 0.18)),
}


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("dtype", [np.int16, np.uint8, np.float32])
def test_counts_and_sums_are_those_of_the_angles(case: str, dtype: type) -> None:
    x, y, grid = CASES[case]
    whole = np.random.default_rng(0).integers(-30000 if dtype != np.uint8 else 0, 30000, SIZE)
    intensity = whole.astype(dtype)
    expected = accumulate(x.values, y.values, intensity.astype(float), grid)
    sums, counts = accumulate_slow(x, y, 0, intensity, grid)
    assert_array_equal(counts, expected[1])
    assert_array_equal(sums, expected[0])
    assert counts.sum() > 1000
    by_angles = accumulate(x.values, y.values, intensity, grid)
    assert_array_equal(by_angles[1], expected[1])
    assert_array_equal(by_angles[0], expected[0])


def test_single_precision_is_off_by_less_than_is_looked_at_again() -> None:
    x, _, grid = CASES["steady"]
    own = x.segments(0, SIZE)
    table, place, room = np.empty(8 * 256, np.float32), np.empty(256, np.float32), np.empty((2, 256))
    kept = np.full(1, np.nan + 0j)
    units = 1 << 14  # by pixel: 400 of them stay below 2^23
    across, worst = float(grid.width * units), 0.0
    for s in range(0, own.first.size, 7):
        axis = own.first, own.turn, own.lines, own.line_steps
        scale = 0.5 * across / grid.half_angle_x
        slip = slow_mapping._slip(own.turn[s], kept, *room, table)
        assert slow_mapping._placed(slow_mapping._lines(axis, s), scale, across, slip, table, place)
        exact = x.read(s * 256, s * 256 + 256)
        error = place[: exact.size] - scale * exact - 200 * units
        worst = max(worst, float(np.abs(error).max()))
    assert 0.0 < worst < 1.0  # unit: places within one of an edge are looked at again


@pytest.mark.parametrize("value", [-(2**15), 2**15 - 1])
def test_cells_hold_as_many_samples_as_are_put_into_them(value: int) -> None:
    still, size = np.zeros(mapping.MOST + 5), mapping.MOST + 5
    sums, counts = accumulate(still, still, np.full(size, value, np.int16), Grid(1, 1, 0.1, 0.1))
    assert (sums[0, 0], counts[0, 0]) == (float(value) * size, size)


def test_a_picture_of_stored_integers_is_that_of_their_values() -> None:
    x, y, grid = CASES["steady"]
    stored = np.random.default_rng(1).integers(-3000, 3000, SIZE).astype(np.int16)
    made = {
        dtype: checked_channel("intensity", raw, unit="V", sample_rate=5e6, gain=gain, offset=offset)
        for dtype, raw, gain, offset in ((int, stored, 1e-3, 0.25), (float, 1e-3 * stored + 0.25, 1.0, 0.0))
    }
    still = np.zeros(2)
    axes = {
        name: AxisMotion(still, still, still, still, still, angle, "absolute", "ambiguous")
        for name, angle in (("x", x), ("y", y))
    }
    lost = [(1000, 2000), (290_000, 310_000)]
    ours, values = (mapped(Motion(axes, "tracker", {}), each, grid, lost, begin=10) for each in made.values())
    assert_array_equal(ours.coverage, values.coverage)
    assert_allclose(ours.image, values.image, rtol=1e-6, atol=1e-12)
    kept = replace(made[int], raw=np.where(np.arange(SIZE) < 2000, np.nan, stored))
    gaps = mapped(Motion(axes, "tracker", {}), kept, grid, lost[1:])
    assert_array_equal(gaps.coverage, mapped(Motion(axes, "tracker", {}), kept, grid, [(0, 2000), lost[1]]).coverage)
