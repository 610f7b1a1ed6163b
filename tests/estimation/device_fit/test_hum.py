"""Mains hum of a rectifier, at a frequency beside the nominal one, is noise and not an effect."""

from pathlib import Path

import pytest

from benchmarks.blind.generator import Case
from estimation.device_fit.hum import select_mains_hum
from estimation.device_fit.mains import Mains
from tests.support.blind_recordings import search_blind_recording


@pytest.mark.slow
def test_seven_harmonics_of_a_deviating_mains_are_no_effect(tmp_path: Path) -> None:
    case = Case("blind-001", "none", "tf", (), "hum", 317722446)
    blind, search = search_blind_recording(case, tmp_path, ("second-mode", "interference"))
    assert not search.steps
    (mains,) = search.final.model.mains
    assert mains.harmonics == 7
    assert mains.frequency == pytest.approx(blind.noise.mains, abs=2e-3)
    assert abs(blind.noise.mains - round(blind.noise.mains, -1)) > 5e-3


def test_weak_hum_keeps_three_harmonics_at_the_nominal_frequency(tmp_path: Path) -> None:
    case = Case("blind-002", "none", "ring", (), "coloured", 4)
    blind, search = search_blind_recording(case, tmp_path, ("interference",))
    assert not search.steps
    assert max(blind.noise.hum) > 0.9 * blind.noise.sd
    assert search.final.model.mains == (Mains(50.0),)
    assert select_mains_hum(search.likelihood, search.final) is search.final
