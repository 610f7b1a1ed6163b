"""A second effect beside a first: when it is accepted and when it is removed."""

from pathlib import Path

import pytest

from benchmarks.blind.generator import Case
from tests.support.blind_recordings import search_blind_recording


@pytest.mark.slow
def test_clipping_that_held_out_samples_do_not_reach_is_found_beside_a_drift(tmp_path: Path) -> None:
    """The evidence gain is 670. The held-out gain of 7 is within two standard deviations (9) of the expected 18."""
    case = Case("blind-001", "two", "ring", ("resonance-drift", "saturation"), "white", 2209816513)
    _, search = search_blind_recording(case, tmp_path, ("resonance-drift", "saturation", "sensor-cubic", "charging"))
    assert {selected.candidate.term.effect for selected in search.steps} == {"resonance-drift", "saturation"}


@pytest.mark.slow
def test_a_drift_that_low_frequency_noise_explains_is_removed_beside_a_true_lag(tmp_path: Path) -> None:
    """The pair replaces a free term. Of the drift's evidence gain of 184, all but 2 is explained by noise."""
    case = Case("blind-001", "one", "drive", ("readout-lag",), "coloured", 2317301653)
    _, search = search_blind_recording(case, tmp_path, ("readout-lag", "channel-delay", "offset-drift"))
    assert [selected.candidate.term.effect for selected in search.steps] == ["readout-lag"]
