"""The variance of residuals is that of the noise in any unit of the intensity, and positive without noise."""

import numpy as np
import pytest

from recon.imaging.sample_motion.residual_noise import fit_residual_noise

COUNT = 4000


@pytest.mark.parametrize("unit", [1.0, 1e-9, 1e-12, 1e9])
def test_the_variance_scales_with_the_unit_of_the_intensity(unit: float) -> None:
    """A photocurrent in amperes has a variance of 1e-20: no bound in the unit of the intensity may exceed it."""
    rng = np.random.default_rng(0)
    expected, gradient = rng.uniform(1.0, 5.0, COUNT), rng.exponential(0.3, COUNT)
    residual = np.sqrt(0.01 + 0.02 * expected) * rng.standard_normal(COUNT)
    usual = fit_residual_noise(expected, gradient, residual)
    other = fit_residual_noise(unit * expected, unit**2 * gradient, unit * residual)
    np.testing.assert_allclose(other.at(unit * expected, unit**2 * gradient), unit**2 * usual.at(expected, gradient))


@pytest.mark.parametrize("level", [0.0, 1e-9, 1.0])
def test_a_recording_without_noise_has_a_positive_variance(level: float) -> None:
    noise = fit_residual_noise(np.full(COUNT, level), np.zeros(COUNT), np.zeros(COUNT))
    assert noise.floor > 0.0
