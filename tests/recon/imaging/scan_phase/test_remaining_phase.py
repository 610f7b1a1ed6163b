"""Phase errors that the picture shows and that were not removed are part of the stated uncertainty."""

from dataclasses import replace

import numpy as np
import pytest

from recon.imaging.scan_phase.phase_error import PhaseError, PhaseEstimate
from recon.imaging.scan_phase.remaining_phase import include_remaining_errors
from recon.pipeline import reconstruct
from recon.report.picture_conclusion import conclude_reconstruction
from recon.report.summary import summarise
from recon.steps.reconstruction import Options
from scanner.angle_tracks import SampledAngle
from scanner.motion import AxisMotion, Motion
from scanner.recording import Recording
from tests.support.simulated import imaging

TIME = np.linspace(0.0, 1.0, 11)


def motion() -> Motion:
    one = np.ones(TIME.size)
    axis = AxisMotion(TIME, 0.0 * one, one, 100.0 * one, 0.003 * one, SampledAngle(np.zeros(10), 10.0))
    return Motion({"x": axis, "y": axis}, "tracker")


def errors(*x: tuple[float, float]) -> list[PhaseError]:
    """Slices with the phase error and standard deviation of x, and none of y."""
    none = PhaseEstimate(float("nan"), float("inf"))
    return [PhaseError((k + 0.5) / len(x), PhaseEstimate(*each), none) for k, each in enumerate(x)]


def test_significant_errors_are_in_the_standard_deviation_and_noise_is_not() -> None:
    widened, (note,) = include_remaining_errors(motion(), errors((0.04, 0.001), (0.0, 0.001), (-0.04, 0.001)))
    assert "phase errors of x" in note
    assert "1.9° rms in 3 of 3 slices" in note
    sd = widened.axes["x"].phase_sd
    assert sd[[0, 5, 10]] == pytest.approx([np.hypot(0.04, 0.003), 0.003, np.hypot(0.04, 0.003)])
    assert widened.axes["y"].phase_sd == pytest.approx(0.003)
    within = errors((0.002, 0.001), (-0.002, 0.001), (float("nan"), float("inf")))
    kept, notes = include_remaining_errors(motion(), within)
    assert not notes
    assert kept.axes["x"].phase_sd == pytest.approx(0.003)


def with_intensity_rate(factor: float) -> Recording:
    recording = imaging()[0]
    light = recording["intensity"]
    return recording.with_channel(replace(light, sample_rate=factor * light.sample_rate))


def test_a_clock_of_the_intensity_that_runs_off_widens_the_phase() -> None:
    """At 100 ppm the phase is 10 degrees off in x and 2.4 in y at the end of 20 ms, 4.4 and 1.0 rms."""
    right, wrong = (reconstruct(with_intensity_rate(f), Options(pixels=(200, 200)), quiet=True) for f in (1.0, 1.0001))
    assert not any("that were not removed" in note for note in right.notes)
    assert sum("that were not removed" in note for note in wrong.notes) == 2
    stated = summarise(wrong)
    assert 2.0 < stated["x"]["phase_sd_deg"] < 20.0
    assert 0.5 < stated["y"]["phase_sd_deg"] < 5.0
    assert stated["x"]["within_bound"] < 0.5


def test_a_doubted_clock_is_the_condition_of_the_stated_uncertainty() -> None:
    doubted, right = (
        summarise(reconstruct(with_intensity_rate(f), Options(pixels=(100, 100)), quiet=True)) for f in (1.3, 1.0)
    )
    assert "1 sd, if the sample rate of the intensity is right)" in conclude_reconstruction(doubted)
    assert "if the sample rate" not in conclude_reconstruction(right)
