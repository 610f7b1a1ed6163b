"""Effects that stand in no catalogue: unknown, in the stage where they act, with the law that was measured."""

from __future__ import annotations

import numpy as np
from test_mismatch import DEVICE, F0, RATE, N, recording

from estimation.mismatch.diagnosis import diagnose
from estimation.mismatch.experiment import experiment
from estimation.mismatch.fit import Comparison, Fit, solve
from estimation.mismatch.free import FREE
from estimation.mismatch.model import Candidate, Model
from estimation.mismatch.search import _State, _unnamed
from estimation.mismatch.start import first_whiteners, grown, started, windows
from scanner.recording import Recording
from scanner.terms import catalogue


def test_a_stiffness_shaken_from_outside_is_unknown_in_the_mechanics() -> None:
    """No term of the catalogue does that; a wandering clock of the sense channel comes close."""
    told = diagnose([recording(shaken=0.01, seed=6)])
    assert [(each.effect, each.stage) for each in told.findings] == [("unknown", "mechanics")]
    scatter = np.sqrt(2.0 / told.search.final.held.sum())
    assert told.search.final.held_chi2 < 1.0 + 3.0 * scatter < 2.0 < told.search.nominal.held_chi2
    curve = told.findings[0].curve
    assert curve is not None
    assert (curve["x"], curve["y"]) == ("time (s)", "stiffness error / k")
    assert "= 0.01 x cos(12 π t/T) with" in curve["formula"]
    time, value, sd = np.array(curve["points"]).T
    assert np.all(np.abs(value - 0.01 * np.cos(2 * np.pi * 6 * time * RATE / N)) < 4.0 * sd + 1e-4)


def test_a_delay_that_grows_with_the_swing_is_unknown_in_the_timing() -> None:
    """No term of the catalogue does that: of all laws of the mechanics together, three came close."""
    told = diagnose([recording(late=2e-6, seed=6)])
    assert [(each.effect, each.stage) for each in told.findings] == [("unknown", "timing")]
    curve = told.findings[0].curve
    assert curve is not None
    assert (curve["x"], curve["y"]) == ("swing (rad)", "delay")
    swing, delay, sd = np.array(curve["points"]).T
    assert (np.abs(delay - 2e-6 * (swing / 1e-3) ** 2) < 4.0 * sd + 1e-9).all()
    assert sd[-1] < 0.1 * delay[-1]


def test_a_delay_that_remembers_the_swing_is_unknown_in_the_timing() -> None:
    """A delay of the swing as it is left enough for a force over the motion's state to do better."""
    told = diagnose([recording(late=1e-5, memory=4 / F0, seed=6)])
    assert [(each.effect, each.stage) for each in told.findings] == [("unknown", "timing")]
    scatter = np.sqrt(2.0 / told.search.final.held.sum())
    assert told.search.final.held_chi2 < 1.0 + 3.0 * scatter < 2.0 < told.search.nominal.held_chi2
    curve = told.findings[0].curve
    assert curve is not None
    assert "M_4" in curve["formula"].split(" with ")[0]


def test_a_play_in_the_readout_is_unknown_in_the_readout() -> None:
    """Its lag depends on the swing and not on time or rate: a force over the motion's state came closest."""
    told = diagnose([recording(play=3e-4, seed=6)])
    assert [(each.effect, each.stage) for each in told.findings] == [("unknown", "readout")]
    curve = told.findings[0].curve
    assert curve is not None
    assert (curve["x"], curve["y"]) == ("phase of the swing (rad)", "signal error / rms")
    assert "P_0" in curve["formula"]


def searched(run: Recording, *names: str, turns: int = 8) -> tuple[_State, Fit]:
    """A search that stands at named terms, and what it finds to put in their place."""
    seen = experiment(run, DEVICE)
    nominal = Model([seen], DEVICE)
    comparison = Comparison([seen], first_whiteners(nominal))
    stops = windows(nominal)
    early = grown(comparison, nominal, started(comparison, nominal, stops[0]).x, stops)[-1]
    model = Model([seen], DEVICE, [Candidate(catalogue()[name], "x", "sense") for name in names], nominal.mains)
    named = solve(comparison, model, model.embed(early.model, early.x), turns=turns)
    return _unnamed(_State(comparison, early, named, {})), named


def test_three_laws_of_one_stage_give_way_to_the_one_that_they_begin() -> None:
    """A stop on one side is no power of the angle: three powers together imitate it, one free force is it."""
    powers = [f"{name}-stiffness" for name in ("quadratic", "cubic", "quintic")]
    told, named = searched(recording(stop=0.2, seed=6), *powers, turns=20)
    assert [each.term.effect for each in told.best.model.candidates] == ["free-mechanics"]
    assert [lead.candidate.term.effect for lead in told.rivals["x.free-mechanics"]] == powers
    assert told.best.held_chi2 < named.held_chi2


def test_two_names_for_one_law_of_the_timing_give_way_to_the_numbers_that_it_needs() -> None:
    told, named = searched(recording(late=2e-6, seed=6), "channel-delay", "clock-skew")
    (candidate,) = told.best.model.candidates
    assert candidate.term.effect == "free-timing"
    assert "r2" in {each.name for each in candidate.term.free}
    assert len(candidate.term.free) < 5 < len(FREE["free-timing"].free)
    assert told.best.held_chi2 < named.held_chi2
