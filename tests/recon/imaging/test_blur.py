"""Blur equals closed forms, the bound the normal distribution, and picture errors those of known scenes."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.stats import norm

from recon.imaging.blur import blur_by_cause, compare_with_scene, phase_bound, within_bound
from recon.imaging.gridding import map_samples
from recon.imaging.picture import Grid, Picture
from scanner.errors import BadInput

ALPHA = np.arange(20_000) * 2 * np.pi * 7 / 20_000  # whole periods, so sin² and cos² have means of 1/2
ZERO = np.zeros(1)


def test_the_papers_bound():
    assert np.degrees(phase_bound(1, 200)) == pytest.approx(0.286, abs=5e-4)


def test_the_fraction_within_the_bound_counts_known_errors():
    error = np.radians([0.0, -0.28, 0.29, -1.0, np.nan])
    assert within_bound(phase_bound(1, 200), error=error) == 2 / 5


@given(st.lists(st.floats(1e-5, 1.0), min_size=1, max_size=20), st.floats(1e-4, 0.1))
def test_without_errors_the_fraction_within_the_bound_follows_the_normal_distribution(sd, limit):
    assert within_bound(limit, sd=np.array(sd)) == pytest.approx(np.mean([1 - 2 * norm.sf(limit / s) for s in sd]))


def test_an_exact_phase_is_within_the_bound_and_an_unknown_one_is_not():
    assert within_bound(0.005, sd=np.array([0.0, np.inf])) == 0.5
    with pytest.raises(ValueError, match="errors or standard deviations"):
        within_bound(0.005)


@given(st.floats(0.02, 0.18), st.floats(-0.02, 0.02), st.floats(-0.02, 0.02), st.floats(0, 3), st.integers(10, 1000))
def test_phase_and_amplitude_blur_equal_the_displacement_of_samples(amplitude, phase, swing, optics, pixels):
    moved = (1 + swing) * amplitude * np.sin(ALPHA + phase) - amplitude * np.sin(ALPHA)
    blur = blur_by_cause(amplitude, 0.18, pixels, np.array([phase]), np.array([swing]), optics)
    px = pixels / 0.36 * math.sqrt(np.mean(moved**2))
    assert math.hypot(blur["phase"], blur["amplitude"]) == pytest.approx(px, rel=0.02, abs=1e-9)
    assert blur["total"] ** 2 == pytest.approx(sum(blur[k] ** 2 for k in ("phase", "amplitude", "sampling", "optics")))
    assert blur["optics"] == optics


def test_changing_errors_contribute_their_mean_square():
    phase = 0.01 * np.random.default_rng(0).normal(size=1000)
    blur = blur_by_cause(0.16, 0.16, 400, phase, phase)
    rms = 200 * math.sqrt(np.mean(phase**2) / 2)
    assert blur["phase"] == pytest.approx(rms)
    assert blur["amplitude"] == pytest.approx(rms)


def test_sampling_blur_is_that_of_a_uniform_pixel():
    assert blur_by_cause(0.18, 0.18, 400, ZERO, ZERO)["sampling"] == pytest.approx(math.sqrt(1 / 12))


def scene(shape=(300, 340)):
    texture = gaussian_filter(np.random.default_rng(2).normal(size=shape), 4)
    return 0.5 + 0.15 * texture / texture.std()


def shown(reference, shape=(200, 220), mag_x=1.0, mag_y=1.0, flip_x=False, flip_y=False):
    s_y, s_x = np.meshgrid(*[2 * (np.arange(n) + 0.5) / n - 1 for n in shape], indexing="ij")
    s_y, s_x = s_y / mag_y * (-1 if flip_y else 1), s_x / mag_x * (-1 if flip_x else 1)
    places = [(s + 1) / 2 * n - 0.5 for s, n in zip((s_y, s_x), reference.shape, strict=True)]
    return map_coordinates(reference, places, order=3, mode="nearest")


def picture_of(image):
    return Picture(np.float32(image), np.uint32(np.isfinite(image)), Grid(image.shape[1], image.shape[0], 1.0, 1.0))


@pytest.mark.parametrize(("mag_x", "mag_y"), [(1.0, 1.0), (1.01, 0.985), (0.96, 1.037), (1.092, 0.915)])
@pytest.mark.parametrize("size", [(200, 220), (300, 340), (600, 680)])  # as fine as the picture, and finer
def test_the_picture_error_excludes_magnification_and_gain(size, mag_x, mag_y):
    rng = np.random.default_rng(3)
    reference = scene(size)
    image = 2.0 + 3.0 * (shown(reference, mag_x=mag_x, mag_y=mag_y) + rng.normal(0, 0.03, (200, 220)))
    image[rng.random(image.shape) < 0.3] = np.nan
    error = compare_with_scene(picture_of(image), reference)
    assert error.magnification_x == pytest.approx(mag_x, abs=3e-4)  # 0.03 px at the edge
    assert error.magnification_y == pytest.approx(mag_y, abs=3e-4)
    assert error.rms == pytest.approx(0.2, rel=0.04)


@pytest.mark.parametrize("flips", [(True, False), (False, True), (True, True)])
def test_a_mirrored_picture_agrees_only_with_its_flips_stated(flips):
    picture = picture_of(shown(scene(), flip_x=flips[0], flip_y=flips[1]))
    assert compare_with_scene(picture, scene(), *flips).rms < 0.02
    assert compare_with_scene(picture, scene()).rms > 0.9


def test_a_mapped_scan_agrees_with_its_scene_and_a_phase_error_does_not():
    grid = Grid(100, 80, 0.18, 0.16)
    t = np.arange(400_000) / 5e6
    x, y = 0.18 * np.sin(2 * np.pi * 13_840 * t), 0.16 * np.sin(2 * np.pi * 3_270 * t)
    reference = scene()
    places = [(y / 0.16 + 1) / 2 * 300 - 0.5, (x / 0.18 + 1) / 2 * 340 - 0.5]
    intensity = map_coordinates(reference, places, order=1, mode="nearest")
    true = compare_with_scene(map_samples(x, y, intensity, grid), reference)
    large = compare_with_scene(map_samples(1.01 * x, 1.01 * y, intensity, grid), reference)
    late = compare_with_scene(map_samples(0.18 * np.sin(2 * np.pi * 13_840 * t + 0.05), y, intensity, grid), reference)
    assert true.rms < 0.15
    assert (true.magnification_x, true.magnification_y) == pytest.approx((1, 1), abs=1e-3)
    assert (large.magnification_x, large.magnification_y) == pytest.approx((1.01, 1.01), abs=1e-3)
    assert large.rms == pytest.approx(true.rms, rel=0.1)
    assert late.rms > 2 * true.rms


@pytest.mark.parametrize("magnification", [1.15, 1.3])
def test_a_larger_magnification_is_an_error_of_the_picture(magnification):
    error = compare_with_scene(picture_of(shown(scene(), mag_x=magnification)), scene())
    assert error.magnification_x <= 1.1
    assert error.rms > 0.5


def test_visited_pixels_that_are_not_finite_are_left_out():
    image = np.float32(shown(scene()))
    image[40, 50] = np.nan
    whole = Picture(image, np.ones(image.shape, np.uint32), Grid(220, 200, 1.0, 1.0))
    assert compare_with_scene(whole, scene()) == compare_with_scene(picture_of(image), scene())


def test_an_empty_picture_is_refused():
    with pytest.raises(BadInput, match="no pixel"):
        compare_with_scene(picture_of(np.full((4, 4), np.nan)), scene())


def test_what_cannot_be_compared_is_refused():
    picture, flat = picture_of(shown(scene())), picture_of(np.ones((4, 4)))
    with pytest.raises(BadInput, match="picture: has no contrast"):
        compare_with_scene(flat, scene())
    with pytest.raises(BadInput, match="scene: has no contrast"):
        compare_with_scene(picture, np.ones((30, 30)))
    with pytest.raises(BadInput, match="picture: is a ndarray, no picture"):
        compare_with_scene(picture.image, scene())
    for wrong in (scene()[0], scene() + 1j, np.full((4, 4), np.nan), picture):
        with pytest.raises(BadInput, match=r"scene: is an array of .*; give finite real numbers"):
            compare_with_scene(picture, wrong)
    with pytest.raises(BadInput, match="flip_x: is 'no'; give True or False"):
        compare_with_scene(picture, scene(), flip_x="no")
