"""How far findings stand from their look-alikes, what would tell them apart, and intervals by profile likelihood."""

from __future__ import annotations

import numpy as np
import pytest
from test_mismatch import DEVICE, K, recording, signals

from estimation.mismatch.advice import advice, distances_from, remedies
from estimation.mismatch.experiment import experiment
from estimation.mismatch.fit import Comparison, Fit, solve
from estimation.mismatch.intervals import SIDE, profile_interval
from estimation.mismatch.model import Candidate, Model
from estimation.mismatch.start import first_whiteners, grown, started, windows
from scanner.terms import catalogue

CUBIC, QUINTIC = (Candidate(catalogue()[f"{name}-stiffness"], "x", "sense") for name in ("cubic", "quintic"))


def cubic_spring(share: float) -> float:
    """k3 that adds ``share`` to the stiffness at full swing."""
    return share * K / np.abs(signals(0.0, 0.0)[1]).max() ** 2


@pytest.fixture(scope="module")
def fitted() -> tuple[Comparison, Fit]:
    """A weak cubic spring, fitted with its own term."""
    run = experiment(recording(k3=cubic_spring(0.012), seed=6), DEVICE)
    nominal, model = Model([run], DEVICE), Model([run], DEVICE, [CUBIC])
    comparison = Comparison([run], first_whiteners(nominal))
    stops = windows(nominal)
    start = grown(comparison, nominal, started(comparison, nominal, stops[0]).x, stops)[-1]
    return comparison, solve(comparison, model, model.embed(nominal, start.x))


def test_the_square_of_the_distance_foretells_the_lead_over_a_rival(fitted: tuple[Comparison, Fit]) -> None:
    comparison, fit = fitted
    (distance,) = distances_from(comparison, fit, CUBIC, [QUINTIC])
    rival = Model(fit.model.runs, DEVICE, [QUINTIC])
    instead = solve(comparison, rival, rival.embed(fit.model, fit.x))
    lead = instead.chi2 + instead.penalty - fit.chi2 - fit.penalty
    assert abs(lead - distance**2) < 2 * SIDE * distance + 1.0  # which noise scatters by twice the distance
    assert distance < 4.5


def test_what_would_tell_them_apart_is_worked_out(fitted: tuple[Comparison, Fit]) -> None:
    comparison, fit = fitted
    (distance,) = distances_from(comparison, fit, CUBIC, [QUINTIC])
    told = dict(remedies(comparison, fit, CUBIC, QUINTIC))
    assert (
        told["with its angle recorded, noise 0.001 of the swing"] > 4.5 > told["beside a recording at half the drive"]
    )
    assert min(told.values()) > distance
    said = advice(comparison, fit, CUBIC, QUINTIC, distance)
    assert said.startswith(f"quintic-stiffness lies {distance:.1f} σ away, 4.5 are needed; with its angle recorded")
    assert "second, larger amplitude" in said


def test_the_profile_rises_by_what_95_percent_are(fitted: tuple[Comparison, Fit]) -> None:
    """Held against a refit with the value fixed at the interval's ends."""
    comparison, fit = fitted
    i = fit.model.index("term", CUBIC.key, "k3")
    assert i is not None
    for end in profile_interval(comparison, fit, i):
        x, free = fit.x.copy(), np.arange(fit.x.size) != i
        x += fit.covariance[:, i] / fit.covariance[i, i] * (end - fit.x[i])
        for _ in range(2):
            residual = comparison.residual(fit.model, x)[fit.rows]
            part, precision = fit.jacobian[np.ix_(fit.rows, free)], fit.model.precision[free]
            push = part.T @ residual + precision * x[free]
            x[free] -= np.linalg.solve(part.T @ part + np.diag(precision), push)
        residual = comparison.residual(fit.model, x)[fit.rows]
        rise = residual @ residual + fit.model.precision @ x**2 - fit.chi2 - fit.penalty
        assert rise == pytest.approx(SIDE**2, rel=0.1)
    low, high = profile_interval(comparison, fit, i)
    scale = CUBIC.term.parameters[0].value(1.0, fit.model.scales("x"))
    assert low * scale < cubic_spring(0.012) < high * scale


class Posterior:
    """A comparison of two samples with a model of two numbers, and that model; both samples are fitted."""

    held, precision = np.zeros(2, bool), np.full(2, 1e-12)

    def fitted(self, stop: float) -> np.ndarray:
        return ~self.held

    def best(self, *x: float) -> Fit:
        """The fit at ``x``, where nothing is missed."""
        at = np.array(x)
        return Fit(self, at, 0.0, 0.0, np.zeros(2), self.jacobian(self, at), ~self.held, self.held, 0.0)  # type: ignore[arg-type]


class Skewed(Posterior):
    """-2 log posterior (x - 1)^2 / 0.04 above 1 and four times that below."""

    def residual(self, model: object, x: np.ndarray, stop: float = 1.0) -> np.ndarray:
        return np.array([(x[0] - 1.0) / (0.2 if x[0] > 1.0 else 0.1), x[1]])

    def jacobian(self, model: object, x: np.ndarray, *_: object) -> np.ndarray:
        return np.diag([10.0 if x[0] < 1.0 else 5.0, 1.0])


class Bent(Posterior):
    """-2 log posterior 4 (x - 1)^2 + 1e4 (y - x^2)^2: of x there is no doubt but the first term's, wherever y goes."""

    def residual(self, model: object, x: np.ndarray, stop: float = 1.0) -> np.ndarray:
        return np.array([2.0 * (x[0] - 1.0), 100.0 * (x[1] - x[0] ** 2)])

    def jacobian(self, model: object, x: np.ndarray, *_: object) -> np.ndarray:
        return np.array([[2.0, 0.0], [-200.0 * x[0], 100.0]])


def test_a_skewed_profile_has_a_skewed_interval() -> None:
    skewed = Skewed()
    low, high = profile_interval(skewed, skewed.best(1.0, 0.0), 0)  # type: ignore[arg-type]
    assert high - 1.0 == pytest.approx(SIDE * 0.2, rel=1e-6)
    assert 1.0 - low == pytest.approx(SIDE * 0.1, rel=1e-6)


def test_a_bent_ridge_is_followed_to_its_ends() -> None:
    bent = Bent()
    fit = bent.best(1.0, 1.0)
    assert profile_interval(bent, fit, 0) == pytest.approx((1.0 - 0.5 * SIDE, 1.0 + 0.5 * SIDE), rel=1e-3)  # type: ignore[arg-type]
    _, high = profile_interval(bent, fit, 1)  # type: ignore[arg-type]
    assert high == pytest.approx((1.0 + 0.5 * SIDE) ** 2, rel=0.1)
