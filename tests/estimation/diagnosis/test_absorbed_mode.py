"""A coupled mode that nominal values absorb: it is sought early, around the stated values."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.blind.generator import Case
from estimation.device_fit.fit import nominal_values_are_improbable
from tests.support.blind_recordings import search_blind_recording


@pytest.mark.slow
def test_a_coupled_mode_that_nominal_values_absorb_is_found_early_around_the_stated_values(tmp_path: Path) -> None:
    """Over the whole scan no start led to it within minutes: the nominal values are a hundred tolerances away."""
    case = Case("blind-003", "one", "imaging", ("mode-coupling",), "proportional", 2714847646)
    blind, search = search_blind_recording(case, tmp_path, ("resonance-drift", "mode-coupling"))
    assert nominal_values_are_improbable(search.nominal)
    (step,) = search.steps
    assert step.candidate.key == "x.mode-coupling"
    assert not nominal_values_are_improbable(search.final)
    assert search.final.validation_chi2 == pytest.approx(1.0, abs=0.05)
    _, frequency, quality, _ = search.final.model.values(step.candidate, search.final.x)
    assert frequency == pytest.approx(blind.truth.mode_frequency / (2 * np.pi), rel=1e-4)
    assert quality == pytest.approx(blind.truth.mode_frequency / blind.truth.mode_damping, rel=0.02)
