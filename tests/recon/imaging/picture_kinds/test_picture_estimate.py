"""Kernel and posterior pictures of sparse scans: their error, their intervals, and scans that determine no picture."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from recon.imaging.intensity_gridding import grid_intensity
from recon.imaging.picture import Grid, Picture
from recon.imaging.picture_kinds.held_out import HELD_OUT_FRACTION, SplitSums, held_out_ranges
from recon.imaging.picture_kinds.picture_estimate import (
    PICTURE_KINDS,
    EstimatedPicture,
    estimate_picture,
    picture_of_sums,
)
from recon.imaging.picture_kinds.posterior_sd import draw_noise
from recon.imaging.picture_kinds.posterior_solver import LANES, build_stencil, multiply, solve
from recon.imaging.pixel_noise import measure_noise
from scanner.angle_tracks import SampledAngle
from scanner.arrays import Array
from scanner.errors import BadInput
from scanner.motion import AxisMotion, Motion
from scanner.recording import Recording

RATE_HZ = 1e6
GRID = Grid(96, 96, 0.1, 0.1)


def discs() -> Array:
    """A scene of discs with sharp edges on a slope, from 0.1 to 1."""
    y, x = np.mgrid[:96, :96]
    scene = 0.1 + 0.002 * x
    for column, row, radius, value in ((30, 40, 18, 0.5), (65, 60, 22, 0.9), (70, 20, 10, 0.7), (25, 75, 8, 1.0)):
        scene[np.hypot(x - column, y - row) < radius] = value
    return scene


def scan(
    scene: Array, photons: float, seconds: float, seed: int = 0, fast_hz: float = 5450.0
) -> tuple[Motion, Recording]:
    """A Lissajous scan of a scene that is constant within each pixel, with photon noise."""
    time = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    theta = [0.0999 * np.sin(2 * np.pi * f * time + p) for f, p in ((fast_hz, 0.3), (6700.0, 1.1))]
    column, row = (np.clip(np.ceil(48 * (angle / 0.1 + 1)) - 1, 0, 95).astype(int) for angle in theta)
    rng = np.random.default_rng(seed)
    intensity = rng.poisson(photons * scene[row, column]) if photons else scene[row, column]
    still = np.zeros(2)
    axes = {
        name: AxisMotion(still, still, still, still, still, SampledAngle(angle, RATE_HZ))
        for name, angle in zip("xy", theta, strict=True)
    }
    return Motion(axes, "sensor"), Recording.from_arrays({"intensity": (intensity.astype(float), "1", RATE_HZ)})


def estimate(kind: str, motion: Motion, recording: Recording) -> EstimatedPicture:
    channel = recording["intensity"]
    means = grid_intensity(motion, channel, GRID, [])
    return estimate_picture(kind, means, measure_noise(motion, channel, GRID), motion, channel, [])


def rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def best_kernel_error(scene: Array, motion: Motion, recording: Recording) -> float:
    """Rms error of the kernel-weighted mean whose width fits the true scene best."""
    means = grid_intensity(motion, recording["intensity"], GRID, [])
    sums = np.nan_to_num(means.image) * means.coverage
    errors = []
    for width in np.geomspace(0.5, 8.0, 20):
        weight = gaussian_filter(means.coverage.astype(float), width, truncate=8)
        errors.append(rms(gaussian_filter(sums.astype(float), width, truncate=8) / np.maximum(weight, 1e-12) - scene))
    return min(errors)


def test_a_posterior_picture_errs_less_than_any_kernel() -> None:
    scene = discs()
    for photons, seconds in ((10.0, 0.005), (100.0, 0.002)):
        motion, recording = scan(scene, photons, seconds)
        posterior = estimate("posterior", motion, recording)
        error = rms(posterior.picture.image / photons - scene)
        assert error < 0.9 * best_kernel_error(photons * scene, motion, recording) / photons


def test_the_kernel_is_nearly_as_good_as_the_best_one() -> None:
    scene = 20.0 * discs()
    motion, recording = scan(scene / 20.0, 20.0, 0.005)
    error = rms(estimate("kernel", motion, recording).picture.image - scene)
    assert error < 1.1 * best_kernel_error(scene, motion, recording)


@pytest.mark.parametrize("kind", ["kernel", "posterior"])
def test_intervals_hold_the_scene_in_visited_and_unvisited_pixels(kind: str) -> None:
    held: dict[bool, list[float]] = {True: [], False: []}
    scene = 20.0 * gaussian_filter(discs(), 1.0)
    for seed in range(3):
        estimated = estimate(kind, *scan(scene / 20.0, 20.0, 0.004, seed))
        error = estimated.picture.image - scene
        visited = estimated.picture.coverage > 0
        for part in held:
            held[part].append(float(np.mean(np.abs(error) < 1.96 * estimated.sd, where=visited == part)))
            assert rms(estimated.sd[visited == part]) < 2.0 * rms(error[visited == part])
    for part in held:
        assert 0.88 < np.mean(held[part]) < 0.995


def test_the_share_of_the_data_is_zero_where_no_sample_fell() -> None:
    estimated = estimate("posterior", *scan(discs(), 20.0, 0.003))
    assert estimated.data_share is not None
    unvisited = estimated.picture.coverage == 0
    assert np.all(estimated.data_share[unvisited] == 0.0)
    assert np.all((estimated.data_share[~unvisited] > 0.0) & (estimated.data_share[~unvisited] < 1.0))
    assert estimated.resolution_px == pytest.approx(np.sqrt(GRID.width * GRID.height / estimated.data_share.sum()))
    assert np.isfinite(estimated.picture.image).all()
    assert any("is not data" in note for note in estimated.notes)


def test_without_noise_a_posterior_picture_passes_through_the_samples() -> None:
    scene = gaussian_filter(discs(), 1.0)
    estimated = estimate("posterior", *scan(scene, 0.0, 0.004))
    visited = estimated.picture.coverage > 0
    assert rms((estimated.picture.image - scene)[visited]) < 0.02
    assert rms((estimated.picture.image - scene)[~visited]) < 0.07


def test_several_detectors_are_estimated_each_by_itself() -> None:
    motion, recording = scan(discs(), 20.0, 0.003)
    one = recording["intensity"].read()
    both = Recording.from_arrays({"intensity": (np.column_stack([one, 3.0 * one]), "1", RATE_HZ)})
    estimated = estimate("kernel", motion, both)
    assert estimated.picture.image.shape == (96, 96, 2)
    assert estimated.picture.image[..., 1] == pytest.approx(3.0 * estimated.picture.image[..., 0], rel=1e-4)
    assert estimated.picture.image[..., 0] == pytest.approx(
        estimate("kernel", motion, recording).picture.image, rel=1e-4
    )


@pytest.mark.parametrize("kind", ["kernel", "posterior"])
@pytest.mark.parametrize("level", [0.0, 0.1])
def test_a_constant_detector_is_named_beside_the_picture_of_another_one(kind: str, level: float) -> None:
    motion, recording = scan(discs(), 20.0, 0.003)
    one = recording["intensity"].read()
    both = Recording.from_arrays({"intensity": (np.column_stack([one, np.full(one.size, level)]), "1", RATE_HZ)})
    estimated, alone = estimate(kind, motion, both), estimate(kind, motion, recording)
    np.testing.assert_allclose(estimated.picture.image[..., 0], alone.picture.image)
    np.testing.assert_allclose(estimated.picture.image[..., 1], level)
    assert estimated.resolution_px == alone.resolution_px
    assert estimated.limits == [
        f"intensity, detector 1: every sample is {level:g}: the picture shows nothing; check the detector"
    ]
    channel, grid = both["intensity"], GRID
    means, noise = grid_intensity(motion, channel, grid, []), measure_noise(motion, channel, grid)
    following = estimate_picture(kind, means, noise, motion, channel, [], before=estimated)
    np.testing.assert_allclose(following.picture.image[..., 1], level)


def test_a_picture_of_samples_with_gaps_has_values() -> None:
    """A sample at the edge of a pixel may fall into its neighbour where a part of the scan is gridded."""
    motion, recording = scan(discs(), 20.0, 0.005)
    intensity = recording["intensity"].read()
    intensity[::3] = np.nan
    with_gaps = Recording.from_arrays({"intensity": (intensity, "1", RATE_HZ)})
    for kind in PICTURE_KINDS[1:]:
        assert np.isfinite(estimate(kind, motion, with_gaps).picture.image).mean() > 0.9
    moved = SplitSums(np.array([[0.0, 2.0]]), np.array([[0.0, 2.0]]), np.array([[1.0, 0.0]]), np.array([[1.0, 0.0]]))
    assert moved.kept_counts.min() == 0.0


def test_a_frame_without_a_located_sample_is_empty() -> None:
    motion, recording = scan(discs(), 20.0, 0.005)
    channel = recording["intensity"]
    everything = [(0, channel.size)]
    means, noise = grid_intensity(motion, channel, GRID, everything), measure_noise(motion, channel, GRID)
    estimated = estimate_picture("mean", means, noise, motion, channel, everything)
    assert np.isnan(estimated.picture.image).all()
    assert not estimated.notes
    assert not estimated.limits


def test_a_flat_scene_is_called_flat() -> None:
    for kind in PICTURE_KINDS:
        estimated = estimate(kind, *scan(np.full((96, 96), 0.5), 20.0, 0.005))
        assert any("no structure" in limit for limit in estimated.limits)
        visited = np.isfinite(estimated.sd)
        held = np.abs(estimated.picture.image - 10.0)[visited] < 1.96 * estimated.sd[visited]
        assert held.mean() > 0.93
        assert np.nanmax(estimated.sd) < 1.05 * np.sqrt(10.0)  # that of a single sample, whatever its value
    assert not estimate("kernel", *scan(discs(), 20.0, 0.005)).limits


def test_a_mean_of_equal_samples_or_of_one_line_says_so() -> None:
    (limit,) = estimate("mean", *scan(np.zeros((96, 96)), 20.0, 0.005)).limits
    assert "every sample is 0" in limit
    (limit,) = estimate("mean", *scan(discs(), 20.0, 0.005, fast_hz=0.0)).limits
    assert "one line" in limit
    assert estimate("mean", *scan(discs(), 20.0, 0.005)).limits == []


@pytest.mark.parametrize("shape", [(2, 100), (3, 400), (100, 2), (5, 60), (1, 60)])
def test_a_grid_of_few_rows_is_no_line_unless_its_samples_lie_on_one(shape: tuple[int, int]) -> None:
    image = np.random.default_rng(0).random(shape).astype(np.float32)
    row, column = np.indices(shape)
    grid = Grid(shape[1], shape[0], 0.1, 0.1)
    row, column = (row, column) if shape[0] < shape[1] else (column, row)
    corner_to_corner = row == column * min(shape) // max(shape)
    for visited, is_line in ((np.ones(shape, bool), min(shape) == 1), (row == 0, True), (corner_to_corner, True)):
        means = Picture(np.where(visited, image, np.nan), 50 * visited.astype(np.uint32), grid)
        limits = picture_of_sums("mean", means, None, [None]).limits
        assert any("one line" in limit for limit in limits) == is_line


@pytest.mark.parametrize("kind", ["kernel", "posterior"])
def test_scans_that_determine_no_picture_are_refused(kind: str) -> None:
    with pytest.raises(BadInput, match="one line"):
        estimate(kind, *scan(discs(), 20.0, 0.005, fast_hz=0.0))
    with pytest.raises(BadInput, match="every sample is 0"):
        estimate(kind, *scan(np.zeros((96, 96)), 20.0, 0.005))
    with pytest.raises(BadInput, match="too short"):
        estimate(kind, *scan(discs(), 20.0, 0.0002))
    motion, recording = scan(discs(), 20.0, 0.005)
    nothing = Recording.from_arrays({"intensity": (np.full(recording["intensity"].size, np.nan), "1", RATE_HZ)})
    with pytest.raises(BadInput, match="no sample lies in the field"):
        estimate(kind, motion, nothing)
    with pytest.raises(BadInput, match="no picture is called"):
        estimate("best", *scan(discs(), 20.0, 0.001))


def test_held_out_segments_are_disjoint_and_lie_within_the_samples() -> None:
    for first, stop in ((0, 20_000), (700, 5_000_000)):
        ranges = held_out_ranges(first, stop)
        assert all(a < b <= c for (a, b), (c, _) in pairwise(ranges))
        assert first <= ranges[0][0]
        assert ranges[-1][1] <= stop
    held = sum(b - a for a, b in held_out_ranges(0, 20_000))
    assert held == pytest.approx(HELD_OUT_FRACTION * 20_000, rel=0.05)
    assert held_out_ranges(0, 100) == []


def cell_weights(size: int, rng: np.random.Generator) -> list[Array]:
    """Random positive definite weights."""
    angle = rng.uniform(0.0, np.pi, (size - 1, size - 1))
    large, small = 10 ** rng.uniform(-1.0, 1.0, (2, size - 1, size - 1))
    c, s = np.cos(angle), np.sin(angle)
    return [large * c * c + small * s * s, (large - small) * c * s, large * s * s + small * c * c]


def dense_prior(weights: list[Array], size: int) -> Array:
    """The prior's matrix, from the energy of cells as it is defined."""
    matrix = np.zeros((size * size, size * size))
    for i in range(size - 1):
        for j in range(size - 1):
            corners = [i * size + j, i * size + j + 1, (i + 1) * size + j, (i + 1) * size + j + 1]
            xx, xy, yy = (weight[i, j] for weight in weights)
            for across in ([-1, 1, 0, 0], [0, 0, -1, 1]):
                for down in ([-1, 0, 1, 0], [0, -1, 0, 1]):
                    gradient = np.array([across, down], float)
                    matrix[np.ix_(corners, corners)] += gradient.T @ np.array([[xx, xy], [xy, yy]]) @ gradient / 4
    return matrix


def test_the_solver_agrees_with_a_dense_matrix() -> None:
    size, rng = 21, np.random.default_rng(0)
    weights = cell_weights(size, rng)
    stencil = build_stencil(*weights)
    precision = np.zeros((LANES, size + 2, size + 2), np.float32)
    precision[:, 1:-1, 1:-1] = (rng.random((size, size)) < 0.3) * rng.uniform(0.1, 10.0, (LANES, size, size))
    b = precision * rng.normal(size=precision.shape).astype(np.float32)
    solved = solve(stencil, precision, b, np.zeros_like(b), 1e-5)
    prior, product = dense_prior(weights, size), np.zeros_like(b)
    multiply(stencil, precision, solved, product)
    for lane in range(LANES):
        matrix = prior + np.diag(precision[lane, 1:-1, 1:-1].ravel())
        expected = np.linalg.solve(matrix, b[lane, 1:-1, 1:-1].ravel())
        assert solved[lane, 1:-1, 1:-1].ravel() == pytest.approx(expected, abs=2e-3)
        x = solved[lane, 1:-1, 1:-1].ravel().astype(float)
        assert product[lane, 1:-1, 1:-1].ravel() == pytest.approx(matrix @ x, abs=1e-3)


def test_drawn_noise_has_the_covariance_of_the_system() -> None:
    size, rng = 5, np.random.default_rng(0)
    weights = cell_weights(size, rng)
    precision = rng.uniform(0.0, 2.0, (1, size + 2, size + 2)).repeat(LANES, axis=0).astype(np.float32)
    bits = (rng.integers(0, 256, (4, size, size), np.uint8) for _ in range(4000))
    draws = [draw_noise(*weights, precision, each)[:, 1:-1, 1:-1].reshape(LANES, -1) for each in bits]
    noise = np.concatenate(draws).T
    expected = dense_prior(weights, size) + np.diag(precision[0, 1:-1, 1:-1].ravel())
    assert np.abs(noise @ noise.T / noise.shape[1] - expected).max() < 0.05 * expected.max()


def test_intervals_of_a_kernel_are_not_narrow_where_noise_hides_its_errors() -> None:
    """Held-out samples of 2 photons may show less than no error by chance."""
    scene = 2.0 * gaussian_filter(discs(), 2.0)
    inside = []
    for seed in range(8):
        estimated = estimate("kernel", *scan(scene / 2.0, 2.0, 0.003, seed))
        inside.append(float(np.mean(np.abs(estimated.picture.image - scene) < 1.96 * estimated.sd)))
    assert min(inside) > 0.88
