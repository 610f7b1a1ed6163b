"""Shares, remainders, open-loop comparison, rails, and nominal values that a recording does not determine."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from estimation.candidate_terms.screening import ScoreTest
from estimation.device_fit.data import prepare_run
from estimation.device_fit.fit import Likelihood, fit_model, linearise_at
from estimation.device_fit.initial import flat_whiteners
from estimation.device_fit.model import Model
from estimation.device_fit.open_loop import OpenLoop, has_larger_error, is_worse, open_loop
from estimation.device_fit.parameters import Candidate
from estimation.diagnosis import shares
from estimation.diagnosis.clipping import clipped_readouts, find_rail
from estimation.diagnosis.diagnose import build_diagnosis
from estimation.diagnosis.identifiability import determined_parameters
from estimation.diagnosis.selection import SelectionResult, SelectionStep
from estimation.diagnosis.shares import (
    describe_unexplained,
    explained_share,
    find_remainder,
    remaining_share,
    share_of_finding,
)
from scanner.device import Axis, Device
from scanner.errors import BadInput
from scanner.recording import Recording
from scanner.stages import Mechanics, Position
from scanner.terms import catalogue
from tests.support.bench import DEVICE, bench_recording
from tests.support.simulated import separate_electrodes


def test_shares_and_the_remainder_of_one_finding_add_up() -> None:
    assert explained_share(without=5.0, complete=1.2, nominal=5.0, noise=1.0) == pytest.approx(0.95)
    assert remaining_share(complete=1.2, nominal=5.0, noise=1.0) == pytest.approx(0.05)
    assert explained_share(without=1.0, complete=1.2, nominal=5.0, noise=1.0) == 0.0
    assert explained_share(without=90.0, complete=1.2, nominal=5.0, noise=1.0) == pytest.approx(0.95)


def test_the_share_is_that_of_the_channel_that_shows_the_effect(monkeypatch: pytest.MonkeyPatch) -> None:
    """A law of the mechanics moves both channels, but the steps of popcorn noise hide it in the sense signal."""
    without, complete, nominal = object(), object(), SimpleNamespace(model=SimpleNamespace(candidates=()))
    misfits = {
        id(without): {"sense_x": 7.9, "angle_x": 4.6},
        id(complete): {"sense_x": 8.0, "angle_x": 1.0},
        id(nominal): {"sense_x": 8.1, "angle_x": 5.0},
    }
    monkeypatch.setattr(shares, "misfit_by_channel", lambda fit: misfits[id(fit)])
    monkeypatch.setattr(shares, "noise_by_channel", lambda likelihood: {"sense_x": 8.0, "angle_x": 1.0})
    reduction = {"sense_x": 20.0, "angle_x": 900.0}
    monkeypatch.setattr(shares, "chi2_reduction_by_channel", lambda likelihood, before, after: reduction)
    result = SimpleNamespace(final=complete, nominal=nominal, likelihood=None)
    step = SimpleNamespace(before=without, candidate="law")
    share = share_of_finding(cast(SelectionResult, result), cast(SelectionStep, step))
    assert share == pytest.approx(0.9)


@pytest.mark.parametrize(("noise_sd", "said"), [(None, None), (0.02, None), (1e-3, "150 times the stated noise")])
def test_a_visible_residual_is_no_noise_where_much_less_noise_is_stated(
    monkeypatch: pytest.MonkeyPatch, noise_sd: float | None, said: str | None
) -> None:
    """Under a broad drive the residual of a wrong law resembles noise, and the noise is measured from it."""
    data = np.sqrt(2.0) * np.sin(0.1 * np.arange(6283))
    run = SimpleNamespace(outputs=[SimpleNamespace(name="sense_x", data=data, noise_sd=noise_sd)])
    monkeypatch.setattr(shares, "residual_is_noise", lambda fit: True)
    monkeypatch.setattr(shares, "misfit_by_channel", lambda fit: {"sense_x": 0.15**2})
    monkeypatch.setattr(shares, "noise_by_channel", lambda likelihood: {"sense_x": 0.2**2})
    result = SimpleNamespace(final=SimpleNamespace(validation_chi2=0.9), likelihood=SimpleNamespace(runs=[run]))
    text = describe_unexplained(cast(SelectionResult, result))
    assert text == (said and f"15% of sense_x (rms) counts as noise, {said}")


@pytest.mark.parametrize(("remaining", "stated"), [(-5.0, False), (9.0, False), (800.0, True)])
def test_what_a_correction_beside_named_laws_still_takes_is_stated(
    monkeypatch: pytest.MonkeyPatch, remaining: float, stated: bool
) -> None:
    """The residual is near the noise: the share is that of the whitened misfit, and the angle fits within its noise."""
    complete = SimpleNamespace(validation_chi2=1.1, chi2=1000.0, penalty=3.0)
    model = SimpleNamespace(candidates=())
    nominal = SimpleNamespace(validation_chi2=50.0, chi2=50000.0, penalty=3.0, model=model)
    steps = (SimpleNamespace(candidate="a law"),)
    misfits = {id(complete): {"sense_x": 1.2, "angle_x": 1.01}, id(nominal): {"sense_x": 41.0, "angle_x": 1.02}}
    monkeypatch.setattr(shares, "misfit_by_channel", lambda fit: misfits[id(fit)])
    monkeypatch.setattr(shares, "noise_by_channel", lambda likelihood: {"sense_x": 1.0, "angle_x": 1.0})
    result = SimpleNamespace(final=complete, nominal=nominal, likelihood=None, remaining=remaining, steps=steps)
    correction = SimpleNamespace(predicted_gain=1000.0, candidate=SimpleNamespace(term=SimpleNamespace(stage="drive")))
    remainder = find_remainder(cast(SelectionResult, result), cast(ScoreTest, correction))
    expected = {"share": pytest.approx(0.02), "stage": "drive", "channel": "sense_x", "in_device": False}
    assert remainder == (expected if stated else None)


@pytest.mark.parametrize(
    ("beside", "share", "remainder"), [(None, 0.75, 0.25), ("cubic-stiffness", 0.125, 0.5), ("free-readout", 0.5, 0.5)]
)
def test_the_share_of_a_rail_is_of_the_nominal_fit_without_it(
    monkeypatch: pytest.MonkeyPatch, beside: str | None, share: float, remainder: float
) -> None:
    """Without the rail, a law beside it leaves a misfit of 4 and the nominal device alone of 9.

    A free curve of the readout takes the place of the rail; its share is that without the curve.
    """

    def fit(mean_square: float, *effects: str) -> Any:
        candidates = tuple(SimpleNamespace(term=SimpleNamespace(effect=effect), key=effect) for effect in effects)
        return SimpleNamespace(mean_square=mean_square, model=SimpleNamespace(candidates=candidates))

    others = () if beside is None else (beside,)
    complete, nominal = fit(3.0, "saturation", *others), fit(3.0 if beside is None else 5.0, "saturation")
    without, without_rails = fit(9.0 if beside is None else 4.0, *others), fit(9.0)
    (rail,), law = nominal.model.candidates, complete.model.candidates[-1]
    complete.model.candidates = (rail, law)[: 1 + len(others)]
    monkeypatch.setattr(shares, "misfit_by_channel", lambda each: {"sense_x": each.mean_square})
    monkeypatch.setattr(shares, "noise_by_channel", lambda likelihood: {"sense_x": 1.0})
    monkeypatch.setattr(shares, "chi2_reduction_by_channel", lambda likelihood, before, after: {"sense_x": 5.0})
    monkeypatch.setattr(shares, "is_discrepancy", lambda candidate: candidate.key.startswith("free"))
    monkeypatch.setattr(
        shares, "refit_without", lambda likelihood, each, out: without_rails if out is rail else nominal
    )
    step = SimpleNamespace(before=without, candidate=rail)
    steps = (step, SimpleNamespace(before=nominal, candidate=law))[: 1 + len(others)]
    complete.validation_chi2 = 9.0
    result = SimpleNamespace(
        final=complete, nominal=nominal, without_rails=without_rails, likelihood=None, steps=steps, remaining=0.0
    )
    assert share_of_finding(cast(SelectionResult, result), cast(SelectionStep, step)) == pytest.approx(share)
    found = find_remainder(cast(SelectionResult, result), None)
    assert found is not None
    assert found["share"] == pytest.approx(remainder)


def test_shares_beside_further_modes_are_of_the_misfit_of_the_device_without_them() -> None:
    run = prepare_run(bench_recording(k3=3e-4), DEVICE)
    candidate = Candidate(catalogue()["cubic-stiffness"], "x", "sense")
    model = Model([run], DEVICE, [candidate], mains=())
    likelihood = Likelihood([run], flat_whiteners(model))
    nominal = fit_model(likelihood, model.with_candidates([]), np.zeros(len(model.parameters) - 1), max_iterations=6)
    final = fit_model(likelihood, model, model.map_parameters_from(nominal.model, nominal.x))
    result = SelectionResult(likelihood, nominal, final, (SelectionStep(candidate, nominal, final, ()),))
    (alone,), (beside,) = build_diagnosis(result).findings, build_diagnosis(result, {"sense_x": 0.25}).findings
    assert alone.share == pytest.approx(1.0, abs=0.1)
    assert beside.share == pytest.approx(0.25 * alone.share)


def _one_channel(*squares: float) -> dict[str, OpenLoop]:
    return {"sense_x": OpenLoop(np.array(squares), 10.0)}


def test_a_device_is_worse_only_beyond_the_uncertainty_of_the_comparison() -> None:
    nominal = _one_channel(1.0, 1.2, 0.8, 1.0)
    assert not is_worse(nominal, _one_channel(1.0, 0.7, 1.9, 1.1))
    assert is_worse(nominal, _one_channel(1.9, 1.7, 2.1, 2.0))


def test_blocks_that_both_devices_predict_badly_do_not_hide_a_difference_in_all_blocks() -> None:
    nominal = _one_channel(0.1, 9.0, 0.2, 1.0)
    assert is_worse(nominal, _one_channel(0.3, 11.0, 0.5, 2.0))
    assert not is_worse(nominal, _one_channel(0.1, 30.0, 0.1, 1.0))


def test_a_channel_with_a_negligible_error_does_not_make_a_device_worse() -> None:
    nominal = {**_one_channel(1.0, 1.2, 0.8, 1.0), "angle_x": OpenLoop(np.full(4, 1e-6), 10.0)}
    better = {**_one_channel(0.1, 0.1, 0.1, 0.1), "angle_x": OpenLoop(np.full(4, 1e-5), 10.0)}
    assert not is_worse(nominal, better)
    assert is_worse(better, nominal)


@pytest.mark.parametrize(("error", "larger"), [(0.9, False), (1.005, False), (1.2, True)])
def test_a_larger_error_counts_whatever_its_uncertainty(error: float, larger: bool) -> None:
    assert has_larger_error(_one_channel(0.5, 1.5), _one_channel(2.0 * error**2, 0.0)) is larger


def test_a_rail_is_detected_from_samples_at_one_value() -> None:
    rng = np.random.default_rng(3)
    wave = np.sin(np.linspace(0.0, 60.0, 4000)) + 0.01 * rng.normal(size=4000)
    for level in (0.8, -0.2):
        upper = find_rail(np.clip(wave, None, level))
        assert upper is not None
        assert upper[:2] == (pytest.approx(level), "sense:upper")
    lower = find_rail(np.clip(wave, -0.6, None))
    assert lower is not None
    assert lower[:2] == (pytest.approx(0.6), "sense:lower")
    both = find_rail(np.clip(wave, -0.7, 0.7))
    assert both is not None
    assert both[:2] == (pytest.approx(0.7), "sense")
    unreached = find_rail(np.clip(wave + 0.5, None, 1.2))
    assert unreached is not None
    assert unreached[:2] == (pytest.approx(1.2), "sense")
    assert find_rail(wave) is None
    assert find_rail(np.round(wave * 64) / 64) is None  # a converter's steps are no rail


@pytest.mark.parametrize("others_level", [0.8, np.inf])
@pytest.mark.parametrize("order", [1, -1])
def test_recordings_of_different_ranges_are_not_diagnosed_together(others_level: float, order: int) -> None:
    """The limit of one would be that of both."""
    size = float(np.abs(bench_recording().channels["sense_x"].read()).max())
    runs = [prepare_run(bench_recording(clip_level=level * size), DEVICE) for level in (0.5, others_level)[::order]]
    with pytest.raises(BadInput, match=r"sense_x: is clipped at .* V in bench <b>, which bench <b> exceeds"):
        clipped_readouts(runs, catalogue()["saturation"])


def test_recordings_of_one_range_have_its_limit() -> None:
    """An upper limit that the first recording does not reach is not the lower one where the second lies beyond it."""
    run, saturation = prepare_run(bench_recording(), DEVICE), catalogue()["saturation"]
    signals = [np.maximum(run.outputs[0].full + offset, -0.07) for offset in (-0.02, 0.02)]
    runs = [replace(run, outputs=(replace(run.outputs[0], full=signal),)) for signal in signals]
    assert [candidate.channel for candidate in clipped_readouts(runs[:1], saturation)] == ["sense"]
    assert [candidate.channel for candidate in clipped_readouts(runs, saturation)] == ["sense:lower"]


def test_gain_and_torque_stay_nominal_where_only_their_product_shows() -> None:
    run = prepare_run(bench_recording(seed=2), DEVICE)
    model = Model([run], DEVICE)
    likelihood = Likelihood([run], flat_whiteners(model))
    fit = fit_model(likelihood, model, np.zeros(len(model.parameters)), max_iterations=6)
    at = [i for i, f in enumerate(model.parameters) if f.kind == "nominal"]
    names = [model.parameters[i].name for i in at]
    variance, directions = np.linalg.eigh(fit.covariance[np.ix_(at, at)])
    valley = directions[:, -1]
    assert variance[-1] > 0.9
    assert abs(valley[names.index("readout.gain")]) > 0.3
    moved = fit.x.copy()
    moved[at] += 2.0 * valley
    settled = determined_parameters(replace(fit, x=moved))
    assert determined_parameters(fit)[at] == pytest.approx(settled[at], abs=1e-3)
    assert valley @ settled[at] == pytest.approx(0.0, abs=1e-9)
    changed = likelihood.residual(model, determined_parameters(fit)) - fit.residual
    assert np.sum(changed[likelihood.rows] ** 2) < 1.0


def test_nominal_values_that_absorbed_a_misfit_stay_as_stated() -> None:
    """Two axes drift, which no term describes, and all values lie two tolerances from the stated ones."""
    recording, _ = separate_electrodes()
    run = prepare_run(recording, recording.device)
    model = Model([run], recording.device)
    nominal = np.array([f.kind == "nominal" for f in model.parameters])
    fit = linearise_at(Likelihood([run], flat_whiteners(model)), model, np.where(nominal, 2.0, 0.0))
    assert fit.validation_chi2 > 2.0
    assert not determined_parameters(fit)[nominal].any()
    explained = replace(fit, residual=fit.residual / np.sqrt(fit.validation_chi2))
    assert determined_parameters(explained)[nominal].any()


@pytest.mark.slow
def test_a_law_without_a_name_is_written_and_predicts(measured_data: Path) -> None:
    """A pendulum let go at 45 degrees: whatever its law is called, the device that has it predicts its swing."""
    from benchmarks.measured import ROWS
    from estimation.candidate_terms.discrepancy import DISCREPANCY_TERMS
    from estimation.device_fit.fit import Fit
    from estimation.device_fit.initial import estimate_whiteners, fit_progressively, window_schedule
    from estimation.diagnosis.improvement import improve

    (recording,), _, device = ROWS["pendulum-45"](measured_data)
    run = prepare_run(recording, device)

    def fitted(model: Model) -> Fit:
        likelihood, stops = Likelihood([run], flat_whiteners(model)), window_schedule(model)
        first = fit_progressively(likelihood, model, stops)[-1]
        return fit_model(likelihood, model, first.x, max_iterations=20)

    nominal = fitted(Model([run], device))
    free = Model([run], device, [Candidate(DISCREPANCY_TERMS["free-mechanics"], "x", "sense")])
    likelihood = Likelihood([run], estimate_whiteners(free, fitted(free).x))
    found = fit_model(likelihood, free, fitted(free).x, max_iterations=20)
    nominal = fit_model(likelihood, nominal.model, nominal.x)
    improved = improve(
        SelectionResult(likelihood, nominal, found, (SelectionStep(free.candidates[0], nominal, found, ()),))
    )
    assert "measured-law" in improved.device.axis("x").terms
    assert Device.from_toml(improved.device.to_toml()) == improved.device
    before, after = (open_loop([run], d)["sense_x"].error for d in (device, improved.device))
    assert after < 0.3 * before


def test_a_device_whose_prediction_diverges_is_worse(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its finite values are so large that their squares are not."""
    rate = 2e4
    axis = Axis(Mechanics(1.0, 2.0, (2 * np.pi * 1e3) ** 2), readout=Position(1.0, 1e-3), name="x")
    decay = np.cos(2 * np.pi * 1e3 * np.arange(5000) / rate)
    device = Device("beam", {"x": axis})
    run = prepare_run(Recording.from_arrays({"sense_x": (decay, "V", rate, 0.0)}, device), device)
    before = open_loop([run], device)
    growing = SimpleNamespace(outputs=lambda x: [[np.geomspace(1.0, 1e200, decay.size)]])
    monkeypatch.setattr("estimation.device_fit.open_loop.fit_start_only", lambda runs, device: (growing, np.zeros(0)))
    after = open_loop([run], device)
    assert np.isfinite(after["sense_x"].error)
    assert is_worse(before, after)


@pytest.mark.parametrize(
    ("rate", "samples", "what"),
    [(100.0, 5000, "sampled at 100 Hz, too slowly for a resonance at 1000 Hz"), (2e4, 100, "fewer than 8 periods")],
)
def test_a_recording_that_cannot_serve_is_refused(rate: float, samples: int, what: str) -> None:
    axis = Axis(Mechanics(1.0, 2.0, (2 * np.pi * 1e3) ** 2), readout=Position(1.0, 1e-3), name="x")
    decay = np.cos(2 * np.pi * 1e3 * np.arange(samples) / rate) + 1e-3 * np.random.default_rng(1).normal(size=samples)
    recording = Recording.from_arrays({"sense_x": (decay, "V", rate, 0.0)}, Device("beam", {"x": axis}))
    with pytest.raises(BadInput, match=what):
        prepare_run(recording, Device("beam", {"x": axis}))


@pytest.mark.parametrize(
    ("ratio", "text"),
    [(1.96, "the residual of sense_x is 2 times the signal"), (0.19, "19% of sense_x is not explained")],
)
def test_an_unexplained_part_is_never_more_than_all_of_a_channel(ratio: float, text: str) -> None:
    assert shares._describe_residual("sense_x", ratio) == text
