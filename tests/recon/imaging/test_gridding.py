"""Gridding equals numpy and scipy sample by sample; the assignment of samples on pixel edges is defined."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.stats import binned_statistic_2d

from recon.cli import main
from recon.imaging.coverage import fill_against_time, time_for_fill
from recon.imaging.gridding import (
    BLOCK_SAMPLES,
    MAX_FAST_PIXELS,
    accumulate_samples,
    map_samples,
    mean_picture,
    pixel_index,
)
from recon.imaging.picture import Grid, Picture, fill_factor, fill_holes
from scanner.errors import BadInput

no_deadline = settings(deadline=None)  # the first call of a kernel compiles it


@st.composite
def scans(draw, detectors=()):
    """A grid and samples inside, outside and exactly on the edges of its pixels, some of them NaN."""
    grid = Grid(draw(st.integers(1, 9)), draw(st.integers(1, 9)), draw(st.sampled_from([0.16, 0.25, 1.0])), 0.5)
    n = draw(st.integers(0, 2 * BLOCK_SAMPLES + 60))  # from none to two blocks and a part
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    theta = []
    for pixels, half in ((grid.width, grid.half_angle_x), (grid.height, grid.half_angle_y)):
        edges = (2 * rng.integers(0, pixels + 1, n) / pixels - 1) * half
        theta.append(np.where(rng.random(n) < 0.3, edges, rng.uniform(-1.2, 1.2, n) * half))
    intensity = rng.normal(size=(n, *detectors))
    for values in (*theta, intensity):
        values[rng.random(values.shape) < 0.1] = np.nan
    return grid, *theta, intensity


def by_numpy(grid, theta_x, theta_y, intensity):
    """Sums and counts with the pixel formula and np.bincount."""
    s_x, s_y = theta_x / grid.half_angle_x, theta_y / grid.half_angle_y
    by_detector = intensity.reshape(len(theta_x), intensity.shape[1] if intensity.ndim == 2 else 1)
    valid = (np.abs(s_x) <= 1) & (np.abs(s_y) <= 1) & ~np.isnan(by_detector).any(1)
    column = np.maximum(np.ceil(grid.width / 2 * (s_x[valid] + 1)).astype(int) - 1, 0)
    row = np.maximum(np.ceil(grid.height / 2 * (s_y[valid] + 1)).astype(int) - 1, 0)
    index, size = row * grid.width + column, grid.width * grid.height
    sums = [np.bincount(index, values, size).reshape(grid.height, grid.width) for values in by_detector[valid].T]
    counts = np.bincount(index, minlength=size).reshape(grid.height, grid.width)
    return (sums[0] if intensity.ndim == 1 else np.stack(sums, -1)), counts


@pytest.mark.parametrize("half", [1.0, 0.18, 0.1, np.pi / 17])
@pytest.mark.parametrize("n", [1, 2, 7, 400])
def test_the_edges_of_the_field_belong_to_the_outer_pixels(n, half):
    assert pixel_index(-half, half, n) == 0
    assert pixel_index(half, half, n) == n - 1
    assert pixel_index(np.nextafter(half, np.inf), half, n) == -1
    assert pixel_index(np.nextafter(-half, -np.inf), half, n) == -1
    assert pixel_index(np.nan, half, n) == -1


def test_an_inner_edge_belongs_to_the_pixel_below_it():
    inner = np.array([-0.5, 0.0, 0.5])
    assert_array_equal(pixel_index(inner, 1.0, 4), [0, 1, 2])
    assert_array_equal(pixel_index(inner + 1e-12, 1.0, 4), [1, 2, 3])


@no_deadline
@given(scans())
def test_sums_and_counts_equal_bincount(scan):
    sums, counts = accumulate_samples(*scan[1:], scan[0])
    expected_sums, expected_counts = by_numpy(*scan)
    assert_array_equal(counts, expected_counts)
    assert_array_equal(sums, expected_sums)  # same order of additions: equal to the last bit


@pytest.mark.parametrize("width", [MAX_FAST_PIXELS, MAX_FAST_PIXELS + 1])
def test_wide_pictures_and_extreme_angles_equal_bincount(width):
    grid, rng = Grid(width, 3, 0.18, 0.16), np.random.default_rng(width)
    x, y = rng.uniform(-0.2, 0.2, 3000), rng.uniform(-0.2, 0.2, 3000)
    x[::3] = (2 * rng.integers(0, width + 1, 1000) / width - 1) * 0.18  # on edges and next to them
    x[::6] *= 1 + rng.choice([-1e-9, -1e-16, 1e-16, 1e-9], 500)
    x[5::200], y[7::200] = rng.choice([1e300, -1e300, np.inf, -np.inf, np.nan], (2, 15))
    sums, counts = accumulate_samples(x, y, np.ones(3000), grid)
    expected = by_numpy(grid, x, y, np.ones(3000))
    assert_array_equal(counts, expected[1])
    assert_array_equal(sums, expected[0])


@no_deadline
@given(scans(detectors=(3,)))
def test_detectors_share_one_coverage(scan):
    sums, counts = accumulate_samples(*scan[1:], scan[0])
    expected_sums, expected_counts = by_numpy(*scan)
    assert sums.shape == (scan[0].height, scan[0].width, 3)
    assert_array_equal(counts, expected_counts)
    assert_array_equal(sums, expected_sums)


@no_deadline
@given(st.integers(0, 2**32 - 1), st.integers(1, 12), st.integers(1, 12))
def test_means_equal_binned_statistic(seed, width, height):
    rng = np.random.default_rng(seed)
    grid = Grid(width, height, 0.18, 0.16)
    x, y = rng.uniform(-0.18, 0.18, 80), rng.uniform(-0.16, 0.16, 80)  # not on edges, where scipy differs
    intensity = rng.normal(size=80)
    picture = map_samples(x, y, intensity, grid)
    field = [[-0.16, 0.16], [-0.18, 0.18]]
    mean = binned_statistic_2d(y, x, intensity, "mean", bins=(height, width), range=field).statistic
    count = binned_statistic_2d(y, x, None, "count", bins=(height, width), range=field).statistic
    assert_array_equal(picture.coverage, count)
    assert_allclose(picture.image, mean, rtol=1e-5, atol=1e-6)
    assert (picture.image.dtype, picture.coverage.dtype) == (np.float32, np.uint32)


@no_deadline
@given(scans(), st.integers(0, 60))
def test_gridding_in_chunks_equals_gridding_at_once(scan, cut):
    grid, *samples = scan
    whole = mean_picture(*accumulate_samples(*samples, grid), grid)
    first = accumulate_samples(*(s[:cut] for s in samples), grid)
    both = mean_picture(*accumulate_samples(*(s[cut:] for s in samples), grid, *first), grid)
    assert_array_equal(both.coverage, whole.coverage)
    assert_array_equal(both.image, whole.image)
    assert_array_equal(np.isnan(whole.image), whole.coverage == 0)


def test_integer_and_single_precision_samples_are_accepted():
    grid = Grid(2, 1, 1.0, 1.0)
    x, y = np.float32([-0.5, 0.5, 0.5]), np.float32([0, 0, 0])
    picture = map_samples(x, y, np.array([3, 60000, 65535], np.uint16), grid)
    assert_allclose(picture.image, [[3, 62767.5]])


@pytest.mark.parametrize("dtype", [">f8", ">f4", ">i2", ">u4", "f2", "g"])
def test_samples_of_any_byte_order_and_float_are_accepted(dtype):
    x = np.linspace(-0.09, 0.09, 9)
    values = np.arange(9).astype(dtype)
    grid = Grid(3, 3, 0.1, 0.1)
    expected = map_samples(x, x, np.arange(9.0), grid).image
    np.testing.assert_array_equal(map_samples(x, x, values, grid).image, expected)
    np.testing.assert_array_equal(map_samples(x, x, np.stack([values] * 2, axis=1), grid).image[..., 1], expected)
    angle, wide = np.arange(9).astype(dtype), Grid(3, 3, 5.5, 5.5)
    expected = map_samples(np.arange(9.0), np.arange(9.0), values, wide).image
    np.testing.assert_array_equal(map_samples(angle, angle, values, wide).image, expected)


def test_invalid_samples_and_grids_are_refused():
    grid = Grid(4, 4, 1.0, 1.0)
    with pytest.raises(BadInput, match="one angle of each axis"):
        accumulate_samples(np.zeros(3), np.zeros(4), np.zeros(3), grid)
    with pytest.raises(BadInput, match=r"sums of shape \(4, 5\)"):
        accumulate_samples(np.zeros(3), np.zeros(3), np.zeros(3), grid, np.zeros((4, 5)), np.zeros((4, 5), np.uint32))
    for values in (np.ones(3) + 1j, np.array(["a", "b", "c"]), np.array([None, 1, 2])):
        with pytest.raises(BadInput, match=r"intensity: holds .*, not real numbers; give integers or floats"):
            map_samples(np.zeros(3), np.zeros(3), values, grid)
    with pytest.raises(BadInput, match="theta_x: holds complex128"):
        map_samples(np.zeros(3, complex), np.zeros(3), np.zeros(3), grid)
    with pytest.raises(BadInput, match="0x4 pixels"):
        Grid(0, 4, 1.0, 1.0)
    with pytest.raises(BadInput, match="30000x30000 pixels"):
        Grid(30_000, 30_000, 1.0, 1.0)
    with pytest.raises(BadInput, match="positive, finite"):
        Grid(4, 4, np.nan, 1.0)


def test_fill_is_the_mean_of_the_visited_neighbours_weighted_by_coverage():
    image = np.array([[1, np.nan, 4, np.nan, np.nan]], np.float32)
    picture = Picture(image, np.array([[1, 0, 3, 0, 0]], np.uint32), Grid(5, 1, 1.0, 1.0))
    filled, mask = fill_holes(picture, radius=1)
    assert_array_equal(mask, [[False, True, False, True, False]])
    assert_allclose(filled, [[1, (1 * 1 + 3 * 4) / 4, 4, 4, np.nan]])
    assert np.isnan(picture.image[0, 1])  # the picture itself is unchanged


@pytest.mark.parametrize(("hole_px", "left_px"), [(4, 0), (7, 3)])
def test_fill_reaches_its_radius_into_a_hole_from_both_sides(
    hole_px: int, left_px: int, capsys: pytest.CaptureFixture
) -> None:
    counts = np.ones((9, hole_px + 6), np.uint32)
    counts[:, 3:-3] = 0
    picture = Picture(np.where(counts > 0, np.float32(2.0), np.nan), counts, Grid(hole_px + 6, 9, 1.0, 1.0))
    filled, mask = fill_holes(picture, radius=2)
    assert np.isnan(filled).sum() == 9 * left_px
    assert mask.sum() == 9 * (hole_px - left_px)
    with pytest.raises(SystemExit):
        main(["reconstruct", "--help"])
    assert "at most PX rows and columns away" in " ".join(capsys.readouterr().out.split())


@no_deadline
@given(scans(detectors=(2,)), st.integers(1, 3))
def test_fill_changes_only_holes_and_keeps_the_range_of_values(scan, radius):
    picture = map_samples(*scan[1:], scan[0])
    filled, mask = fill_holes(picture, radius)
    assert not (mask & (picture.coverage > 0)).any()
    assert_array_equal(filled[~mask], picture.image[~mask])
    for d in range(2):
        if mask.any():
            measured = picture.image[..., d][picture.coverage > 0]
            assert filled[mask, d].min() >= measured.min() - 1e-5
            assert filled[mask, d].max() <= measured.max() + 1e-5


@no_deadline
@given(scans())
def test_fill_against_time_ends_at_the_fill_of_the_picture(scan):
    grid, x, y, _ = scan
    time, fill = fill_against_time(x, y, 1e3, grid)
    _, counts = accumulate_samples(x, y, np.ones(x.size), grid)
    assert (fill[-1] if fill.size else 0.0) == fill_factor(counts)
    assert (np.diff(time) > 0).all()
    for k in range(0, time.size, 5):
        first_samples = round(time[k] * 1e3)
        _, so_far = accumulate_samples(x[:first_samples], y[:first_samples], np.ones(first_samples), grid)
        assert fill_factor(so_far) == fill[k]


def test_the_time_for_a_fill_is_the_first_sample_that_reaches_it():
    grid = Grid(4, 1, 1.0, 1.0)
    x = np.array([-0.9, -0.8, -0.4, np.nan, 0.1, -0.9])
    wanted = {0.25: 0.1, 0.26: 0.3, 0.5: 0.3, 0.75: 0.5, 1.0: None}
    assert {fill: time_for_fill(x, 0 * x, 10.0, grid, fill) for fill in wanted} == wanted
    with pytest.raises(BadInput, match=r"a fill of 1\.1"):
        time_for_fill(x, x, 10.0, grid, 1.1)
    with pytest.raises(BadInput, match="sample rate"):
        time_for_fill(x, x, 0.0, grid, 0.5)


def test_masked_samples_are_left_out():
    """Read errors are often masked by a value that is no measurement, such as 65535."""
    centre, values = np.zeros(3), np.array([1, 2, 65535])
    mask = np.array([False, False, True])
    for angle, intensity in ((centre, np.ma.array(values, mask=mask)), (np.ma.array(centre, mask=mask), values)):
        picture = map_samples(angle, centre, intensity, Grid(1, 1, 1.0, 1.0))
        assert picture.image[0, 0] == 1.5
        assert picture.coverage[0, 0] == 2
