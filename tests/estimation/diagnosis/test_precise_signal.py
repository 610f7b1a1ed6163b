"""A signal so precise that short windows hardly limit some combinations of the nominal values."""

from __future__ import annotations

import numpy as np

from estimation.diagnosis.diagnose import diagnose
from recon.evaluation import truth_from_simulation
from scanner.recording import Recording
from tests.support.simulated import imaging


def test_a_drift_is_named_in_a_driven_angle_with_noise_of_66_db() -> None:
    recording, simulation = imaging()
    truth = truth_from_simulation(simulation)
    assert truth is not None
    angle, rate, start = truth.angles["x"]
    noise = 1e-4 * np.random.default_rng(0).normal(size=angle.size)
    drive = recording["drive_x"]
    channels = {
        "angle_x": (angle + noise, "rad", rate, start),
        "drive_x": (drive.read(), drive.unit, drive.sample_rate, drive.start),
    }
    (finding,) = diagnose([Recording.from_arrays(channels, recording.device)]).findings
    assert (finding.effect, finding.axis) == ("resonance-drift", "x")
    alpha, tau = finding.parameters
    assert alpha.ci95[0] < -0.002 < alpha.ci95[1]
    assert tau.ci95[0] < 0.025 < tau.ci95[1]
