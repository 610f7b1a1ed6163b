"""Gridding from phasors in single precision assigns every sample to the same pixel as gridding from angles."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from estimation.reference import absolute_reference
from estimation.tracker.angle_synthesis import PhasorAngle, PhasorMotion
from recon.imaging import gridding as mapping
from recon.imaging import phasor_gridding as slow_mapping
from recon.imaging.gridding import accumulate_samples
from recon.imaging.intensity_gridding import grid_intensity
from recon.imaging.phasor_gridding import accumulate_phasors
from recon.imaging.picture import Grid
from scanner.channel import make_channel
from scanner.motion import AxisMotion, Motion

SIZE = 300_000


def oscillation(frequency: float, amplitude: float, grows: float = 0.0, slip: float = 0.0, third: float = 1e-3):
    """Angles of 60 ms at 5 MS/s: the amplitude grows by exp(grows t), the frequency by ``slip`` [rad/s^2]."""
    time = np.linspace(0.0, SIZE / 5e6, 101)
    phase, rate = 0.3 + 0.5 * slip * time**2, slip * time
    log = np.log(amplitude) + grows * time
    lines = np.tile([-1j, third, 1e-2j * third], (time.size, 1))
    reference = absolute_reference(frequency, time[0], time[-1])
    slow = PhasorMotion(reference, time, phase, rate, log, np.full(time.size, grows), lines)
    return PhasorAngle(slow, 5e6, 0.0, SIZE)


CASES = {
    "steady": (oscillation(13840.0, 0.185), oscillation(3270.0, 0.185), Grid(400, 400, 0.18, 0.18)),
    "drifting": (
        oscillation(13840.0, 0.15, 3.0, 1e4),
        oscillation(3270.0, 0.17, -3.0, -1e4),
        Grid(400, 300, 0.18, 0.17),
    ),
    "wide": (oscillation(13840.0, 0.185), oscillation(3270.0, 0.185), Grid(4096, 1000, 0.18, 0.16)),
    "strong harmonics": (oscillation(13840.0, 0.1, third=0.2), oscillation(3270.0, 0.185), Grid(7, 400, 0.18, 0.18)),
    "far beyond the field": (oscillation(13840.0, 0.185), oscillation(3270.0, 0.185), Grid(400, 400, 0.002, 0.18)),
    "one pixel": (oscillation(13840.0, 0.185), oscillation(3270.0, 0.185), Grid(1, 1, 0.18, 0.18)),
    "ringdown": (oscillation(13840.0, 0.3, -60.0, 2e5), oscillation(3270.0, 0.3, -60.0), Grid(400, 400, 0.18, 0.18)),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("dtype", [np.int16, np.uint8, np.float32])
def test_counts_and_sums_equal_those_from_angles(case: str, dtype: type) -> None:
    x, y, grid = CASES[case]
    assert x.is_in_segments(0, SIZE)
    assert y.is_in_segments(0, SIZE)
    whole = np.random.default_rng(0).integers(-30000 if dtype != np.uint8 else 0, 30000, SIZE)
    intensity = whole.astype(dtype)
    expected = accumulate_samples(x.read(), y.read(), intensity.astype(float), grid)
    sums, counts = accumulate_phasors(x, y, 0, intensity, grid)
    assert_array_equal(counts, expected[1])
    assert_array_equal(sums, expected[0])
    assert counts.sum() > 1000
    by_angles = accumulate_samples(x.read(), y.read(), intensity, grid)
    assert_array_equal(by_angles[1], expected[1])
    assert_array_equal(by_angles[0], expected[0])


def test_the_single_precision_error_is_below_the_recheck_distance() -> None:
    x, _, grid = CASES["steady"]
    segments = x.cut_segments(0, SIZE)
    table, place, room = np.empty(8 * 256, np.float32), np.empty(256, np.float32), np.empty((2, 256))
    kept = np.full(1, np.nan + 0j)
    units = 1 << 14  # per pixel; 400 pixels are less than 2^23 units
    across, worst = float(grid.width * units), 0.0
    for s in range(0, segments.first_phasor.size, 7):
        axis = segments.first_phasor, segments.step_phasor, segments.harmonics, segments.harmonic_steps
        scale = 0.5 * across / grid.half_angle_x
        slip = slow_mapping._rotation_offset(segments.step_phasor[s], kept, *room, table)
        assert slow_mapping._find_positions(slow_mapping._segment_lines(axis, s), scale, across, slip, table, place)
        exact = x.read(s * 256, s * 256 + 256)
        error = place[: exact.size] - scale * exact - 200 * units
        worst = max(worst, float(np.abs(error).max()))
    assert 0.0 < worst < 1.0  # unit; positions within one unit of an edge are rechecked


@pytest.mark.parametrize("value", [-(2**15), 2**15 - 1])
def test_a_pixel_counts_more_samples_than_a_shared_cell_can(value: int) -> None:
    still, size = np.zeros(mapping.MAX_SHARED_SAMPLES + 5), mapping.MAX_SHARED_SAMPLES + 5
    sums, counts = accumulate_samples(still, still, np.full(size, value, np.int16), Grid(1, 1, 0.1, 0.1))
    assert (sums[0, 0], counts[0, 0]) == (float(value) * size, size)


def test_gridding_stored_integers_equals_gridding_their_values() -> None:
    x, y, grid = CASES["steady"]
    stored = np.random.default_rng(1).integers(-3000, 3000, SIZE).astype(np.int16)
    channels = {
        dtype: make_channel("intensity", raw, unit="V", sample_rate=5e6, gain=gain, offset=offset)
        for dtype, raw, gain, offset in ((int, stored, 1e-3, 0.25), (float, 1e-3 * stored + 0.25, 1.0, 0.0))
    }
    zeros = np.zeros(2)
    axes = {
        name: AxisMotion(zeros, zeros, zeros, zeros, zeros, angle, "absolute", "ambiguous")
        for name, angle in (("x", x), ("y", y))
    }
    lost = [(1000, 2000), (290_000, 310_000)]
    from_integers, from_values = (
        grid_intensity(Motion(axes, "tracker", {}), each, grid, lost, first=10) for each in channels.values()
    )
    assert_array_equal(from_integers.coverage, from_values.coverage)
    assert_allclose(from_integers.image, from_values.image, rtol=1e-6, atol=1e-12)
    with_nans = replace(channels[int], raw=np.where(np.arange(SIZE) < 2000, np.nan, stored))
    gaps = grid_intensity(Motion(axes, "tracker", {}), with_nans, grid, lost[1:])
    assert_array_equal(
        gaps.coverage, grid_intensity(Motion(axes, "tracker", {}), with_nans, grid, [(0, 2000), lost[1]]).coverage
    )
