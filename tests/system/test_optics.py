"""Simulated optics: the width of the spot, the position that an angle samples, and the detector's response."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from phantoms.optics import Detector, blur_by_spot, detect, sample_scene
from scanner.errors import BadInput

HALF_ANGLE_X, HALF_ANGLE_Y = 0.18, 0.16
FULL = Detector(gain=2e-3, photons_per_sample=400.0, full_scale=2.0)


def spot(shape=(161, 241)):
    scene = np.zeros(shape)
    scene[shape[0] // 2, shape[1] // 2] = 1.0
    return scene


def width(profile):
    """Standard deviation of a distribution over pixels."""
    pixel = np.arange(profile.size)
    mean = profile @ pixel / profile.sum()
    return np.sqrt(profile @ (pixel - mean) ** 2 / profile.sum())


@pytest.mark.parametrize("sd_um", [1.6, 2.5, 5.0])
def test_the_spot_has_the_given_width_in_micrometres_on_both_axes(sd_um):
    scene = spot()
    blurred = blur_by_spot(scene, sd_um, field_x_um=241.0, field_y_um=322.0)  # pixels 1 um wide, 2 um high
    assert blurred.sum() == pytest.approx(1.0, abs=1e-9)
    assert width(blurred.sum(0)) == pytest.approx(sd_um, rel=2e-3)
    assert width(blurred.sum(1)) == pytest.approx(sd_um / 2, rel=2e-3)


def test_the_spot_is_half_as_bright_at_half_its_fwhm():
    fwhm = 12.0
    blurred = blur_by_spot(spot(), fwhm / (2.0 * np.sqrt(2.0 * np.log(2.0))), 241.0, 161.0)
    assert blurred[80, 126] / blurred[80, 120] == pytest.approx(0.5, rel=1e-6)
    assert blurred[74, 120] / blurred[80, 120] == pytest.approx(0.5, rel=1e-6)


def test_a_uniform_scene_and_a_spot_of_zero_width_are_unchanged():
    uniform = np.full((40, 50), 0.3)
    np.testing.assert_allclose(blur_by_spot(uniform, 30.0, 50.0, 40.0), 0.3, atol=1e-12)  # also at the edge
    np.testing.assert_array_equal(blur_by_spot(spot(), 0.0, 241.0, 161.0), spot())


def test_a_spot_smaller_than_a_scene_pixel_is_refused():
    with pytest.raises(BadInput, match=r"0\.25 scene pixels; give the target more pixels"):
        blur_by_spot(spot(), 0.25, 241.0, 161.0)


def angles_at(s_x, s_y):
    return np.asarray(s_x) * HALF_ANGLE_X, np.asarray(s_y) * HALF_ANGLE_Y


def test_an_angle_at_a_pixel_centre_samples_that_pixel():
    scene = np.random.default_rng(0).random((7, 10))
    row, column = np.mgrid[:7, :10]
    sampled = sample_scene(
        scene, *angles_at((2 * column + 1) / 10 - 1, (2 * row + 1) / 7 - 1), HALF_ANGLE_X, HALF_ANGLE_Y
    )
    np.testing.assert_allclose(sampled, scene, atol=1e-12)


@given(st.floats(-0.89, 0.89), st.floats(-0.85, 0.85))
def test_a_linear_scene_is_interpolated_exactly(s_x, s_y):
    x, y = (2 * np.arange(10) + 1) / 10 - 1, (2 * np.arange(7) + 1) / 7 - 1
    plane = 0.5 + 0.3 * x[None, :] - 0.2 * y[:, None]
    sampled = sample_scene(plane, *angles_at([s_x], [s_y]), HALF_ANGLE_X, HALF_ANGLE_Y)
    assert sampled[0] == pytest.approx(0.5 + 0.3 * s_x - 0.2 * s_y, abs=1e-12)


def test_outside_the_field_the_edge_is_extended_and_nan_angles_give_nan():
    scene = np.random.default_rng(1).random((7, 10))
    sampled = sample_scene(
        scene, *angles_at([-1.5, 3.0, 0.1, np.nan, 0.0], [-1.2, 1.1, -5.0, 0.0, np.nan]), HALF_ANGLE_X, HALF_ANGLE_Y
    )
    np.testing.assert_allclose(sampled[:2], [scene[0, 0], scene[-1, -1]])
    assert sampled[2] == pytest.approx(scene[0, 5])  # s_x = 0.1 is the centre of column 5
    assert np.isnan(sampled[3:]).all()


def test_scene_sampling_and_gridding_use_the_same_pixels():
    """Scene sampling agrees with the pixel formula of the picture, column = ceil(N/2 (s + 1)) - 1."""
    rng = np.random.default_rng(2)
    s = rng.uniform(-1, 1, 200_000)
    expected = np.ceil(12 / 2 * (s + 1)).astype(int) - 1
    scene = np.kron(np.arange(12.0), np.ones((30, 50)))
    for sampled in (
        sample_scene(scene, *angles_at(s, rng.uniform(-1, 1, s.size)), HALF_ANGLE_X, HALF_ANGLE_Y),
        sample_scene(scene.T, *angles_at(rng.uniform(-1, 1, s.size), s), HALF_ANGLE_X, HALF_ANGLE_Y),
    ):
        error = np.abs(sampled - expected)
        assert np.mean(error < 1e-9) == pytest.approx(1 - 11 / 12 / 50, abs=1e-3)  # all samples except those on ramps
        assert error.max() <= 0.5 + 1e-9  # on a ramp the expected pixel is the nearer one


@pytest.mark.parametrize("level", [0.01, 0.3, 1.0])
@pytest.mark.parametrize("read_noise", [0.0, 0.05])
def test_mean_and_variance_follow_the_shot_noise_law(level, read_noise):
    n = 200_000
    detector = Detector(gain=2e-3, photons_per_sample=400.0, read_noise_sd=read_noise)
    voltage = detect(np.full(n, level), 1e6, detector, np.random.default_rng(3)).astype(float)
    photons = 400.0 * level
    variance = (2e-3) ** 2 * photons + read_noise**2
    assert voltage.mean() == pytest.approx(2e-3 * photons, abs=4 * np.sqrt(variance / n))
    kurtosis = (3 * variance**2 + 2e-3**4 * photons) / variance**2  # of Poisson plus Gaussian
    assert voltage.var() == pytest.approx(variance, rel=4 * np.sqrt((kurtosis - 1) / n))


def test_photon_counts_are_integers_and_darkness_gives_zero():
    voltage = detect(np.linspace(0, 1, 1000), 1e6, FULL, np.random.default_rng(4)).astype(float)
    np.testing.assert_allclose(voltage / 2e-3, np.rint(voltage / 2e-3), atol=1e-3)
    assert not detect(np.zeros(100), 1e6, FULL, np.random.default_rng(5)).any()


NEARLY_NOISELESS_PHOTONS = 1e16  # per sample; the relative photon noise is 1e-8


def detector_of_bandwidth(bandwidth):
    return Detector(
        gain=1 / NEARLY_NOISELESS_PHOTONS, photons_per_sample=NEARLY_NOISELESS_PHOTONS, bandwidth_hz=bandwidth
    )


@settings(max_examples=25, deadline=None)  # the first call compiles
@given(st.floats(1e3, 2e7))
def test_a_step_of_light_has_an_exponential_response(bandwidth):
    """Compared with the exact response to a ramp from 0 to 1 of one sample."""
    rate, n = 5e6, 400
    voltage = detect((np.arange(n) >= 1) * 1.0, rate, detector_of_bandwidth(bandwidth), np.random.default_rng(6))
    a = 2 * np.pi * bandwidth / rate
    since = np.arange(n - 1)  # samples after the ramp's end
    expected = np.append(0.0, 1 - np.exp(-a * since) * -np.expm1(-a) / a)
    np.testing.assert_allclose(voltage, expected, atol=3e-7)
    step_response = 1 - np.exp(-a * (since + 0.5))  # the step in the middle of the ramp, to second order in a
    np.testing.assert_allclose(voltage[1:], step_response, atol=a**2 / 24 + 3e-7)


@pytest.mark.parametrize("frequency", [1e4, 1e5, 3e5])
def test_a_tone_has_the_first_order_frequency_response(frequency):
    rate, bandwidth = 5e6, 2e5
    t = np.arange(5000) / rate
    voltage = detect(
        0.5 + 0.4 * np.sin(2 * np.pi * frequency * t), rate, detector_of_bandwidth(bandwidth), np.random.default_rng(7)
    )
    t, voltage = t[500:], voltage[500:] - 0.5  # after the transient, over whole periods of each tone
    response = 2 * np.mean(voltage * np.exp(-2j * np.pi * frequency * t)) / (-0.4j)
    assert response == pytest.approx(1 / (1 + 1j * frequency / bandwidth), abs=0.02 if frequency > 2e5 else 0.002)


def test_a_finite_bandwidth_starts_settled_and_reduces_photon_noise():
    rate, bandwidth, n = 1e6, 2e4, 200_000
    detector = Detector(gain=1.0, photons_per_sample=400.0, bandwidth_hz=bandwidth)
    voltage = detect(np.full(n, 0.5), rate, detector, np.random.default_rng(8)).astype(float)
    assert abs(voltage[0] - 200) < np.sqrt(200)
    assert voltage.mean() == pytest.approx(200, abs=4 * np.sqrt(200 / n))
    assert voltage.var() == pytest.approx(200 * np.tanh(np.pi * bandwidth / rate), rel=0.05)
    correlation = np.mean((voltage[10:] - 200) * (voltage[:-10] - 200)) / voltage.var()
    assert correlation == pytest.approx(np.exp(-2 * np.pi * bandwidth / rate * 10), abs=0.02)


@pytest.mark.parametrize("bits", [1, 8, 12, 24])
def test_quantisation_rounds_to_codes_and_clips_at_full_scale(bits):
    detector = Detector(
        gain=1.0 / NEARLY_NOISELESS_PHOTONS, photons_per_sample=NEARLY_NOISELESS_PHOTONS, bits=bits, full_scale=2.0
    )
    light = np.linspace(0, 3, 10_001)
    voltage = detect(light, 1e6, detector, np.random.default_rng(9)).astype(float)
    step = 2.0 / 2**bits
    np.testing.assert_array_equal(voltage / step, np.rint(voltage / step))
    assert voltage.min() == 0
    assert voltage.max() == 2.0 - step
    inside = light < 2.0 - step
    assert np.abs(voltage - light)[inside].max() <= 0.5 * step + 1e-7


def test_quantisation_noise_has_the_variance_of_a_uniform_step():
    detector = Detector(
        gain=1.0 / NEARLY_NOISELESS_PHOTONS, photons_per_sample=NEARLY_NOISELESS_PHOTONS, bits=8, full_scale=1.0
    )
    light = np.random.default_rng(10).uniform(0.1, 0.9, 100_000)
    error = detect(light, 1e6, detector, np.random.default_rng(11)) - light
    assert error.var() == pytest.approx((1 / 256) ** 2 / 12, rel=0.02)


def test_a_seed_determines_the_recording():
    light = np.linspace(0, 1, 500)
    detector = Detector(read_noise_sd=0.01, bandwidth_hz=1e5, bits=12)
    first, repeated, other = (detect(light, 1e6, detector, np.random.default_rng(seed)) for seed in (1, 1, 2))
    assert first.dtype == np.float32
    np.testing.assert_array_equal(first, repeated)
    assert (first != other).any()
    np.testing.assert_array_equal(light, np.linspace(0, 1, 500))  # the light is not written to


@pytest.mark.parametrize(
    "wrong",
    [
        {"gain": 0.0},
        {"photons_per_sample": np.nan},
        {"read_noise_sd": -1.0},
        {"bandwidth_hz": 0.0},
        {"bits": 0},
        {"bits": 32},
        {"full_scale": np.inf},
    ],
)
def test_an_invalid_detector_parameter_is_refused_by_name(wrong):
    with pytest.raises(BadInput, match="|".join(wrong)):
        Detector(**wrong)
