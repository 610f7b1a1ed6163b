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


@pytest.mark.parametrize(
    ("start_s", "lost", "stated", "right_s"), [(100e-6, 0, "0.0001 s", 0.0), (0.0, 2350, "0 s", 2350e-6)]
)
def test_a_start_that_explains_both_axes_is_named(start_s: float, lost: int, stated: str, right_s: float) -> None:
    """Of an intensity that is stated 100 µs late, and of one that lacks its first 2.35 ms because of its trigger."""
    result = reconstruct(position_scan(60_000, 1e6, start_s, slice(0, lost)), Options(), quiet=True)
    (line,) = (limit for limit in result.limits if limit.startswith("intensity: a start of"))
    assert f"in place of {stated} explains the disagreement in both axes" in line
    assert float(line.split("a start of ")[1].split(" s ")[0]) == pytest.approx(right_s, abs=5e-6)
