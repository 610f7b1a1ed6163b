"""Recordings of a few periods of the slower axis: frequency of the drive, motion and its standard deviation."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.short_recordings import LINEAR_HZ, PARAMETRIC_HZ, linear_device
from estimation.estimate import estimate
from estimation.reference import drive_reference
from estimation.short_tone import fit_short_tone
from phantoms.experiment import Experiment, simulate_experiment
from phantoms.forward import Plan, simulate
from phantoms.waveforms import Sine
from recon.evaluation import evaluate_axis, truth_from_simulation
from recon.pipeline import reconstruct
from recon.steps.reconstruction import Options
from scanner.channel import make_channel
from scanner.errors import BadInput
from scanner.recording import Recording
from tests.support.simulated import shared_electrode

RATE = 1e6


def tone(periods: float, noise: float = 0.0, frequency: float = 5000.0) -> np.ndarray:
    t = np.arange(round(periods / frequency * RATE)) / RATE
    rng = np.random.default_rng(1)
    return 30.0 + 30.0 * np.sin(2 * np.pi * frequency * t + 0.7) + rng.normal(0.0, noise, t.size)


@pytest.mark.parametrize("periods", [1.6, 2.0, 3.3, 7.9])
def test_the_frequency_of_a_few_periods_is_exact(periods: float) -> None:
    drive = make_channel("drive_x", tone(periods), unit="V", sample_rate=RATE)
    assert drive_reference(drive, "drive", 500.0).frequency == pytest.approx(5000.0, rel=1e-6)
    noisy = tone(periods, noise=1.0)
    noisy[3:5] = np.nan
    found = fit_short_tone(make_channel("drive_x", noisy, unit="V", sample_rate=RATE), 500.0, 8.0)
    assert found == pytest.approx(5000.0, rel=5e-3)


def test_what_is_no_tone_has_no_frequency() -> None:
    ramp, step = np.linspace(0.0, 1.0, 400), np.repeat([0.0, 1.0], 200)
    noise = np.random.default_rng(2).normal(size=400)
    for values in (ramp, step, noise, np.ones(400), np.full(400, np.nan)):
        assert fit_short_tone(make_channel("drive_x", values, unit="V", sample_rate=RATE), 0.0, 8.0) is None


@pytest.mark.parametrize("periods", [2, 5])
def test_a_parametric_scanner_is_tracked_within_its_stated_uncertainty(periods: int) -> None:
    scores: dict[str, list[float]] = {"x": [], "y": []}
    for seed in range(4):
        recording, simulated = shared_electrode(periods / PARAMETRIC_HZ["y"], seed=seed)
        truth = truth_from_simulation(simulated)
        assert truth is not None
        for name, axis in estimate(recording).axes.items():
            evaluation = evaluate_axis(axis, *truth.angles[name])
            assert np.degrees(evaluation.phase_rmse) < 0.12
            sd = np.interp(evaluation.time, axis.time, axis.phase_sd)
            assert np.degrees(sd).max() < 0.1
            scores[name].extend(evaluation.phase / sd)
    for score in scores.values():
        assert 0.4 < np.sqrt(np.mean(np.square(score))) < 1.6


@pytest.mark.parametrize("estimator", ["sensor", "tracker"])
def test_position_sensors_are_used_within_their_stated_uncertainty(estimator: str) -> None:
    device = linear_device()
    drives = {name: Sine(frequency, 10.0) for name, frequency in LINEAR_HZ.items()}
    score: list[float] = []
    for seed in range(4):
        recording, simulated = simulate(device, Plan(drives, 2 / LINEAR_HZ["y"]), seed=seed)
        truth = truth_from_simulation(simulated)
        assert truth is not None
        for name, axis in estimate(recording, device, estimator).axes.items():
            evaluation = evaluate_axis(axis, *truth.angles[name])
            assert np.degrees(evaluation.phase_rmse) < 0.08
            score.extend(evaluation.phase / np.interp(evaluation.time, axis.time, axis.phase_sd))
    assert 0.5 < np.sqrt(np.mean(np.square(score))) < 1.5


@pytest.mark.parametrize("picture", ["mean", "kernel", "posterior"])
def test_two_periods_give_a_picture_that_states_its_uncertainty(picture: str) -> None:
    recording, simulated = simulate_experiment(Experiment(duration=2 / PARAMETRIC_HZ["y"]), 5)
    truth = truth_from_simulation(simulated)
    result = reconstruct(recording, Options(pixels=(64, 64), picture=picture), truth, quiet=True)
    assert result.picture.coverage.any()
    assert all(np.degrees(each.phase_rmse) < 0.12 for each in result.evaluation.values())
    stated = [np.degrees(axis.phase_sd.min()) for axis in result.motion.axes.values()]
    assert min(stated) > 0.2  # no picture of so few samples shows a delay of the readout
    assert any("without such a delay it is 0.0" in note for note in result.notes)


def test_less_than_one_and_a_half_periods_are_refused() -> None:
    recording, _ = shared_electrode(3 / PARAMETRIC_HZ["y"])
    short = {
        name: (channel.read(0, round(1.4 / PARAMETRIC_HZ["y"] * channel.sample_rate)), "V", channel.sample_rate)
        for name, channel in recording.channels.items()
    }
    with pytest.raises(
        BadInput, match=r"is 2141 samples long, 1.4 periods of a motion at 3270 Hz; 2294 samples are needed"
    ):
        estimate(Recording.from_arrays(short, recording.device))
