"""Named laws beside a discrepancy: which are selected, and what they take of a misfit."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from estimation.candidate_terms.discrepancy import DISCREPANCY_TERMS
from estimation.candidate_terms.linear_model import MAX_SCALE_BESIDE, MIN_SCALE, Hypothesis, LinearModel, LinearTerm
from estimation.candidate_terms.screening import all_candidates
from estimation.device_fit.data import prepare_run
from estimation.device_fit.fit import Fit, Likelihood, fit_model
from estimation.device_fit.initial import fit_progressively, flat_whiteners, window_schedule
from estimation.device_fit.model import Model
from estimation.device_fit.parameters import Candidate
from estimation.diagnosis import law_selection
from estimation.diagnosis.diagnose import diagnose
from estimation.diagnosis.law_selection import choose_laws
from scanner.device import Axis, Device
from scanner.recording import Recording
from scanner.stages import Mechanics
from scanner.terms import catalogue
from tests.support.bench import DEVICE, STIFFNESS, bench_recording, bench_signals
from tests.support.null_gain import null_gain

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
        misfit = misfit - weight * columns[LAWS.index(name)][:, 0]
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
    return {model.laws[i].candidate.term.effect for i in model.select().laws}


@pytest.mark.parametrize("discrepancy", [0.0, 0.02, 0.05])
def test_a_law_is_selected_beside_a_small_discrepancy(discrepancy: float) -> None:
    model = linear_model({"cubic-damping": 1.0}, discrepancy)
    assert selected(model) == {"cubic-damping"}
    hypothesis = model.select()
    assert all(rival.evidence_gap > 0.0 for rival in model.rivals(hypothesis, hypothesis.laws[0]))


def test_two_laws_are_selected_together() -> None:
    model = linear_model({"cubic-damping": 1.0, "sensor-cubic": 0.8}, 0.02)
    assert selected(model) == {"cubic-damping", "sensor-cubic"}


def test_a_misfit_without_a_law_leaves_the_discrepancy_alone() -> None:
    assert selected(linear_model({}, 0.3)) == set()
    assert selected(linear_model({}, 0.0)) == set()


def test_a_free_correction_gains_what_no_law_takes() -> None:
    weak, strong = (linear_model({"sensor-cubic": 1.0}, size) for size in (0.02, 0.2))
    law = next(i for i, term in enumerate(strong.laws) if term.candidate.term.effect == "sensor-cubic")
    assert strong.gain_of_discrepancy((law,)) > 50.0 * weak.gain_of_discrepancy((law,)) > 0.0


def test_a_law_that_gains_less_than_the_discrepancy_beside_it_is_not_selected() -> None:
    """A cubic damping of a tenth gains less than a free readout that no law describes."""
    model = linear_model({"sensor-cubic": 3.0, "cubic-damping": 0.02}, 0.2)
    assert selected(model) == {"sensor-cubic"}
    assert selected(linear_model({"sensor-cubic": 3.0, "cubic-damping": 1.0}, 0.02)) == {
        "sensor-cubic", "cubic-damping",
    }  # fmt: skip


def test_a_kept_law_is_not_removed() -> None:
    model = linear_model({"sensor-cubic": 3.0, "cubic-damping": 0.02}, 0.2)
    small = next(i for i, law in enumerate(model.laws) if law.candidate.term.effect == "cubic-damping")
    assert set(model.select((small,), kept=(small,)).laws) == {small, *model.select().laws}
    assert small not in model.select((small,)).laws


def test_noise_alone_exceeds_the_null_quantile_as_rarely_as_stated() -> None:
    model = linear_model({}, 0.0)
    limit = null_gain(model, 0.05)
    assert limit < null_gain(model, 0.001)
    rng = np.random.default_rng(8)
    exceeded = 0
    for _ in range(400):
        factor = model.factor.copy()
        factor[:, -1] = rng.normal(size=factor.shape[0])
        noisy = LinearModel(factor, model.profile, model.laws, model.discrepancies)
        without = range(len(model.discrepancies))
        nothing = noisy.hypothesis((), without=without).neg2_log_evidence
        gains = [nothing - noisy.hypothesis((i,), without=without).neg2_log_evidence for i in range(len(model.laws))]
        exceeded += max(gains) > limit
    assert 8 <= exceeded <= 34  # 20 expected, 3.2 standard deviations


def test_rounding_does_not_decide_between_laws_of_nearly_the_same_effect() -> None:
    rng = np.random.default_rng(4)
    common, difference = rng.normal(size=(2, SAMPLES))
    columns = [1e8 * common, 1e8 * common + difference, rng.normal(size=SAMPLES), rng.normal(size=SAMPLES)]
    terms = [*(catalogue()[name] for name in LAWS), DISCREPANCY_TERMS["free-readout"]]
    linear = tuple(LinearTerm(Candidate(term, "x", "sense"), np.array([i]), None) for i, term in enumerate(terms))
    factor = np.linalg.qr(np.column_stack([*columns, -3.0 * columns[1]]), mode="r")
    model = LinearModel(factor, np.zeros((0, 5)), linear[:3], linear[3:])
    exact, near = (model.hypothesis((law,)).misfit for law in (1, 0))
    assert exact == pytest.approx(9.0, abs=0.1)  # of the prior
    assert near - exact == pytest.approx(9.0 * SAMPLES, rel=0.2)
    assert selected(model) == {"cubic-damping"}


def test_a_law_with_inexact_sensitivities_is_compared_where_the_discrepancy_has_vanished() -> None:
    effects = ("quadratic-drag", "cubic-stiffness", "cubic-damping", "drive-droop", "drive-lag", "charging")
    size = 200.0
    columns = size * np.eye(8, 6)
    columns[6, 1:] = size  # five laws explain the error of the sensitivity of the first one, along the correction
    correction, misfit = 25.0 * size * np.eye(8)[:, 6], -0.1 * columns[:, 0]
    misfit[6] = -0.2 * size
    terms = [catalogue()[name] for name in effects] + [DISCREPANCY_TERMS["free-mechanics"]]
    linear = tuple(LinearTerm(Candidate(term, "x", "sense"), np.array([i]), None) for i, term in enumerate(terms))
    factor = np.linalg.qr(np.column_stack([columns, correction, misfit]), mode="r")
    model = LinearModel(factor, np.zeros((0, 8)), linear[:6], linear[6:])
    compared = {hypothesis.laws for hypothesis in model.beside((), np.array([MIN_SCALE**2]))}
    assert (0,) in compared


@pytest.mark.parametrize("takes_bulk", [True, False])
@pytest.mark.parametrize(
    ("discrepancy", "rival_chi2", "exchanged"), [(0.0, 600.0, False), (0.05, 600.0, True), (0.05, 1300.0, False)]
)
def test_beside_a_fit_that_leaves_only_noise_corrections_improve_no_rival(
    discrepancy: float, rival_chi2: float, exchanged: bool, takes_bulk: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The rival is worse than the present law without corrections, and better with them.

    One that leaves more than twice as much by itself is not compared. Confounders that terms state are compared too
    where the laws leave only noise or take the bulk of the misfit.
    """
    linear = linear_model({"cubic-damping": 1.0}, discrepancy)
    beside = linear.hypothesis((1,), max_scale=MAX_SCALE_BESIDE).neg2_log_evidence
    alone = linear.without_discrepancy((1,)).neg2_log_evidence
    present, rival = SimpleNamespace(chi2=600.0), SimpleNamespace(chi2=rival_chi2)

    def around_rival(likelihood: Likelihood, fit: Fit, corrections: list[Candidate]) -> SimpleNamespace:
        score = beside - 50.0 if corrections else alone + 50.0
        return SimpleNamespace(laws=(), hypothesis=lambda laws, max_scale: SimpleNamespace(neg2_log_evidence=score))

    monkeypatch.setattr(LinearModel, "beside", lambda self, laws, scales: [Hypothesis((0,), scales, beside, 0.0)])
    monkeypatch.setattr(law_selection, "fit_terms", lambda *arguments: rival)
    monkeypatch.setattr(law_selection, "satisfies_sign_constraints", lambda fit: True)
    monkeypatch.setattr(law_selection, "linear_model", around_rival)
    monkeypatch.setattr(law_selection._Centre, "takes_bulk", lambda self, nominal: takes_bulk)
    asked = list[bool]()
    monkeypatch.setattr(law_selection, "stated_confounders", lambda *arguments: asked.append(True) or {})
    terms = [term.candidate for term in linear.discrepancies]
    likelihood = SimpleNamespace(steps=0)
    centre = law_selection._Centre(likelihood, present, linear, (1,))  # type: ignore[arg-type]
    best, _ = law_selection._exchange_near_rival(centre, terms, {}, SimpleNamespace())  # type: ignore[arg-type]
    assert (best is rival) is exchanged
    assert bool(asked) is (takes_bulk or centre.leaves_noise)


@pytest.mark.slow
def test_a_law_without_which_the_fit_is_worse_is_kept_although_the_linear_model_removes_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The selection starts from a gain that drifts, adds the spring, and removes the drift beside it."""
    select, with_spring = LinearModel.select, list[bool]()

    def without_drift_beside_spring(
        linear: LinearModel, laws: tuple[int, ...] = (), max_moves: float = np.inf, kept: tuple[int, ...] = ()
    ) -> Hypothesis:
        effects = [law.candidate.term.effect for law in linear.laws]
        with_spring.append(linear.laws[effects.index("cubic-stiffness")].test is None)
        removed = {i for i, effect in enumerate(effects) if effect == "gain-drift" and any(with_spring)} - set(kept)
        best = select(linear, laws, max_moves, kept)
        return linear.hypothesis(tuple(i for i in best.laws if i not in removed))

    size = np.abs(bench_signals(0.0, 0.0)[1]).max()
    run = prepare_run(bench_recording(k3=0.06 * STIFFNESS / size**2, gain_drift=0.15, seed=4), DEVICE)
    nominal = Model([run], DEVICE)
    likelihood, stops = Likelihood([run], flat_whiteners(nominal)), window_schedule(nominal)
    early = fit_progressively(likelihood, nominal, stops)[-1]
    laws = ("cubic-stiffness", "gain-drift")
    terms = [*(catalogue()[name] for name in laws), *DISCREPANCY_TERMS.values()]
    pool = all_candidates(nominal, terms)
    model = Model([run], DEVICE, [law for law in pool if law.term.effect == "gain-drift"], nominal.mains)
    anchor = fit_model(likelihood, model, model.map_parameters_from(early.model, early.x))
    monkeypatch.setattr(LinearModel, "select", without_drift_beside_spring)
    choice = choose_laws(anchor, early, pool, lambda text: None)
    assert choice is not None
    assert {law.term.effect for law in choice.fit.model.candidates} == set(laws)


@pytest.mark.parametrize(("axes", "alone"), [("xx", {(0,), (1,)}), ("xy", {(1,), (2,)})])
def test_the_best_single_laws_are_fitted_where_the_present_ones_belong_to_two_axes(
    axes: str, alone: set[tuple[int, ...]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A law of one axis leaves the other as it is; laws that the fit does not contain may act on both."""
    effects = [("x", "cubic-stiffness"), (axes[1], "resonance-drift"), ("x", "clock-skew")]
    laws = [
        LinearTerm(Candidate(catalogue()[effect], axis, "sense"), np.array([i]), None)
        for i, (axis, effect) in enumerate(effects)
    ]
    linear = LinearModel(np.eye(4), np.zeros((0, 4)), tuple(laws), ())
    nothing = SimpleNamespace(laws=())
    monkeypatch.setattr(LinearModel, "select", lambda self: nothing)
    monkeypatch.setattr(LinearModel, "strongest_together", lambda self: ())
    monkeypatch.setattr(LinearModel, "strongest", lambda self, number: [(2,), (1,), (0,)][:number])
    fit = SimpleNamespace(model=SimpleNamespace(candidates=()))
    centre = law_selection._Centre(SimpleNamespace(), fit, linear, (0, 1))  # type: ignore[arg-type]
    proposed = law_selection._propose_laws(centre, (), first=True)
    assert set(proposed) - {()} == alone


@pytest.mark.slow
def test_where_the_selection_alternates_between_two_laws_their_near_rivals_are_compared(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Around the spring of third order the linear model prefers that of fifth order, and the reverse."""
    exchange, compared = law_selection._exchange_near_rival, list[bool]()

    def alternate(centre: law_selection._Centre, *arguments: object, **options: object) -> list[tuple[int, ...]]:
        laws = {law.candidate.term.effect: i for i, law in enumerate(centre.linear.laws)}
        cubic_is_present = laws["cubic-stiffness"] in centre.laws
        return [(laws["quintic-stiffness" if cubic_is_present else "cubic-stiffness"],)]

    def record(*arguments: Any) -> Any:
        compared.append(True)
        return exchange(*arguments)

    size = np.abs(bench_signals(0.0, 0.0)[1]).max()
    run = prepare_run(bench_recording(k3=0.06 * STIFFNESS / size**2, seed=4), DEVICE)
    nominal = Model([run], DEVICE)
    likelihood, stops = Likelihood([run], flat_whiteners(nominal)), window_schedule(nominal)
    early = fit_progressively(likelihood, nominal, stops)[-1]
    laws = ("cubic-stiffness", "quintic-stiffness", "cubic-damping")
    pool = all_candidates(nominal, [*(catalogue()[name] for name in laws), *DISCREPANCY_TERMS.values()])
    monkeypatch.setattr(law_selection, "_propose_laws", alternate)
    monkeypatch.setattr(law_selection, "_exchange_near_rival", record)
    choice = choose_laws(early, early, pool, lambda text: None)
    assert compared
    assert choice is not None
    assert [law.term.effect for law in choice.fit.model.candidates] == ["cubic-stiffness"]


@pytest.mark.slow
def test_gravity_and_friction_of_a_large_swing_are_named_with_their_values() -> None:
    """A pendulum let go at 135 degrees, with a linear nominal device: 20 turns, whose frequency doubles."""
    stiffness, damping, friction = (2 * np.pi * 1.7) ** 2, 0.45, 0.4

    def law(t: float, y: np.ndarray) -> list[float]:
        return [y[1], -stiffness * np.sin(y[0]) - damping * y[1] - friction * np.tanh(y[1] / 0.05)]

    time_s = np.arange(0.0, 10.0, 1 / 500)
    swing = solve_ivp(law, (0.0, 10.0), [np.deg2rad(135.0), 0.0], t_eval=time_s, rtol=1e-9, atol=1e-10).y[0]
    step = np.deg2rad(1 / 11)
    axis = Axis(Mechanics(1.0, 0.5, stiffness), name="x", tolerance={"J": 1e-9, "b": 0.5})
    device = Device("pendulum", {"x": axis})
    angle = np.round(swing / step) * step
    diagnosis = diagnose([Recording.from_arrays({"angle_x": (angle, "rad", 500.0)}, device=device)])
    assert [finding.effect for finding in diagnosis.findings] == ["gravity-stiffness", "coulomb-friction"]
    torque = diagnosis.findings[1].parameters[0]
    assert torque.value == pytest.approx(friction, rel=0.1)
