"""Drives and intensity, with J, b and k in the device file: the picture's phase against that of the response."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from phantoms.experiment import Experiment, simulate_experiment
from phantoms.waveforms import Sine
from recon.evaluation import Truth, truth_from_simulation
from recon.pipeline import reconstruct
from recon.steps.reconstruction import Options, Reconstruction
from scanner.device import Device
from scanner.device_templates import KnownAxis, new_device
from scanner.recording import Recording
from tests.support.simulated import imaging

DRIVES_HZ = {"x": 13840.0, "y": 3270.0}
QUALITY = 100.0


@cache
def linear() -> tuple[Recording, Truth]:
    """A scan of 0.17 rad by linear drives 0.2 % above the resonances."""
    known = {a: KnownAxis(f / 1.002, QUALITY, 0.18, f) for a, f in DRIVES_HZ.items()}
    device = Device.from_toml(new_device("electromagnetic", known))
    drives = {}
    for axis, hz in DRIVES_HZ.items():
        m, drive, w = device.axis(axis).require_mechanics(), device.axis(axis).drive, 2 * np.pi * hz
        assert drive is not None
        assert drive.torque_per_volt is not None
        drives[axis] = Sine(hz, 0.17 * abs(m.k - m.J * w**2 + 1j * m.b * w) / drive.torque_per_volt, 0.0)
    recording, truth = simulate_experiment(
        Experiment(device=device, drives=drives, duration=0.02, sample_rate=2.5e6, drift={}), seed=61_400
    )
    return recording, truth_from_simulation(truth)


@cache
def parametric() -> tuple[Recording, Truth]:
    recording, truth = imaging(seed=31)
    return recording, truth_from_simulation(truth)


def nominal(recording: Recording) -> Device:
    assert recording.device is not None
    return recording.device


def changed(device: Device, stiffness: float, tolerance: float, **without: None) -> Device:
    """The device with another k and tolerance of k in both axes, without a readout."""
    axes = {}
    for name, axis in device.axes.items():
        mechanics = axis.require_mechanics()
        other = replace(mechanics, k=mechanics.k * (1.0 + stiffness))
        axes[name] = replace(
            axis, mechanics=other, readout=None, tolerance={**axis.tolerance, "k": tolerance}, **without
        )
    return replace(device, axes=axes, readout=None)


def from_drives(recording: Recording, truth: Truth, device: Device) -> Reconstruction:
    kept = {name: recording[name] for name in ("drive_x", "drive_y", "intensity")}
    stored = {name: (each.read(), each.unit, each.sample_rate, each.start) for name, each in kept.items()}
    options = Options(pixels=(120, 120), allow_outside=True)
    return reconstruct(Recording.from_arrays(stored, device), options, truth, quiet=True)


@pytest.mark.slow
@pytest.mark.parametrize("stiffness", [-0.015, 0.01])
def test_a_stiffness_within_its_tolerance_explains_the_phase(stiffness: float) -> None:
    """The response is 40° and 53° off, the amplitude by up to 50 %."""
    recording, truth = linear()
    result = from_drives(recording, truth, changed(nominal(recording), stiffness, 0.02))
    for name in "xy":
        assert np.degrees(result.evaluation[name].phase_rmse) < 0.1
        assert np.abs(result.evaluation[name].amplitude).max() < 0.02
        assert result.motion.axes[name].sign == "known: the drive"
    assert sum("from k of the device explains it" in note for note in result.notes) == 2


@pytest.mark.slow
def test_a_picture_that_no_stiffness_explains_is_made_from_frequencies_and_field() -> None:
    recording, truth = linear()
    result = from_drives(recording, truth, changed(nominal(recording), -0.015, 0.002))
    for name in "xy":
        assert np.degrees(result.evaluation[name].phase_rmse) < 0.1
        assert result.motion.axes[name].amplitude.max() == pytest.approx(0.18, rel=1e-6)
        assert result.motion.axes[name].sign == "ambiguous"
    assert sum("which no stiffness within 1.1 % explains: check [" in note for note in result.notes) == 2


@pytest.mark.slow
@pytest.mark.parametrize("stiffness", [-0.006, 0.006])
def test_combs_that_sustain_no_motion_by_the_nominal_stiffness_do_by_one_within_its_tolerance(stiffness: float) -> None:
    """At + 0.6 % the nominal device sustains none, at -0.6 % its amplitude is 20 % off."""
    recording, truth = parametric()
    result = from_drives(recording, truth, changed(nominal(recording), stiffness, 0.02))
    for name in "xy":
        assert np.degrees(result.evaluation[name].phase_rmse) < 0.15
        assert np.abs(result.evaluation[name].amplitude).max() < 0.05


@pytest.mark.slow
def test_mechanics_without_the_law_of_the_torque_are_stated_to_be_unused() -> None:
    recording, truth = parametric()
    result = from_drives(recording, truth, changed(nominal(recording), 0.0, 0.02, capacitance=None))
    assert max(np.degrees(each.phase_rmse) for each in result.evaluation.values()) < 0.1
    assert any("J, b and k of the device are not used, because [x.capacitance]" in note for note in result.notes)
