"""Probability of a finding among its rivals and beside a residual that no law explains."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from estimation.device_fit.data import prepare_run
from estimation.device_fit.fit import Likelihood
from estimation.device_fit.initial import flat_whiteners
from estimation.device_fit.model import Model
from estimation.device_fit.parameters import Candidate
from estimation.diagnosis import finding
from estimation.diagnosis.finding import _advice, beside_imperfections, find_probabilities, parameter_estimates
from estimation.diagnosis.localisation import describe_localisation
from scanner.terms import catalogue
from tests.support.simulated import shared_electrode


def step(effect: str, *rivals: tuple[str, float], gain: float = 100.0) -> SimpleNamespace:
    """A selected law with rivals, whose -2 log evidence is larger by the given gaps."""

    def candidate(name: str) -> SimpleNamespace:
        return SimpleNamespace(term=SimpleNamespace(effect=name, free_parameters=("size",)))

    fitted = tuple(SimpleNamespace(candidate=candidate(name), evidence_gap=gap) for name, gap in rivals)
    before, after = SimpleNamespace(neg2_log_evidence=gain), SimpleNamespace(neg2_log_evidence=0.0)
    return SimpleNamespace(candidate=candidate(effect), rivals=fitted, before=before, after=after)


def test_probabilities_follow_the_evidence_of_law_rival_and_no_effect() -> None:
    found = find_probabilities(step("second-mode", ("drive-lag", 2.0), gain=4.0), 0.0)
    evidence = [1.0, 0.36788, 0.13534]  # exp of -0, -1 and -2
    assert found == {
        "second-mode": pytest.approx(evidence[0] / sum(evidence), rel=1e-4),
        "drive-lag": pytest.approx(evidence[1] / sum(evidence), rel=1e-4),
    }


def test_a_law_that_explains_a_hundredth_of_what_it_leaves_is_improbable() -> None:
    found = find_probabilities(step("second-mode", ("drive-lag", 2.0), gain=100.0), 9900.0)
    assert found["unknown"] == pytest.approx(0.99)
    assert found["second-mode"] == pytest.approx(0.01 / 1.36788, rel=1e-4)
    assert sum(found.values()) == pytest.approx(1.0)


def test_an_unknown_finding_is_as_probable_as_its_stage_beside_all_others_together(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(finding, "is_discrepancy", lambda candidate: True)
    unknown = step("free-stiffness", ("free-timing", -2.0))
    unknown.rivals[0].candidate.term.stage = "timing"
    (rival,) = finding._in_other_stages(unknown)  # type: ignore[arg-type]
    assert (rival.effect, rival.stage) == ("unknown", "timing")
    assert rival.probability == pytest.approx(0.7311, rel=1e-3)


def test_what_is_certain_without_a_fit_stays_certain_beside_a_remainder() -> None:
    clipped = step("saturation")
    clipped.candidate.term.free_parameters = ()
    assert find_probabilities(clipped, 9900.0) == {"saturation": 1.0}


def found(effect: str, share: float, *rivals: finding.Rival) -> finding.Finding:
    """A finding that is certain but for its rivals."""
    left = 1.0 - sum(rival.probability for rival in rivals)
    return finding.Finding("x", "mechanics", effect, "", (), "", left, rivals, {}, "sense", "", share)


def test_a_further_law_of_a_small_share_may_be_an_imperfection() -> None:
    findings = [
        found("sensor-cubic", 0.024, finding.Rival("profile-shape", 0.2), finding.Rival("unknown", 0.1)),
        found("cubic-stiffness", 0.8),
    ]
    largest, small = beside_imperfections(findings, [True, True])
    assert (largest.probability, largest.rivals) == (1.0, ())
    assert small.probability == pytest.approx(0.9 * 0.7, rel=1e-2)
    rivals = {rival.effect: rival.probability for rival in small.rivals}
    assert rivals == {"unknown": pytest.approx(0.19, rel=2e-2), "profile-shape": pytest.approx(0.18, rel=1e-2)}
    assert small.probability + sum(rivals.values()) == pytest.approx(1.0)


def test_a_further_law_without_a_share_is_improbable_and_what_samples_show_is_certain() -> None:
    findings = [found("cubic-stiffness", 0.9), found("gain-drift", 0.0), found("saturation", 0.0)]
    _, drift, clipped = beside_imperfections(findings, [True, True, False])
    assert drift.probability == pytest.approx(1.0 - drift.rivals[0].probability) == pytest.approx(0.25, rel=1e-2)
    assert clipped.probability == 1.0


def test_a_rival_on_both_axes_gets_its_advice_once() -> None:
    terms = catalogue()
    rivals = [
        SimpleNamespace(candidate=Candidate(terms["carrier-torque"], axis, "sense"), evidence_gap=0.0) for axis in "xy"
    ]
    drift = SimpleNamespace(candidate=Candidate(terms["resonance-drift"], "x", "sense"), rivals=rivals)
    text = _advice(SimpleNamespace(), drift, {})  # type: ignore[arg-type]
    assert text is not None
    assert text.count("carrier-torque") == 1


def test_the_nearest_rival_gets_no_general_advice_for_another_channel(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(finding, "discrimination_advice", lambda *arguments: "use a larger drive")
    terms = catalogue()
    delays = [Candidate(terms["channel-delay"], "x", channel) for channel in ("sense", "angle")]
    rivals = [SimpleNamespace(candidate=delay, evidence_gap=0.0) for delay in delays]
    lag = SimpleNamespace(candidate=Candidate(terms["readout-lag"], "x", "sense"), rivals=rivals)
    result = SimpleNamespace(likelihood=None, final=None)
    assert _advice(result, lag, {delays[0].key: 0.1}) == "use a larger drive"  # type: ignore[arg-type]


def test_the_interval_contains_the_value_of_the_improved_device(monkeypatch: pytest.MonkeyPatch) -> None:
    delay = Candidate(catalogue()["readout-lag"], "x", "sense")
    model = SimpleNamespace(
        scales=lambda axis: SimpleNamespace(rate=100.0), values=lambda candidate, x: (7.0,), index=lambda *key: 0
    )
    monkeypatch.setattr(finding, "profile_interval", lambda likelihood, fit, i: (2.0, 3.0))
    monkeypatch.setattr(finding, "determined_parameters", lambda fit: None)
    (estimate,) = parameter_estimates(SimpleNamespace(runs=()), SimpleNamespace(model=model), delay, None)  # type: ignore[arg-type]
    assert estimate.ci95[0] <= estimate.value <= estimate.ci95[1]


@pytest.mark.parametrize("axis", ["x", "y"])
def test_a_misfit_is_located_around_multiples_of_the_frequency_of_its_own_axis(axis: str) -> None:
    recording, _ = shared_electrode()
    assert recording.device is not None
    run = prepare_run(recording, recording.device)
    likelihood = Likelihood([run], flat_whiteners(Model([run], recording.device, mains=())))
    ((whiten,),), output = likelihood.whiteners, run.outputs[0]
    tone = 5e-2 * np.cos(2 * run.scales[axis].rate * output.step * np.arange(output.data.size))
    before, after = (SimpleNamespace(residual=whiten(size * tone), penalty=0.0) for size in (1.0, 0.0))
    candidate = Candidate(catalogue()["cubic-stiffness"], axis, "sense")
    assert describe_localisation(likelihood, candidate, cast(Any, before), cast(Any, after)).endswith("around 2f 100%")
