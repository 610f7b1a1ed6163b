"""The phase error of the readout beside a drift of the detector."""

from dataclasses import replace

import numpy as np
import pytest

from recon.evaluation import truth_from_simulation
from recon.imaging.intensity_drift_equations import DriftKind
from recon.pipeline import reconstruct
from recon.steps.reconstruction import Options
from scanner.device import AXES
from tests.support.simulated import imaging

MAX_SD_RATIO = 1.25
"""Standard deviation of the phase beside the drift over that of a steady detector: the gain falls to 0.6, so the mean
light is 0.8 of that of the steady detector, which costs 1/sqrt(0.8) = 1.12; the drift costs as much again at most."""


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["gain", None])
def test_the_picture_determines_both_phases_beside_a_drifting_gain(kind: DriftKind | None) -> None:
    """Also if the drift stays in the picture: a drift attributed to the phase leaves 1.76° and 0.42° undetermined."""
    recording, simulation = imaging()
    intensity, truth = recording["intensity"], truth_from_simulation(simulation)
    gain = np.linspace(1.0, 0.6, intensity.size)
    drifting = recording.with_channel(replace(intensity, raw=intensity.read() * gain))
    steady = reconstruct(recording, Options(), truth, quiet=True)
    result = reconstruct(drifting, Options(intensity_drift=kind), truth, quiet=True)
    assert sorted(result.readout_phase) == list(AXES)
    assert sum(("gain drift" if kind else "--intensity-drift gain") in note for note in result.notes) == 1
    for name in AXES:
        sd, steady_sd = (np.sqrt(np.mean(each.motion.axes[name].phase_sd ** 2)) for each in (result, steady))
        assert sd < MAX_SD_RATIO * steady_sd
        assert abs(result.evaluation[name].phase.mean()) < 3.0 * sd


@pytest.mark.slow
def test_a_steady_detector_does_not_change_the_motion() -> None:
    recording = imaging()[0]
    plain, result = (reconstruct(recording, Options(intensity_drift=kind), quiet=True) for kind in (None, "gain"))
    assert len(result.intensity_drift) == 1
    for name in AXES:
        np.testing.assert_array_equal(result.motion.axes[name].phase, plain.motion.axes[name].phase)
        np.testing.assert_array_equal(result.motion.axes[name].phase_sd, plain.motion.axes[name].phase_sd)
