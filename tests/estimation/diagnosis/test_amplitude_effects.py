"""Which amplitude-dependent frequency and damping other laws are selected around."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from estimation.diagnosis import selection

NOMINAL = SimpleNamespace(neg2_log_evidence=1e6)


@pytest.mark.parametrize(
    ("cubic", "follows", "gravity", "chosen"),
    [
        (900.0, (True, True), 500.0, "gravity-stiffness"),
        (900.0, (True, True), 150.0, "cubic-stiffness"),  # a hanging mass that hardens
        (500.0, (True, True), 900.0, "cubic-stiffness"),
        (500.0, (False, True), 900.0, "gravity-stiffness"),  # a fit that loses the motion is no start
        (900.0, (True, False), 500.0, "cubic-stiffness"),
        (900.0, (False, False), 500.0, None),
        (10.0, (True, True), 5.0, "cubic-stiffness"),  # it leaves only noise: no other is tried
    ],
)
def test_it_is_the_one_with_the_best_evidence_that_follows_the_motion(
    cubic: float, follows: tuple[bool, bool], gravity: float, chosen: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    fits = {
        effect: SimpleNamespace(neg2_log_evidence=evidence, follows=found)
        for effect, evidence, found in zip(
            ("cubic-stiffness", "gravity-stiffness"), (cubic, gravity), follows, strict=True
        )
    }

    possible = {"cubic-stiffness": True, "gravity-stiffness": gravity != 150.0}

    def fit_anchor(likelihood: object, nominal: object, early: object, stops: object, groups: Any) -> Any:
        fit = fits[groups[0][0].term.effect]
        return (fit if fit.follows else NOMINAL), [fit]

    monkeypatch.setattr(selection, "fit_anchor", fit_anchor)
    monkeypatch.setattr(selection, "has_possible_signs", lambda fit, effect: fit is fits[effect] and possible[effect])
    monkeypatch.setattr(selection, "_is_explained", lambda anchor, nominal: anchor.neg2_log_evidence < 100.0)
    search = SimpleNamespace(
        nominal=NOMINAL,
        likelihood=None,
        early=(),
        stops=(),
        of_effects=lambda effects: [SimpleNamespace(term=SimpleNamespace(effect=effect)) for effect in effects],
    )
    anchor, _ = selection._fit_amplitude_effects(search)  # type: ignore[arg-type]
    assert anchor is (NOMINAL if chosen is None else fits[chosen])
