"""The shared solver, evidence and elimination against closed forms and direct integration."""

import numpy as np
import pytest

from estimation.least_squares import (
    between_variance,
    eliminate_backward,
    fit_levenberg_marquardt,
    fit_linear,
    gaussian_posterior,
    laplace_neg2_log_evidence,
)

RNG = np.random.default_rng(5)
TIME = np.linspace(0.0, 3.0, 400)


def decay(x):
    return np.exp(-x[0]) * np.exp(-(0.5 + x[1]) * TIME)


TRUE = np.array([0.3, 0.4])
DATA = decay(TRUE) + 0.01 * RNG.standard_normal(TIME.size)


def residual(x):
    return (DATA - decay(x)) / 0.01


def jacobian(x, _residual):
    return np.column_stack([decay(x), TIME * decay(x)]) / 0.01


def test_the_fit_is_the_truth_within_its_covariance_and_agrees_with_scipy():
    from scipy.optimize import least_squares

    fit = fit_levenberg_marquardt(residual, jacobian, np.zeros(2), np.ones(2), tolerance=1e-9)
    expected = least_squares(lambda x: np.append(residual(x), x), np.zeros(2)).x
    assert np.allclose(fit.x, expected, rtol=1e-5)
    assert np.all(np.abs(fit.x - TRUE) < 4.0 * np.sqrt(np.diag(fit.covariance)))
    assert fit.chi2 == pytest.approx(TIME.size, rel=0.2)


def test_omitted_samples_have_no_effect_and_fixed_parameters_keep_their_value():
    rows = TIME < 1.5
    spoilt = np.where(rows, 0.0, 100.0)
    fit = fit_levenberg_marquardt(
        lambda x: residual(x) + spoilt, jacobian, np.zeros(2), np.ones(2), rows=rows, tolerance=1e-6
    )
    assert np.allclose(fit.x, TRUE, atol=0.01)
    fixed = fit_levenberg_marquardt(residual, jacobian, np.array([0.25, 0.0]), np.ones(2), fixed=[0])
    assert fixed.x[0] == 0.25
    assert fixed.x[1] != 0.0


def test_no_step_is_longer_than_the_largest_allowed():
    tried = []

    def recorded(x):
        tried.append(x)
        return residual(x)

    fit = fit_levenberg_marquardt(recorded, jacobian, np.zeros(2), np.ones(2), max_step=np.array([0.05, 0.05]))
    assert np.abs(tried[1] - tried[0]).max() == pytest.approx(0.05)
    assert np.allclose(fit.x, TRUE, atol=0.01)


def test_a_slowly_falling_misfit_ends_after_the_stated_iterations():
    """A wrong slope predicts half of each fall, a ten thousandth of 1e18: to the end it takes 1e5 steps."""
    tried = []

    def recorded(x):
        tried.append(x)
        return np.array([1e9 - x[0], 0.0])

    fit_levenberg_marquardt(recorded, lambda x, r: np.array([[-1.0], [100.0]]), np.zeros(1), np.zeros(1))
    assert len(tried) < 200


def test_zero_iterations_return_the_start():
    fit = fit_levenberg_marquardt(residual, jacobian, np.array([0.1, 0.1]), np.ones(2), max_iterations=0)
    assert np.array_equal(fit.x, [0.1, 0.1])
    assert np.array_equal(fit.residual, residual(fit.x))


def test_the_evidence_is_the_integral_of_likelihood_and_prior():
    H, s, sd = np.array([[4.0, 1.0], [1.0, 3.0]]), np.array([2.0, -1.0]), np.array([0.7, 1.5])
    grid = np.linspace(-12.0, 12.0, 1201)
    x, y = np.meshgrid(grid, grid, indexing="ij")
    log = -0.5 * (H[0, 0] * x * x + 2 * H[0, 1] * x * y + H[1, 1] * y * y) + s[0] * x + s[1] * y
    prior = np.exp(-0.5 * ((x / sd[0]) ** 2 + (y / sd[1]) ** 2)) / (2 * np.pi * sd[0] * sd[1])
    integral = float((np.exp(log) * prior).sum()) * (grid[1] - grid[0]) ** 2
    posterior = gaussian_posterior(H, s, sd)
    assert posterior.neg2_log_evidence == pytest.approx(-2.0 * np.log(integral), rel=1e-6)
    as_matrix = gaussian_posterior(H, s, np.diag(sd))
    assert as_matrix.neg2_log_evidence == pytest.approx(posterior.neg2_log_evidence)
    assert np.allclose(posterior.covariance, np.linalg.inv(H + np.diag(sd**-2.0)))
    assert laplace_neg2_log_evidence(3.0, np.zeros((2, 2)), sd) == 3.0


def test_elimination_keeps_the_columns_that_the_score_requires():
    columns = RNG.standard_normal((200, 5))
    target = columns @ np.array([1.0, 0.0, 0.8, 0.0, 0.0]) + 0.5 * RNG.standard_normal(200)

    def score(selection):
        part = columns[:, selection] / 0.5
        return gaussian_posterior(part.T @ part, part.T @ target / 0.5, np.ones(len(selection))).neg2_log_evidence

    selection, score_after = eliminate_backward(range(5), score)
    assert selection == [0, 2]
    assert score_after == score(selection)
    assert eliminate_backward(range(5), score, removable=[1, 2], max_increase=1e9)[0] == [0, 3, 4]
    assert eliminate_backward([], lambda selection: 0.0) == ([], 0.0)


def test_a_linear_fit_in_units_of_any_size():
    basis = np.column_stack([1e-12 * TIME, np.ones_like(TIME)])
    coefficients, covariance = fit_linear(basis, 3e11 * basis[:, 0] + 2.0 + 0.01 * RNG.standard_normal(TIME.size))
    assert np.all(np.abs(coefficients - [3e11, 2.0]) < 4.0 * np.sqrt(np.diag(covariance)))


def test_the_variance_between_measurements_is_what_their_standard_deviations_do_not_explain() -> None:
    """Of 400 draws with a variance of 4 between five measurements, the mean estimate is 4 within its error of 0.2."""
    rng, sd = np.random.default_rng(0), np.array([0.5, 1.0, 1.0, 1.5, 2.0])
    draws = [between_variance(sd * rng.standard_normal(5) + 2.0 * rng.standard_normal(5), sd) for _ in range(400)]
    assert np.mean(draws) == pytest.approx(4.0, abs=0.6)
    assert between_variance(np.array([1.0, 1.5]), np.ones(2)) == 0.0
    assert between_variance(np.array([7.0]), np.ones(1)) == 0.0
    for scale in (1e-17, 1.0, 1e12):  # J [kg m2] to k/J [1/s2]
        two = between_variance(scale * np.array([1.0, 3.0]), scale * np.array([1e-8, 1e-9]))
        assert two == pytest.approx(2.0 * scale**2)
    assert between_variance(np.array([1.0, 3.0]), np.ones(2), significance=3.0) == 0.0
    assert between_variance(np.array([1.0, -1.0]), np.full(2, 1e-3), significance=3.0) == pytest.approx(2.0, rel=1e-3)
    assert np.isfinite(between_variance(np.array([1.0, -1.0]), np.array([1e-9, 3.0]), significance=3.0))
