"""A drift of the detector is estimated where the scan comes back, and not where every place is visited once."""

import warnings

import numpy as np
import pytest

from recon.imaging.intensity_drift import estimate_intensity_drift
from recon.imaging.revisits import is_revisited

WIDTH, RATE_HZ = 64, 1e6
TIME = np.arange(100_000) / RATE_HZ


def pixels(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    column, row = (np.clip((0.5 + 0.5 * each) * WIDTH, 0, WIDTH - 1).astype(np.int32) for each in (x, y))
    return row * WIDTH + column


def spiral(radius: np.ndarray) -> np.ndarray:
    turn = 2 * np.pi * 1870.0 * TIME
    return pixels(radius * np.sin(turn), radius * np.cos(turn))


OPENING = spiral(TIME / TIME[-1])
TWICE = spiral(np.abs(4.0 * TIME / TIME[-1] % 2.0 - 1.0))
LISSAJOUS = pixels(np.sin(2 * np.pi * 5450.0 * TIME), np.sin(2 * np.pi * 6700.0 * TIME))


def test_a_scan_outside_the_field_comes_back_nowhere() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert not is_revisited(LISSAJOUS[:0], TIME[:0])


@pytest.mark.parametrize(("pixel", "expected"), [(OPENING, False), (TWICE, True), (LISSAJOUS, True)])
def test_revisits_of_spirals_and_of_a_lissajous_figure(pixel: np.ndarray, expected: bool) -> None:
    assert is_revisited(pixel, TIME) is expected


def test_no_drift_is_removed_from_a_spiral_that_opens() -> None:
    rng = np.random.default_rng(0)
    scene = 1.0 + 0.5 * np.sin(np.arange(WIDTH) / 3.0)[:, None] * np.cos(np.arange(WIDTH) / 4.0)
    for pixel, removed in ((OPENING, False), (LISSAJOUS, True)):
        falling = scene.ravel()[pixel] * np.linspace(1.2, 0.8, pixel.size)
        light = rng.poisson(300.0 * falling) / 300.0
        drift = estimate_intensity_drift(
            lambda first, stop, p=pixel, v=light: (p[first:stop], v[first:stop]), pixel.size, WIDTH**2, RATE_HZ, "gain"
        )
        assert (drift is not None) is removed
        if drift is not None:
            assert drift.values[-1] - drift.values[0] == pytest.approx(-0.4, abs=0.03)
