"""Standard errors of the picture's phase where the samples of every line fall on the same places."""

from __future__ import annotations

import numpy as np
import pytest

import lissajous
from phantoms.experiment import Experiment, simulate_experiment
from phantoms.waveforms import Sine
from recon.evaluation import evaluate_axis, truth_from_simulation
from recon.imaging.scan_phase.common_shift import common_shift_factor
from scanner.device import Axis, Device
from scanner.stages import Drive, Mechanics, Position, Scan

DRIVES = {"x": Sine(2000.0, 13.5), "y": Sine(835.0, 9.5)}


def mirror() -> Device:
    """Resonances of 2.0 kHz and 835 Hz, Q 100, with position detectors."""
    drive, readout = Drive("linear", 1e-6), Position(20.0, 2e-3)
    mechanics = {"x": Mechanics(1e-10, 1.25e-8, 1.579e-2), "y": Mechanics(4e-10, 2.1e-8, 1.1e-2)}
    axes = {name: Axis(each, drive=drive, readout=readout, name=name) for name, each in mechanics.items()}
    return Device("mirror", axes, scan=Scan(0.08, 0.08))


def test_cells_that_agree_leave_the_standard_errors() -> None:
    fine = np.zeros((4, 2)), np.full((4, 2), 0.5)
    coarse = np.full((4, 2), 0.8), np.ones((4, 2))  # means 0.8 apart, with variances 1/16 and 1/4
    np.testing.assert_allclose(common_shift_factor(coarse, fine), np.sqrt(1.0 + (0.64 - 3.0 / 16.0) * 16.0))
    np.testing.assert_allclose(common_shift_factor((0.5 * coarse[0], coarse[1]), fine), 1.0)
    np.testing.assert_allclose(common_shift_factor((coarse[0][:2], coarse[1][:2]), (fine[0][:2], fine[1][:2])), 1.0)


@pytest.mark.parametrize("target", ["immunohistochemistry", "cell"])
def test_lines_of_the_same_places_do_not_shift_the_phase(target: str) -> None:
    """500 samples in each period of x: the picture shifted y by 0.03 degrees, with a stated 0.004."""
    experiment = Experiment(
        device=mirror(), target=target, drives=DRIVES, duration=0.2, sample_rate=1e6, drift={"x": -0.001, "y": -0.001}
    )
    recording, truth = simulate_experiment(experiment, seed=2)
    motion = lissajous.reconstruct(recording).motion
    for name, axis in motion.axes.items():
        error = evaluate_axis(axis, *truth_from_simulation(truth).angles[name]).phase_rmse
        assert error < np.radians(0.01)
        assert error < 2.0 * np.sqrt(np.mean(axis.phase_sd**2))
