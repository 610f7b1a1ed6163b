"""A parametrically pumped mode grows from the noise: no candidate leads until late in the recording."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.blind.generator import BlindRecording, Case
from estimation.diagnosis.selection import SelectionResult
from scanner.terms import catalogue
from tests.support.blind_recordings import search_blind_recording

CONFOUNDERS = ("damping-drift", "gain-drift", "channel-delay", "clock-skew", "quadratic-drag", "cubic-damping",
              "coulomb-friction", "overtone-coupling")  # fmt: skip


def search_for_mode(family: str, seed: int, folder: Path, before: float) -> tuple[BlindRecording, SelectionResult]:
    """A search that selects mode-coupling alone; held-out chi-square falls from more than ``before`` to 1."""
    case = Case("blind-001", "one", family, ("mode-coupling",), "coloured", seed)
    blind, search = search_blind_recording(case, folder, (*CONFOUNDERS, "mode-coupling"))
    assert [selected.candidate.term.effect for selected in search.steps] == ["mode-coupling"]
    assert search.nominal.validation_chi2 > before
    assert search.final.validation_chi2 == pytest.approx(1.0, abs=0.03)
    return blind, search


@pytest.mark.slow
def test_a_mode_that_grows_late_is_found(tmp_path: Path) -> None:
    blind, search = search_for_mode("tf", 1469536719, tmp_path, 10.0)
    _, frequency, quality, push = search.final.model.values(search.steps[0].candidate, search.final.x)
    true = blind.truth
    assert frequency == pytest.approx(true.mode_frequency / (2 * np.pi), rel=1e-4)
    assert quality == pytest.approx(true.mode_frequency / true.mode_damping, rel=0.01)
    # In the units of the term, in which the energy of the mode is k q²/2.
    pushed = true.mode_coupling / np.sqrt(true.mode_exchange * true.k / true.J)
    assert abs(push) == pytest.approx(pushed, rel=0.1)  # mirrored, the mode makes the same signal


@pytest.mark.slow
def test_a_mode_just_above_its_threshold_is_found(tmp_path: Path) -> None:
    blind, search = search_for_mode("drive", 2747196542, tmp_path, 1.2)
    _, frequency, _, _ = search.final.model.values(search.steps[0].candidate, search.final.x)
    assert frequency == pytest.approx(blind.truth.mode_frequency / (2 * np.pi), rel=1e-3)


@pytest.mark.slow
def test_the_reaction_of_a_mode_is_not_reported_as_another_mode(tmp_path: Path) -> None:
    """The reaction is a thousandth of 6e4 sigma: a model without it leaves a second mode of 60 sigma."""
    case = Case("blind-001", "one", "drive", ("mode-coupling",), "coloured", 1736519047)
    blind, search = search_blind_recording(case, tmp_path, tuple(catalogue()))
    assert [selected.candidate.term.effect for selected in search.steps] == ["mode-coupling"]
    true, fit = blind.truth, search.final
    at = fit.model.index("term", search.steps[0].candidate.key, "s")
    assert at is not None
    pushed = true.mode_coupling / np.sqrt(true.mode_exchange * true.k / true.J)
    size = abs(fit.model.values(search.steps[0].candidate, fit.x)[3])
    assert size == pytest.approx(pushed, rel=4.0 * np.sqrt(fit.covariance[at, at]) / abs(fit.x[at]))


@pytest.mark.slow
def test_an_equal_fit_with_more_parameters_is_a_rival(tmp_path: Path) -> None:
    case = Case("blind-001", "one", "drive", ("second-mode",), "white", 1327034240)
    _, search = search_blind_recording(case, tmp_path, ("drive-lag", "second-mode", "viscoelastic"))
    (selected,) = search.steps
    leads = {lead.candidate.term.effect: lead for lead in selected.rivals}
    assert selected.candidate.term.effect == "drive-lag"
    assert leads["second-mode"].evidence_gap > 0.0
    assert leads["second-mode"].misfit_gap < 4.0
