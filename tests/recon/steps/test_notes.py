"""Notes on a recording whose picture is right only in part."""

from dataclasses import replace

import numpy as np
import pytest

from recon.imaging.intensity_correction import describe_drift
from recon.imaging.intensity_drift import IntensityDrift
from recon.steps.intensity_notes import (
    describe_lower_rail,
    describe_negative_counts,
    describe_polarity,
    describe_running_sums,
    describe_saturation,
)
from recon.steps.notes import describe_fast_axes, describe_long_frames
from scanner.angle_tracks import SampledAngle
from scanner.arrays import Array
from scanner.channel import Channel
from scanner.motion import AxisMotion, Motion


def detector(values: Array) -> Channel:
    return Channel("intensity", "V", 1e6, 0.0, values, 0, len(values))


def test_a_saturated_detector_is_named_with_its_share_and_level() -> None:
    light = np.random.default_rng(0).normal(1.0, 0.3, 10_000)
    assert describe_saturation(detector(light)) == []
    level = float(np.quantile(light, 0.8))
    (note,) = describe_saturation(detector(np.minimum(light, level)))
    assert "20.00% of the samples" in note
    assert f"{level:.4g} V" in note
    (note,) = describe_saturation(detector(np.column_stack([light, np.minimum(light, level)])))
    assert note.startswith("intensity, detector 1:")


def test_photon_counts_are_not_saturated() -> None:
    for photons in (0.05, 2.0, 200.0):
        counts = np.random.default_rng(1).poisson(photons, 100_000).astype(float)
        assert describe_saturation(detector(counts)) == []


@pytest.mark.parametrize("photons", [20.0, 200.0])
@pytest.mark.parametrize("share", [0.0, 0.02, 0.2])
def test_a_counter_that_ends_in_the_middle_of_the_noise_is_saturated(photons: float, share: float) -> None:
    """A scene of many brightnesses: its histogram falls slowly, and up to a fifth of the samples are at the end."""
    rng = np.random.default_rng(3)
    counts = rng.poisson(photons * rng.uniform(0.1, 1.0, 100_000)).astype(float)
    limited = np.minimum(counts, np.quantile(counts, 1.0 - share))
    notes = describe_saturation(replace(detector(limited), unit="counts"))
    assert len(notes) == (share > 0.0)


def test_negative_counts_are_stated_and_negative_volts_are_not() -> None:
    values = np.random.default_rng(2).poisson(5.0, 1000).astype(float)
    counts = replace(detector(values), unit="counts")
    assert describe_negative_counts(counts) == []
    values[:10] = -3.0
    (note,) = describe_negative_counts(counts)
    assert "intensity: 1% of the samples are negative, down to -3 counts" in note
    (note,) = describe_negative_counts(replace(detector(-values - 1.0), unit="counts"))
    assert "intensity: 99% of the samples are negative" in note
    assert describe_negative_counts(detector(values)) == []


def test_an_intensity_without_a_unit_is_stated_without_a_space_for_it() -> None:
    light = replace(detector(np.minimum(np.random.default_rng(0).normal(1.0, 0.3, 10_000), 1.0)), unit="")
    assert "at the largest value, 1: the detector" in describe_saturation(light)[0]


def test_the_drift_of_a_detector_is_stated_with_its_name() -> None:
    two = replace(detector(np.zeros((4, 2))), unit="", detectors=("green", "red"))
    drift = IntensityDrift("offset", 1, np.array([-0.1, 0.1, -0.1, 0.1]), 0.01)
    green, red = describe_drift([drift, None], two)
    assert green == "intensity, green: offset drift of 0.1 rms, known to 0.01 at each moment, was removed"
    assert red.startswith("intensity, red: no drift was removed")


def test_a_frame_longer_than_the_recording_is_stated() -> None:
    second = detector(np.zeros(1_000_000))
    (note,) = describe_long_frames(2.0, second)
    assert "2 s is longer than the intensity, 1 s" in note
    for frame_time in (None, 0.5, 1.0, 1.0005):
        assert describe_long_frames(frame_time, second) == []


def test_a_running_sum_is_named_and_a_slow_drift_is_not() -> None:
    counts = np.random.default_rng(3).poisson(2.0, 20_000).astype(float)
    (note,) = describe_running_sums(detector(np.cumsum(counts)))
    assert "running sum" in note
    (note,) = describe_running_sums(detector(np.column_stack([counts, -np.cumsum(counts)])))
    assert note.startswith("intensity, detector 1: falls at all of the")
    assert describe_running_sums(detector(counts + np.linspace(0.0, 100.0, counts.size))) == []
    assert describe_running_sums(detector(np.linspace(0.0, 1.0, 900))) == []


def test_a_detector_clipped_at_its_lower_rail_is_named() -> None:
    light = np.random.default_rng(4).normal(0.0, 0.3, 10_000)
    assert describe_lower_rail(detector(light)) == []
    level = float(np.quantile(light, 0.1))
    (note,) = describe_lower_rail(detector(np.maximum(light, level)))
    assert "10.00% of the samples" in note
    assert f"{level:.4g} V" in note
    assert describe_saturation(detector(np.maximum(light, level))) == []


def test_photon_counts_of_a_dark_scene_are_not_clipped() -> None:
    scene = np.repeat([0.0, 0.05, 2.0, 200.0], 25_000)
    assert describe_lower_rail(detector(np.random.default_rng(5).poisson(scene).astype(float))) == []


def test_a_detector_of_negative_pulses_is_named_and_one_without_its_mean_is_not() -> None:
    light = np.random.default_rng(6).poisson(20.0, 1000).astype(float)
    (note,) = describe_polarity(detector(-light))
    assert note.startswith("intensity: 100% of the samples are negative")
    assert describe_polarity(detector(light - light.mean())) == []
    assert describe_polarity(replace(detector(-light), unit="counts")) == []


def test_a_motion_faster_than_any_scanner_is_noted() -> None:
    knots, zero = np.array([0.0, 1.0]), np.zeros(2)
    axis = AxisMotion(knots, zero, zero + 0.1, zero + 2e6, zero, SampledAngle(np.zeros(4), 1e9))
    slow = replace(axis, frequency=zero + 5e4)
    (note,) = describe_fast_axes(Motion({"x": axis, "y": slow}, "sensor"), detector(np.zeros(4)))
    assert note.startswith("x moves at 2e+06 Hz")
    assert "unit of time" in note
