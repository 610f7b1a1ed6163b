"""A start of the intensity that is stated wrong by more than the registration reaches."""

import pytest

from recon.pipeline import reconstruct
from recon.report.picture_conclusion import conclude_reconstruction
from recon.report.summary import summarise
from recon.steps.reconstruction import Options
from tests.support.position_scan import FREQUENCY_HZ, position_scan

DELAY_S = 40e-6


@pytest.mark.parametrize("sense_only", [False, True])
def test_the_phase_sd_contains_a_start_that_is_stated_wrong(sense_only: bool) -> None:
    """40 µs are 59.6° of x, which the standard deviation of its phase has to contain."""
    result = reconstruct(position_scan(60_000, 1e6, DELAY_S), Options(sense_only=sense_only), quiet=True)
    summary = summarise(result)
    assert any(limit.startswith("x: forward and backward half-periods disagree") for limit in result.limits)
    assert summary["x"]["phase_sd_deg"] == pytest.approx(360.0 * FREQUENCY_HZ["x"] * DELAY_S, rel=0.1)
    assert summary["x"]["within_bound"] < 0.05
    assert not any("determines no phase of x" in note for note in result.notes)
    assert "--sense-only" not in conclude_reconstruction(summary)
