"""Filters on a stage far below its resonance."""

import numpy as np
import pytest

from estimation.estimate import estimate
from phantoms.forward import Plan, simulate
from phantoms.waveforms import Sine
from recon.evaluation import evaluate_axis, truth_from_simulation
from scanner.device import Device
from scanner.device_templates import KnownAxis, new_device


@pytest.mark.slow
@pytest.mark.parametrize("estimator", ["ekf", "ukf"])
def test_the_stated_error_of_a_slow_stage_is_that_of_its_angle(estimator: str) -> None:
    """The velocity, hardly known there, made it 5 degrees."""
    device = Device.from_toml(new_device("afm", {axis: KnownAxis(500.0) for axis in "xy"}))
    recording, truth = simulate(device, Plan({"x": Sine(20.0, 10.0), "y": Sine(17.0, 10.0)}, 1.5, 7200.0), seed=2)
    motion = estimate(recording, device, estimator)
    for axis, angle in truth_from_simulation(truth).angles.items():
        stated = np.degrees(np.sqrt(np.mean(motion.axes[axis].phase_sd ** 2)))
        error = np.degrees(evaluate_axis(motion.axes[axis], *angle).phase_rmse)
        assert error < stated < 0.3
