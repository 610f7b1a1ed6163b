"""A gain of the detector that changes slowly, found beside the phase error and reported."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from phantoms.experiment import Experiment, simulate_experiment
from recon.evaluation import truth_from_simulation
from recon.imaging.scan_phase.slow_gain import (
    PRIOR_SD,
    GainPart,
    SlowGain,
    describe_slow_gain,
    estimate_slow_gain,
    join_gains,
)
from recon.pipeline import reconstruct
from recon.steps.reconstruction import Options
from scanner.device import AXES
from scanner.recording import Recording

CELLS, SLICES, NOISE_SD = 40, 4, 0.1


def visits(rng: np.random.Generator, samples: int = 40_000) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cells that are visited at random times, the times in slices, and the brightness of a scene at each sample."""
    cell = rng.integers(0, CELLS**2, samples)
    return cell, np.sort(rng.uniform(0.0, SLICES, samples)), rng.uniform(0.0, 1.0, CELLS**2)[cell]


def test_the_gain_is_found_with_the_stated_error() -> None:
    deviations = []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        cell, time, light = visits(rng)
        truth = np.array([0.0, *np.cumsum(rng.normal(0.0, 0.1, SLICES))])
        noise = NOISE_SD * rng.standard_normal(light.size)
        gain = estimate_slow_gain(cell, time, light * np.exp(np.interp(time, np.arange(SLICES + 1), truth)) + noise, 4)
        low, high = sorted((int(np.argmin(gain.log_gain)), int(np.argmax(gain.log_gain))))
        change, sd = gain.change
        deviations.append((change - np.expm1(truth[high] - truth[low])) / sd)
        assert sd < 0.03
    assert 0.7 < np.sqrt(np.mean(np.square(deviations))) < 1.3


@pytest.mark.parametrize("target", ["usaf_bars", "siemens_star", "point_grid"])
def test_detail_finer_than_a_cell_shows_no_gain(target: str) -> None:
    recording, _ = simulate_experiment(Experiment(target=target, duration=0.01), 34001)
    result = reconstruct(recording, Options(), quiet=True)
    assert not any("--intensity-drift" in note for note in result.notes)


@pytest.mark.parametrize("case", ["dark", "no noise", "one visit"])
def test_samples_that_show_no_gain_leave_it_at_one(case: str) -> None:
    rng = np.random.default_rng(0)
    cell, time, light = visits(rng)
    if case == "one visit":
        cell = np.arange(light.size)
    light = 0.0 * light if case == "dark" else light
    gain = estimate_slow_gain(cell, time, light, SLICES)
    np.testing.assert_allclose(gain.log_gain, 0.0, atol=1e-9)
    assert not describe_slow_gain([GainPart(0, 1, gain)])


def test_a_scan_that_visits_every_place_once_determines_no_gain() -> None:
    rng = np.random.default_rng(0)
    place = np.linspace(0.0, 400.0, 40_000)  # the radius of a spiral that opens, in cells
    light = 1.0 + 0.8 * np.sin(place / 3.0) + NOISE_SD * rng.standard_normal(place.size)
    gain = estimate_slow_gain(place.astype(np.int64), np.linspace(0.0, SLICES, place.size), light, SLICES)
    assert not describe_slow_gain([GainPart(0, 1, gain)])
    np.testing.assert_array_equal(gain.log_gain, 0.0)


def test_a_change_within_its_error_is_not_reported() -> None:
    uncertain = SlowGain(np.array([0.0, -0.1]), PRIOR_SD**2 * np.eye(2))
    certain = uncertain._replace(covariance=1e-6 * np.eye(2))
    assert not describe_slow_gain([GainPart(0, 1, uncertain)])
    assert not describe_slow_gain([GainPart(0, 1, certain), GainPart(1, 2, uncertain)])
    assert len(describe_slow_gain([GainPart(0, 1, certain)])) == 1


def test_parts_of_a_long_scan_show_the_change_over_the_scan() -> None:
    """Bleaching to 1/e, measured in three parts of a fifth each, one after a shorter gap than the other."""
    parts = [(0, 20), (30, 50), (80, 100)]
    gains = [
        GainPart(*part, SlowGain(-np.linspace(*part, 3) / 100.0 + np.mean(part) / 100.0, 1e-6 * np.eye(3)))
        for part in parts
    ]
    np.testing.assert_allclose(np.diff(join_gains(gains).log_gain)[[0, 2, 5]], [-0.1, -0.1, -0.3])
    (note,) = describe_slow_gain(gains)
    assert "fall by 63.2 % ±" in note


def falling(recording: Recording) -> Recording:
    """The recording with a gain that falls by a quarter."""
    intensity = recording["intensity"]
    return recording.with_channel(replace(intensity, raw=intensity.read() * np.linspace(1.0, 0.75, intensity.size)))


def test_a_change_of_the_gain_is_written_without_powers_of_ten() -> None:
    gain = SlowGain(np.array([0.5, -0.5]), np.diag([0.1, 0.1]) ** 2)
    (note,) = describe_slow_gain([GainPart(0, 1, gain)])
    assert "fall by 63.2 % ± 5.2 % during" in note
    (note,) = describe_slow_gain([GainPart(0, 1, gain._replace(log_gain=-gain.log_gain))])
    assert "rise by 172 % ± 38 % during" in note


def test_a_falling_gain_does_not_change_the_phase_and_is_reported_once() -> None:
    """Attributed to the phase, it shifts y by 0.19° with a stated standard deviation of 0.04°."""
    recording, simulation = simulate_experiment(Experiment(target="immunohistochemistry", duration=0.03), 34000)
    truth = truth_from_simulation(simulation)
    steady, fallen = (reconstruct(each, Options(), truth, quiet=True) for each in (recording, falling(recording)))
    for axis in AXES:
        sd = steady.motion.axes[axis].phase_sd
        difference = fallen.motion.axes[axis].phase - steady.motion.axes[axis].phase
        assert np.max(np.abs(difference)) < 0.5 * np.min(sd)
        np.testing.assert_allclose(fallen.motion.axes[axis].phase_sd, sd, rtol=0.25)
    assert sum("fall by 25" in note and "--intensity-drift gain" in note for note in fallen.notes) == 1
    assert not any("--intensity-drift" in note for note in steady.notes)
