"""Mains hum of a rectifier, at a frequency beside the nominal one, is noise and not an effect."""

from pathlib import Path

from benchmarks.blind.generator import Case
from tests.support.blind_recordings import search_blind_recording


def test_seven_harmonics_of_a_deviating_mains_are_no_effect(tmp_path: Path) -> None:
    case = Case("blind-001", "none", "tf", (), "hum", 317722446)
    _, search = search_blind_recording(case, tmp_path, ("second-mode", "interference"))
    assert not search.steps
    assert search.final.model.mains
