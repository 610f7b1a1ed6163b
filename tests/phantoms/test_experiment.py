"""Arguments of a simulated scan."""

from __future__ import annotations

import numpy as np
import pytest

import lissajous
from phantoms.optics import detect, imaging_detector
from scanner.errors import BadInput


def test_a_drift_of_an_axis_that_does_not_exist_is_refused() -> None:
    with pytest.raises(BadInput, match="drift: names 'z'; name the axes x and y"):
        lissajous.simulate(duration=1e-3, drift={"x": 0.0, "z": -0.002})


@pytest.mark.parametrize("photons", [1.0, 10.0, 1000.0, 5000.0, 1e7])
def test_the_converter_holds_full_light_and_its_noise(photons: float) -> None:
    detector = imaging_detector(photons)
    signal = detect(np.ones(100_000), 5e6, detector, np.random.default_rng(0)).astype(float)
    assert signal.max() < detector.full_scale * (1.0 - 2.0**-12)
    assert np.mean(signal) == pytest.approx(min(1.0, 1e-3 * photons), rel=0.02)
    rounding = detector.full_scale / 4096 / np.sqrt(12.0)
    assert np.std(signal) == pytest.approx(np.hypot(detector.gain * np.sqrt(photons), rounding), rel=0.05)
