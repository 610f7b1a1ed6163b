"""Distances between findings and confounders, measurements that separate them, and profile likelihood intervals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

from estimation.device_fit.data import prepare_run
from estimation.device_fit.fit import Fit, Likelihood, fit_model
from estimation.device_fit.initial import fit_progressively, flat_whiteners, window_schedule
from estimation.device_fit.model import Model
from estimation.device_fit.parameters import Candidate
from estimation.device_fit.profile_likelihood import Z_95, profile_interval
from estimation.diagnosis.experiment_design import (
    _scale_drive,
    _variations,
    discrimination_advice,
    distances_to_rivals,
    rank_experiments,
)
from scanner.terms import catalogue
from tests.support.bench import DEVICE, STIFFNESS, bench_recording, bench_signals

CUBIC, QUINTIC = (Candidate(catalogue()[f"{name}-stiffness"], "x", "sense") for name in ("cubic", "quintic"))


def cubic_spring(share: float) -> float:
    """k3 that raises the stiffness at the largest amplitude by the fraction ``share``."""
    return share * STIFFNESS / np.abs(bench_signals(0.0, 0.0)[1]).max() ** 2


@pytest.fixture(scope="module")
def fitted() -> tuple[Likelihood, Fit]:
    """A weak cubic spring, fitted with its own term."""
    run = prepare_run(bench_recording(k3=cubic_spring(0.012), seed=6), DEVICE)
    nominal, model = Model([run], DEVICE), Model([run], DEVICE, [CUBIC])
    likelihood = Likelihood([run], flat_whiteners(nominal))
    stops = window_schedule(nominal)
    start = fit_progressively(likelihood, nominal, stops)[-1]
    return likelihood, fit_model(likelihood, model, model.map_parameters_from(nominal, start.x))


def test_the_squared_distance_predicts_the_evidence_gain_over_a_confounder(fitted: tuple[Likelihood, Fit]) -> None:
    likelihood, fit = fitted
    (distance,) = distances_to_rivals(likelihood, fit, CUBIC, [QUINTIC])
    rival = Model(fit.model.runs, DEVICE, [QUINTIC])
    rival_fit = fit_model(likelihood, rival, rival.map_parameters_from(fit.model, fit.x))
    misfit_gap = rival_fit.chi2 + rival_fit.penalty - fit.chi2 - fit.penalty
    assert abs(misfit_gap - distance**2) < 2 * Z_95 * distance + 1.0  # noise scatters the gain by twice the distance
    assert distance < 4.5


def test_the_advice_names_measurements_that_separate_confounders(fitted: tuple[Likelihood, Fit]) -> None:
    likelihood, fit = fitted
    (distance,) = distances_to_rivals(likelihood, fit, CUBIC, [QUINTIC])
    distances = dict(rank_experiments(likelihood, fit, CUBIC, QUINTIC))
    assert (
        distances["with its angle recorded, noise 0.001 of the amplitude"]
        > 4.5
        > distances["with a recording at half the drive in addition"]
    )
    assert min(distances.values()) > distance
    text = discrimination_advice(likelihood, fit, CUBIC, QUINTIC, distance)
    assert text.startswith(
        f"quintic-stiffness is at a distance of {distance:.1f} σ, at which noise would favour it in "
        f"{norm.sf(distance / 2):.0%} of repeated recordings (at 4.5 σ in 1%); with its angle recorded"
    )
    assert "second, larger amplitude" in text


def test_the_profile_rises_by_the_95_percent_threshold_at_the_interval_ends(fitted: tuple[Likelihood, Fit]) -> None:
    """Compared with a refit with the value fixed at each end of the interval."""
    likelihood, fit = fitted
    i = fit.model.index("term", CUBIC.key, "k3")
    assert i is not None
    for end in profile_interval(likelihood, fit, i):
        x, free = fit.x.copy(), np.arange(fit.x.size) != i
        x += fit.covariance[:, i] / fit.covariance[i, i] * (end - fit.x[i])
        for _ in range(2):
            residual = likelihood.residual(fit.model, x)[fit.rows]
            part, precision = fit.jacobian[np.ix_(fit.rows, free)], fit.model.precision[free]
            push = part.T @ residual + precision * x[free]
            x[free] -= np.linalg.solve(part.T @ part + np.diag(precision), push)
        residual = likelihood.residual(fit.model, x)[fit.rows]
        rise = residual @ residual + fit.model.precision @ x**2 - fit.chi2 - fit.penalty
        assert rise == pytest.approx(Z_95**2, rel=0.1)
    low, high = profile_interval(likelihood, fit, i)
    scale = CUBIC.term.parameters[0].value(1.0, fit.model.scales("x"))
    assert low * scale < cubic_spring(0.012) < high * scale


class Posterior:
    """The likelihood of a model of two parameters for two samples, both fitted, and that model."""

    validation_rows, validation_noise = np.zeros(2, bool), 1.0
    precision, mains, candidates = np.full(2, 1e-12), (), ()

    def fitted(self, stop: float) -> np.ndarray:
        return ~self.validation_rows

    def best(self, *x: float) -> Fit:
        """The fit at ``x``, where the residual is zero."""
        at = np.array(x)
        rows, held_out = ~self.validation_rows, self.validation_rows
        return Fit(self, at, 0.0, 0.0, np.zeros(2), self.jacobian(self, at), rows, held_out, 1.0, 0.0)  # type: ignore[arg-type]

    def prefetch_trajectories(self, *_: object, **__: object) -> None:
        """There are none."""


class Skewed(Posterior):
    """-2 log posterior (x - 1)^2 / 0.04 above 1 and four times that below."""

    def residual(self, model: object, x: np.ndarray, stop: float = 1.0) -> np.ndarray:
        return np.array([(x[0] - 1.0) / (0.2 if x[0] > 1.0 else 0.1), x[1]])

    def jacobian(self, model: object, x: np.ndarray, *_: object) -> np.ndarray:
        return np.diag([10.0 if x[0] < 1.0 else 5.0, 1.0])


class Bent(Posterior):
    """-2 log posterior 4 (x - 1)^2 + 1e4 (y - x^2)^2: the first term alone determines the interval of x."""

    def residual(self, model: object, x: np.ndarray, stop: float = 1.0) -> np.ndarray:
        return np.array([2.0 * (x[0] - 1.0), 100.0 * (x[1] - x[0] ** 2)])

    def jacobian(self, model: object, x: np.ndarray, *_: object) -> np.ndarray:
        return np.array([[2.0, 0.0], [-200.0 * x[0], 100.0]])


def test_a_skewed_profile_has_a_skewed_interval() -> None:
    skewed = Skewed()
    low, high = profile_interval(skewed, skewed.best(1.0, 0.0), 0)  # type: ignore[arg-type]
    assert high - 1.0 == pytest.approx(Z_95 * 0.2, rel=1e-6)
    assert 1.0 - low == pytest.approx(Z_95 * 0.1, rel=1e-6)


def test_a_curved_ridge_is_followed_to_both_interval_ends() -> None:
    bent = Bent()
    fit = bent.best(1.0, 1.0)
    assert profile_interval(bent, fit, 0) == pytest.approx((1.0 - 0.5 * Z_95, 1.0 + 0.5 * Z_95), rel=1e-3)  # type: ignore[arg-type]
    _, high = profile_interval(bent, fit, 1)  # type: ignore[arg-type]
    assert high == pytest.approx((1.0 + 0.5 * Z_95) ** 2, rel=0.1)


def test_a_decay_under_a_linear_drive_of_zero_is_repeated_from_another_amplitude() -> None:
    run = prepare_run(bench_recording(k3=0.0, seed=6), DEVICE)
    silent = _scale_drive(run, 0.0, 0.0)
    scales = {"x": replace(run.scales["x"], voltage_rms=0.0, voltage_mean=0.0)}
    (only,) = _variations(Model([run], DEVICE), replace(silent, scales=scales), "x")
    assert only[0] == "a ringdown from half the amplitude"
