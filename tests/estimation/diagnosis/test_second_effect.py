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


@pytest.mark.slow
def test_a_lag_before_a_linear_mirror_is_a_rival_of_one_behind_it(tmp_path: Path) -> None:
    """Without the angle only the first periods tell them apart: both fit the recording as well."""
    case = Case("blind-001", "one", "tf", ("readout-lag",), "popcorn", 2896821185)
    _, search = search_blind_recording(case, tmp_path, ("readout-lag", "drive-lag", "channel-delay", "hysteresis"))
    (selected,) = search.steps
    names = [selected.candidate.term.effect, *(rival.candidate.term.effect for rival in selected.rivals)]
    assert {"readout-lag", "drive-lag"} <= set(names[:3])
    gaps = {rival.candidate.term.effect: rival.evidence_gap for rival in selected.rivals}
    assert all(gaps[name] < 6.0 for name in ("readout-lag", "drive-lag") if name in gaps)


@pytest.mark.slow
def test_laws_whose_fits_are_equal_are_rivals_beside_a_discrepancy(tmp_path: Path) -> None:
    """The evidence of their fits differs by 2.5, that of their sensitivities around one fit by 20."""
    case = Case("blind-001", "one", "drive", ("drive-lag",), "hum", 601541145)
    _, search = search_blind_recording(case, tmp_path, ("readout-lag", "drive-lag", "channel-delay", "hysteresis"))
    (selected,) = search.steps
    gaps = {rival.candidate.term.effect: rival.evidence_gap for rival in selected.rivals}
    named = {selected.candidate.term.effect, *(name for name, gap in gaps.items() if gap < 6.0)}
    assert {"readout-lag", "drive-lag", "channel-delay"} <= named
