"""The race between candidates: who stays in it, who leaves it, and the fits that it is made of."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from numpy.polynomial.chebyshev import chebval
from test_mismatch import DEVICE, recording

from estimation.mismatch.experiment import experiment
from estimation.mismatch.fit import Comparison, solve, solve_all
from estimation.mismatch.free import waves
from estimation.mismatch.model import Candidate, Model
from estimation.mismatch.naming import HOPELESS, NO_VERDICT, QUIET, SAME, _beaten, _distinct, _kept, _mirrored
from estimation.mismatch.screen import Projection, gain_of
from estimation.mismatch.start import first_whiteners, started, windows
from scanner.terms import catalogue


def test_a_mode_told_with_the_wrong_sign_goes_on_with_the_other() -> None:
    model = Model([experiment(recording(), DEVICE)], DEVICE, [Candidate(catalogue()["second-mode"], "x", "sense")])
    fit = SimpleNamespace(model=model, x=np.linspace(-0.9, -0.1, len(model.free)))
    changed = _mirrored(fit) != fit.x  # type: ignore[arg-type]
    assert [f.name for f, turned in zip(model.free, changed, strict=True) if turned] == ["c", "0", "1"]


def test_who_explains_a_window_as_well_stays_in_the_race() -> None:
    def fit(evidence: float, chi2: float) -> SimpleNamespace:
        model = SimpleNamespace(free=[], candidates=[])
        return SimpleNamespace(model=model, x=np.zeros(0), evidence=evidence, chi2=chi2, rows=np.ones(1000, bool))

    bent = 2.0 * NO_VERDICT  # what nominal values cost
    fits = [fit(1000.0, 990.0), fit(1000.0 + bent, 995.0), fit(1000.0 + bent, 1100.0), fit(9000.0, 8990.0)]
    far = [each.model for each in fits[:2]]
    assert [model for model, _ in _kept(fits[:3], False, True)] == far  # type: ignore[arg-type]
    lost = [fit(each.evidence + 5000.0, each.chi2 + 5000.0) for each in fits[:3]]
    assert len(_kept(lost, False, True)) == 1  # type: ignore[arg-type]


def test_a_fit_that_misses_more_by_now_than_its_rival_in_all_is_beaten() -> None:
    comparison = SimpleNamespace(rows=np.ones(20_000, bool))
    rival = SimpleNamespace(evidence=20_300.0, residual=np.ones(20_000))
    seen = np.arange(20_000) < 8000
    least = 8000.0 + HOPELESS + 300.0 + (1.0 - QUIET) * 12_000
    for chi2, beaten in ((least - 1.0, False), (least + 1.0, True)):
        fit = SimpleNamespace(rows=seen, chi2=chi2)
        assert _beaten(comparison, fit, rival) is beaten  # type: ignore[arg-type]
    assert not _beaten(comparison, fit, None)  # type: ignore[arg-type]


def test_around_a_motion_that_has_burst_nothing_is_promised() -> None:
    free = [SimpleNamespace(kind="nominal", owner="x")] * 2
    model = SimpleNamespace(free=free, precision=np.ones(2))
    burst = SimpleNamespace(jacobian=np.full((3, 2), 1e20), residual=np.full(3, 1e6), x=np.zeros(2), model=model)
    known = Projection(burst, np.ones(3, bool))  # type: ignore[arg-type]
    assert gain_of(*known.system(np.ones((3, 1)))[:2])[0] == 0.0


def test_starts_of_one_candidate_that_have_met_go_on_as_one() -> None:
    def fit(key: str, residual: np.ndarray) -> SimpleNamespace:
        model = SimpleNamespace(candidates=[SimpleNamespace(key=key)])
        return SimpleNamespace(model=model, residual=residual, rows=np.arange(100) < 90)

    first = np.random.default_rng(0).normal(size=100)
    near, far = first.copy(), first.copy()
    near[:90] += 0.9 * np.sqrt(SAME / 90)
    near[90:] += 9.0  # which no window has seen
    far[:90] -= 1.1 * np.sqrt(SAME / 90)
    fits = [fit("mode", first), fit("mode", near), fit("law", first), fit("mode", far)]
    assert list(_distinct(fits)) == [fits[0], fits[2], fits[3]]  # type: ignore[arg-type]


def test_fits_two_at_a_time_are_what_each_is_alone() -> None:
    run = experiment(recording(k3=2.0, seed=9), DEVICE)
    nominal = Model([run], DEVICE)
    comparison, stop = Comparison([run], first_whiteners(nominal)), windows(nominal)[0]
    x = started(comparison, nominal, stop).x
    models = [Model([run], DEVICE, [Candidate(catalogue()[name], "x", "sense")]) for name in
              ("cubic-stiffness", "quadratic-drag", "second-mode")]  # fmt: skip
    starts = [(model, model.embed(nominal, x)) for model in [*models, models[0]]]
    for start, fit in zip(starts, solve_all(comparison, starts, stop, turns=3), strict=True):
        alone = solve(comparison, *start, stop, 3)
        np.testing.assert_array_equal(fit.x, alone.x)
        assert fit.evidence == alone.evidence


@pytest.mark.parametrize("numbers", [1, 2, 9, 24])
def test_waves_are_a_sum_of_cosines(numbers: int) -> None:
    rng = np.random.default_rng(numbers)
    turn, sizes = rng.uniform(0.0, np.pi, (700, 3)), rng.normal(size=numbers)
    np.testing.assert_allclose(waves(turn, sizes), chebval(np.cos(turn), sizes), rtol=0, atol=1e-12)
    np.testing.assert_allclose(waves(turn, sizes), np.cos(np.multiply.outer(turn, range(numbers))) @ sizes, atol=1e-12)
