"""Laws that are fitted in the place of selected ones, or beside them where the first choice is impossible."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from estimation.candidate_terms.linear_model import LinearModel, LinearTerm
from estimation.device_fit.parameters import Candidate
from estimation.diagnosis.law_selection import _addition_failed
from estimation.diagnosis.rival_laws import stated_confounders
from scanner.terms import catalogue

LAWS = ("damping-drift", "coulomb-friction", "quadratic-drag", "cubic-stiffness")


def effects(*names: str) -> frozenset[tuple[str, str]]:
    return frozenset(("x", name) for name in names)


def test_the_confounder_that_a_term_states_is_fitted_in_its_place() -> None:
    rng = np.random.default_rng(2)
    factor = np.linalg.qr(rng.normal(size=(50, len(LAWS) + 1)), mode="r")
    terms = [LinearTerm(Candidate(catalogue()[name], "x", "sense"), np.array([i]), None) for i, name in enumerate(LAWS)]
    linear = LinearModel(factor, np.zeros((0, factor.shape[1])), tuple(terms), ())
    sets = stated_confounders(linear, (0, 1), fitted=())
    assert effects("coulomb-friction", "quadratic-drag") in sets
    assert not any(("x", "cubic-stiffness") in each for each in sets)
    assert sets[effects("coulomb-friction", "quadratic-drag")] == (1, 2)
    assert effects("coulomb-friction", "quadratic-drag") not in stated_confounders(linear, (0, 1), fitted=sets)


@pytest.mark.parametrize(
    ("evidence", "takes_bulk", "failed"),
    [(None, True, True), (None, False, True), (90.0, False, False), (110.0, False, True), (110.0, True, False)],
)
def test_other_laws_are_added_where_the_first_has_an_impossible_sign(
    evidence: float | None, takes_bulk: bool, failed: bool
) -> None:
    centre: Any = SimpleNamespace(
        effects=effects("gravity-stiffness"),
        fit=SimpleNamespace(neg2_log_evidence=100.0),
        takes_bulk=lambda nominal: takes_bulk,
    )
    both = effects("gravity-stiffness", "second-mode")
    fits: Any = {} if evidence is None else {both: SimpleNamespace(neg2_log_evidence=evidence)}
    assert _addition_failed(centre, [both], fits, nominal=None) is failed  # type: ignore[arg-type]
    assert not _addition_failed(centre, [effects("cubic-stiffness")], fits, nominal=None)  # type: ignore[arg-type]
