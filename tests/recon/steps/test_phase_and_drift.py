"""The phase error of the readout beside a drift of the detector."""

from dataclasses import replace

import numpy as np
import pytest

from recon.evaluation import truth_from_simulation
from recon.imaging.intensity_drift_equations import DriftKind
from recon.imaging.scan_phase.readout_phase import UNDESCRIBED_DELAY_SD_S
from recon.pipeline import reconstruct
from recon.steps.reconstruction import Options
from scanner.device import AXES, Device
from scanner.lowpass import apply_lowpass
from tests.support.simulated import imaging

CORNER_HZ = 1e5
"""Low-pass of a slow detector [Hz]: its time constant is 8 samples."""

MAX_PHASE_ERROR_RAD = np.radians(0.03)
"""A tenth of the phase error that a picture of 400 pixels allows, 0.286 degrees."""

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


@pytest.mark.slow
@pytest.mark.parametrize("kind", [None, "gain"])
def test_a_slow_detector_does_not_shift_the_phase(kind: DriftKind | None) -> None:
    """Corrected for the delay alone, small detail stands too far ahead: 2.1° and 0.5° would be removed."""
    recording = imaging()[0]
    intensity = recording["intensity"]
    device = Device.from_toml(f"{recording.device.to_toml()}\n[x.terms.detector-lag]\nf_c = {CORNER_HZ}\n")
    light = intensity.read() * np.linspace(1.0, 1.0 if kind is None else 0.6, intensity.size)
    slow = replace(intensity, raw=apply_lowpass(light, CORNER_HZ, 1.0 / intensity.sample_rate))
    result = reconstruct(recording.with_channel(slow), Options(device=device, intensity_drift=kind), quiet=True)
    for phase in (result.readout_phase[name] for name in AXES):
        assert abs(phase.value) < 3.0 * phase.sd < MAX_PHASE_ERROR_RAD
    if kind is None:  # a mean has the samples with their low-pass
        np.testing.assert_allclose(result.intensity.read(), slow.read(), rtol=1e-12)


def test_a_scan_that_loses_its_detail_has_an_undetermined_phase() -> None:
    recording = imaging()[0]
    intensity = recording["intensity"]
    values = intensity.read()
    rest = np.random.default_rng(5).poisson(values.mean(), values.size)
    faded = np.where(np.arange(values.size) < 0.3 * values.size, values, rest)
    result = reconstruct(recording.with_channel(replace(intensity, raw=faded)), Options(), quiet=True)
    assert not result.readout_phase
    for axis in result.motion.axes.values():
        assert axis.phase_sd[axis.known].min() > 0.99 * 2 * np.pi * axis.frequency.min() * UNDESCRIBED_DELAY_SD_S
