"""Optics: the spot's width, the place that an angle looks at, and the detector's laws against theory."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from phantoms.optics import FWHM_PER_SD, Detector, blur, detect, sample
from scanner.errors import BadInput

HALF_X, HALF_Y = 0.18, 0.16
FULL = Detector(gain=2e-3, photons_per_sample=400.0, full_scale=2.0)


def spot(shape=(161, 241)):
    scene = np.zeros(shape)
    scene[shape[0] // 2, shape[1] // 2] = 1.0
    return scene


def width(profile):
    """Standard deviation of a distribution over pixels."""
    place = np.arange(profile.size)
    mean = profile @ place / profile.sum()
    return np.sqrt(profile @ (place - mean) ** 2 / profile.sum())


@pytest.mark.parametrize("sd_um", [1.6, 2.5, 5.0])
def test_spot_has_its_width_in_micrometres_on_both_axes(sd_um):
    scene = spot()
    seen = blur(scene, sd_um, field_x_um=241.0, field_y_um=322.0)  # pixels 1 um wide, 2 um high
    assert seen.sum() == pytest.approx(1.0, abs=1e-9)
    assert width(seen.sum(0)) == pytest.approx(sd_um, rel=2e-3)
    assert width(seen.sum(1)) == pytest.approx(sd_um / 2, rel=2e-3)


def test_spot_is_half_as_bright_half_its_fwhm_away():
    fwhm = 12.0
    seen = blur(spot(), fwhm / FWHM_PER_SD, 241.0, 161.0)
    assert seen[80, 126] / seen[80, 120] == pytest.approx(0.5, rel=1e-6)
    assert seen[74, 120] / seen[80, 120] == pytest.approx(0.5, rel=1e-6)


def test_spot_leaves_an_even_scene_and_a_spot_of_no_width_any_scene():
    even = np.full((40, 50), 0.3)
    np.testing.assert_allclose(blur(even, 30.0, 50.0, 40.0), 0.3, atol=1e-12)  # also at the edge
    np.testing.assert_array_equal(blur(spot(), 0.0, 241.0, 161.0), spot())


def test_a_spot_that_the_scene_cannot_show_is_refused():
    with pytest.raises(BadInput, match=r"0\.25 scene pixels; give the target more pixels"):
        blur(spot(), 0.25, 241.0, 161.0)


def at(s_x, s_y):
    return np.asarray(s_x) * HALF_X, np.asarray(s_y) * HALF_Y


def test_an_angle_at_a_pixels_centre_reads_that_pixel():
    scene = np.random.default_rng(0).random((7, 10))
    row, column = np.mgrid[:7, :10]
    seen = sample(scene, *at((2 * column + 1) / 10 - 1, (2 * row + 1) / 7 - 1), HALF_X, HALF_Y)
    np.testing.assert_allclose(seen, scene, atol=1e-12)


@given(st.floats(-0.89, 0.89), st.floats(-0.85, 0.85))
def test_a_plane_is_read_exactly_between_pixels(s_x, s_y):
    x, y = (2 * np.arange(10) + 1) / 10 - 1, (2 * np.arange(7) + 1) / 7 - 1
    plane = 0.5 + 0.3 * x[None, :] - 0.2 * y[:, None]
    seen = sample(plane, *at([s_x], [s_y]), HALF_X, HALF_Y)
    assert seen[0] == pytest.approx(0.5 + 0.3 * s_x - 0.2 * s_y, abs=1e-12)


def test_outside_the_field_the_edge_goes_on_and_nan_stays_nan():
    scene = np.random.default_rng(1).random((7, 10))
    seen = sample(scene, *at([-1.5, 3.0, 0.1, np.nan, 0.0], [-1.2, 1.1, -5.0, 0.0, np.nan]), HALF_X, HALF_Y)
    np.testing.assert_allclose(seen[:2], [scene[0, 0], scene[-1, -1]])
    assert seen[2] == pytest.approx(scene[0, 5])  # s_x = 0.1 is the centre of column 5
    assert np.isnan(seen[3:]).all()


def test_what_is_sampled_lands_in_the_picture_pixel_that_it_came_from():
    """The scene's convention and the picture's pixel law (column = ceil(N/2 (s + 1)) - 1) are one."""
    rng = np.random.default_rng(2)
    s = rng.uniform(-1, 1, 200_000)
    own = np.ceil(12 / 2 * (s + 1)).astype(int) - 1
    scene = np.kron(np.arange(12.0), np.ones((30, 50)))
    for seen in (
        sample(scene, *at(s, rng.uniform(-1, 1, s.size)), HALF_X, HALF_Y),
        sample(scene.T, *at(rng.uniform(-1, 1, s.size), s), HALF_X, HALF_Y),
    ):
        off = np.abs(seen - own)
        assert np.mean(off < 1e-9) == pytest.approx(1 - 11 / 12 / 50, abs=1e-3)  # all but the ramps between the pixels
        assert off.max() <= 0.5 + 1e-9  # and on a ramp the own pixel is the nearer one


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


def test_photon_noise_is_counted_and_the_dark_is_dark():
    voltage = detect(np.linspace(0, 1, 1000), 1e6, FULL, np.random.default_rng(4)).astype(float)
    np.testing.assert_allclose(voltage / 2e-3, np.rint(voltage / 2e-3), atol=1e-3)
    assert not detect(np.zeros(100), 1e6, FULL, np.random.default_rng(5)).any()


BRIGHT = 1e16  # photons a sample: photon noise at 1e-8


def band(bandwidth):
    return Detector(gain=1 / BRIGHT, photons_per_sample=BRIGHT, bandwidth_hz=bandwidth)


@settings(max_examples=25, deadline=None)  # the first call compiles
@given(st.floats(1e3, 2e7))
def test_a_step_of_light_rises_as_one_minus_exp(bandwidth):
    """Against the exact answer to a rise from 0 to 1 between two samples, which is a ramp one sample long."""
    rate, n = 5e6, 400
    voltage = detect((np.arange(n) >= 1) * 1.0, rate, band(bandwidth), np.random.default_rng(6))
    a = 2 * np.pi * bandwidth / rate
    since = np.arange(n - 1)  # samples after the ramp's end
    expected = np.append(0.0, 1 - np.exp(-a * since) * -np.expm1(-a) / a)
    np.testing.assert_allclose(voltage, expected, atol=3e-7)
    late = 1 - np.exp(-a * (since + 0.5))  # the step in the middle of the ramp, to second order in a
    np.testing.assert_allclose(voltage[1:], late, atol=a**2 / 24 + 3e-7)


@pytest.mark.parametrize("frequency", [1e4, 1e5, 3e5])
def test_a_tone_comes_out_smaller_and_later_by_the_first_order_law(frequency):
    rate, bandwidth = 5e6, 2e5
    t = np.arange(5000) / rate
    voltage = detect(0.5 + 0.4 * np.sin(2 * np.pi * frequency * t), rate, band(bandwidth), np.random.default_rng(7))
    t, voltage = t[500:], voltage[500:] - 0.5  # past the start, over whole periods of each tone
    response = 2 * np.mean(voltage * np.exp(-2j * np.pi * frequency * t)) / (-0.4j)
    assert response == pytest.approx(1 / (1 + 1j * frequency / bandwidth), abs=0.02 if frequency > 2e5 else 0.002)


def test_bandwidth_starts_at_rest_and_calms_photon_noise():
    rate, bandwidth, n = 1e6, 2e4, 200_000
    detector = Detector(gain=1.0, photons_per_sample=400.0, bandwidth_hz=bandwidth)
    voltage = detect(np.full(n, 0.5), rate, detector, np.random.default_rng(8)).astype(float)
    assert abs(voltage[0] - 200) < np.sqrt(200)
    assert voltage.mean() == pytest.approx(200, abs=4 * np.sqrt(200 / n))
    assert voltage.var() == pytest.approx(200 * np.tanh(np.pi * bandwidth / rate), rel=0.05)
    memory = np.mean((voltage[10:] - 200) * (voltage[:-10] - 200)) / voltage.var()
    assert memory == pytest.approx(np.exp(-2 * np.pi * bandwidth / rate * 10), abs=0.02)


@pytest.mark.parametrize("bits", [1, 8, 12, 24])
def test_bits_round_to_codes_over_the_full_scale_and_clip(bits):
    detector = Detector(gain=1.0 / BRIGHT, photons_per_sample=BRIGHT, bits=bits, full_scale=2.0)
    light = np.linspace(0, 3, 10_001)
    voltage = detect(light, 1e6, detector, np.random.default_rng(9)).astype(float)
    step = 2.0 / 2**bits
    np.testing.assert_array_equal(voltage / step, np.rint(voltage / step))
    assert voltage.min() == 0
    assert voltage.max() == 2.0 - step
    inside = light < 2.0 - step
    assert np.abs(voltage - light)[inside].max() <= 0.5 * step + 1e-7


def test_quantisation_noise_is_a_twelfth_of_a_step_squared():
    detector = Detector(gain=1.0 / BRIGHT, photons_per_sample=BRIGHT, bits=8, full_scale=1.0)
    light = np.random.default_rng(10).uniform(0.1, 0.9, 100_000)
    error = detect(light, 1e6, detector, np.random.default_rng(11)) - light
    assert error.var() == pytest.approx((1 / 256) ** 2 / 12, rel=0.02)


def test_one_seed_gives_one_recording():
    light = np.linspace(0, 1, 500)
    detector = Detector(read_noise_sd=0.01, bandwidth_hz=1e5, bits=12)
    first, again, other = (detect(light, 1e6, detector, np.random.default_rng(seed)) for seed in (1, 1, 2))
    assert first.dtype == np.float32
    np.testing.assert_array_equal(first, again)
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
def test_a_detector_that_cannot_be_is_refused_by_name(wrong):
    with pytest.raises(BadInput, match="|".join(wrong)):
        Detector(**wrong)
