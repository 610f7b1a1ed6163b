"""Named laws beside a discrepancy: which are selected, and what they take of a misfit."""

from __future__ import annotations

import numpy as np
import pytest

from estimation.diagnosis.discrepancy import DISCREPANCY_TERMS
from estimation.diagnosis.law_selection import LinearModel, LinearTerm
from estimation.diagnosis.parameters import Candidate
from scanner.terms import catalogue

SAMPLES, FREE = 600, 12
LAWS = ("cubic-stiffness", "cubic-damping", "sensor-cubic")


def linear_model(weights: dict[str, float], discrepancy: float, seed: int = 3) -> LinearModel:
    """Random sensitivities of three laws, the first two inside the span of a free torque, and a misfit made of them."""
    rng = np.random.default_rng(seed)
    free = {name: 40.0 * rng.normal(size=(SAMPLES, FREE)) for name in ("free-mechanics", "free-readout")}
    mix = {"cubic-stiffness": ("free-mechanics", 0), "cubic-damping": ("free-mechanics", 1),
           "sensor-cubic": ("free-readout", 0)}  # fmt: skip
    columns = [2.0 * free[mix[name][0]][:, mix[name][1] : mix[name][1] + 1] for name in LAWS] + list(free.values())
    misfit = rng.normal(size=SAMPLES) + discrepancy * free["free-readout"] @ rng.normal(size=FREE)
    for name, weight in weights.items():
        misfit = misfit + weight * columns[LAWS.index(name)][:, 0]
    terms = [catalogue()[name] for name in LAWS] + [DISCREPANCY_TERMS[name] for name in free]
    ends = np.cumsum([0, *(column.shape[1] for column in columns)])
    linear = [
        LinearTerm(Candidate(term, "x", "sense"), np.arange(low, high), None)
        for term, low, high in zip(terms, ends[:-1], ends[1:], strict=True)
    ]
    factor = np.linalg.qr(np.column_stack([*columns, misfit]), mode="r")
    nothing_else = np.zeros((0, factor.shape[1]))
    return LinearModel(factor, nothing_else, tuple(linear[: len(LAWS)]), tuple(linear[len(LAWS) :]))


def selected(model: LinearModel) -> set[str]:
    return {model.laws[i].candidate.term.effect for i in model.without_small(model.select()).laws}


@pytest.mark.parametrize("discrepancy", [0.0, 0.02, 0.05])
def test_a_law_is_selected_beside_a_small_discrepancy(discrepancy: float) -> None:
    model = linear_model({"cubic-damping": 1.0}, discrepancy)
    assert selected(model) == {"cubic-damping"}
    found = model.select()
    assert model.bulk(found, found.laws[0]) > 0.9
    assert all(rival.evidence_gap > 0.0 for rival in model.rivals(found, found.laws[0]))


def test_two_laws_are_selected_together() -> None:
    model = linear_model({"cubic-damping": 1.0, "sensor-cubic": 0.8}, 0.02)
    assert selected(model) == {"cubic-damping", "sensor-cubic"}


def test_a_misfit_without_a_law_leaves_the_discrepancy_alone() -> None:
    assert selected(linear_model({}, 0.3)) == set()
    assert selected(linear_model({}, 0.0)) == set()


def test_a_law_as_small_as_an_imperfection_is_left_to_the_remainder() -> None:
    assert selected(linear_model({"cubic-damping": 1.0, "cubic-stiffness": 0.05}, 0.02)) == {"cubic-damping"}


def test_a_discrepancy_keeps_the_part_of_its_stage_that_no_law_takes() -> None:
    model = linear_model({"sensor-cubic": 0.4}, 0.2)
    at = [each.candidate.term.effect for each in model.laws].index("sensor-cubic")
    assert model.bulk(model.hypothesis((at,)), at) < 0.7


def test_rounding_does_not_decide_between_laws_of_nearly_the_same_effect() -> None:
    rng = np.random.default_rng(4)
    common, difference = rng.normal(size=(2, SAMPLES))
    columns = [1e8 * common, 1e8 * common + difference, rng.normal(size=SAMPLES), rng.normal(size=SAMPLES)]
    terms = [*(catalogue()[name] for name in LAWS), DISCREPANCY_TERMS["free-readout"]]
    linear = tuple(LinearTerm(Candidate(term, "x", "sense"), np.array([i]), None) for i, term in enumerate(terms))
    factor = np.linalg.qr(np.column_stack([*columns, 3.0 * columns[1]]), mode="r")
    model = LinearModel(factor, np.zeros((0, 5)), linear[:3], linear[3:])
    exact, near = (model.hypothesis((law,)).misfit for law in (1, 0))
    assert exact == pytest.approx(9.0, abs=0.1)  # of the prior
    assert near - exact == pytest.approx(9.0 * SAMPLES, rel=0.2)
    assert selected(model) == {"cubic-damping"}
