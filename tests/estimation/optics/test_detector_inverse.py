"""The low-pass of a slow detector is undone: time and size of the light, its photon noise, and missing samples."""

from dataclasses import replace

import numpy as np
import pytest

from estimation.optics.correction import correct_intensity
from estimation.optics.detector_inverse import MIN_REGULARISATION, inverse_filter, measure_regularisation
from phantoms.optics import Detector, detect
from scanner.arrays import Array
from scanner.channel import Channel
from scanner.device import Device
from scanner.recording import Recording

RATE_HZ, CORNER_HZ = 5e6, 2e5
DEVICE = Device.from_toml(f"[x]\n[y]\n[x.terms.detector-lag]\nf_c = {CORNER_HZ}\n")
DETECTOR = Detector(gain=1e-3, photons_per_sample=1e3, bandwidth_hz=CORNER_HZ)


def light(time_s: Array) -> Array:
    return 0.5 + 0.2 * np.sin(2 * np.pi * 3e5 * time_s) + 0.2 * np.sin(2 * np.pi * 7e5 * time_s + 1.0)


def corrected(values: Array) -> Channel:
    recording = Recording.from_arrays({"intensity": (values, "V", RATE_HZ)}, DEVICE)
    return correct_intensity(recording, DEVICE, undo_lag=True)["intensity"]


def test_the_light_is_recovered_at_its_time() -> None:
    many = replace(DETECTOR, gain=1e-12, photons_per_sample=1e12)
    values = detect(light(np.arange(4000) / RATE_HZ), RATE_HZ, many, np.random.default_rng(0))
    found = corrected(values.astype(float))
    inner = slice(100, 3900)
    np.testing.assert_allclose(found.read()[inner], light(found.time())[inner], atol=0.02)
    assert np.abs(values - light(np.arange(4000) / RATE_HZ))[inner].max() > 0.2


def edges(size: int) -> Array:
    """Light that steps to another value every ten samples on average."""
    rng = np.random.default_rng(1)
    steps = rng.random(size) < 0.1
    return np.asarray(rng.uniform(0.2, 0.8, size)[np.cumsum(steps) - 1])


def test_photon_noise_grows_by_less_than_a_half() -> None:
    fast, slow = (
        detect(edges(50000), RATE_HZ, replace(DETECTOR, bandwidth_hz=corner), np.random.default_rng(0))
        - detect(
            edges(50000),
            RATE_HZ,
            replace(DETECTOR, bandwidth_hz=corner, gain=1e-12, photons_per_sample=1e12),
            np.random.default_rng(0),
        )
        for corner in (None, CORNER_HZ)
    )
    noise = np.convolve(slow, inverse_filter(CORNER_HZ, 1 / RATE_HZ), "valid")
    assert slow.std() < 0.5 * fast.std() < noise.std() < 1.5 * fast.std()


def test_noise_is_not_amplified_where_there_is_no_light_to_recover() -> None:
    rng = np.random.default_rng(0)
    fast = detect(np.full(50000, 0.5), RATE_HZ, replace(DETECTOR, bandwidth_hz=None), rng)
    slow = detect(np.full(50000, 0.5), RATE_HZ, DETECTOR, rng)
    assert corrected(slow.astype(float)).read().std() < fast.std()


@pytest.mark.parametrize("read_noise", [0.0, 1e-3])
def test_the_noise_is_measured_relative_to_the_detail(read_noise: float) -> None:
    """A tenth of the light has ten times the relative noise, and a fifteenth of the detail more than 200 times."""

    def measured(photons: float, contrast: float = 1.0) -> float:
        noisy = Detector(1.0 / photons, photons, read_noise, CORNER_HZ)
        values = detect(0.5 + contrast * (edges(60000) - 0.5), RATE_HZ, noisy, np.random.default_rng(0))
        return measure_regularisation(values.astype(float), CORNER_HZ, 1 / RATE_HZ)

    assert measured(1e5) == MIN_REGULARISATION
    assert MIN_REGULARISATION <= measured(100.0) < measured(10.0) < measured(10.0, 1.0 / 15.0)
    assert measured(10.0) == pytest.approx(np.sqrt(10.0) * measured(1.0) / 10.0, rel=0.2)


def test_a_recording_too_short_for_a_spectrum_has_the_least_regularisation() -> None:
    for values in (np.zeros(0), np.ones(10), np.ones(1000), np.full(1000, np.nan)):
        assert measure_regularisation(values, CORNER_HZ, 1 / RATE_HZ) == MIN_REGULARISATION


def test_parts_are_read_as_the_whole_is() -> None:
    found = corrected(np.random.default_rng(0).normal(size=(200, 2)))
    whole = found.read()
    for first, stop in ((0, 5), (7, 60), (190, 200), (50, 50)):
        np.testing.assert_allclose(found.read(first, stop), whole[first:stop])


@pytest.mark.parametrize("corner", [1e4, 2e5, 1e8])
def test_constant_light_is_unchanged(corner: float) -> None:
    assert inverse_filter(corner, 1 / RATE_HZ).sum() == pytest.approx(1.0)
