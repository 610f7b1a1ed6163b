"""Samples of the intensity that were dropped in a scan of which only parts are registered."""

from recon.pipeline import reconstruct
from recon.steps.reconstruction import Options
from recon.steps.registration_segments import registration_segments
from tests.support.position_scan import position_scan

RATE_HZ, SAMPLES, AT, MISSING = 3e5, 120_000, 50_000, 13


def test_samples_dropped_in_a_long_scan_are_located_and_the_timing_is_restored() -> None:
    scan = position_scan(SAMPLES, RATE_HZ, lost=slice(AT, AT + MISSING))
    result = reconstruct(scan, Options(pixels=(200, 200)), quiet=True)
    assert len(registration_segments(result.motion, result.intensity)) == 3
    assert any(note.startswith("intensity: 13 samples lost at 0.16") for note in result.notes)
    assert result.intensity.size == SAMPLES
    assert result.limits == []


def test_a_long_scan_without_loss_is_left_as_it_is() -> None:
    result = reconstruct(position_scan(SAMPLES, RATE_HZ), Options(pixels=(200, 200)), quiet=True)
    assert result.defects == []
    assert result.limits == []
