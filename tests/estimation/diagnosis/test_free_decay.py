"""A gain or a damping that drifts is listed where damping is seen in one free decay only."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from estimation.device_fit.data import prepare_run
from estimation.device_fit.parameters import Candidate
from estimation.diagnosis import diagnose as diagnosing
from estimation.diagnosis.free_decay import decay_confounders
from scanner.active_terms import stated_terms
from scanner.device import Axis, Device
from scanner.forward_model import DriveInput, simulate_axis
from scanner.recording import Recording
from scanner.stages import Drive, Mechanics, Position
from scanner.terms import catalogue
from tests.support.simulated import imaging

RATE, SAMPLE_RATE = 2 * np.pi * 40.0, 2000.0
NOMINAL = Axis(Mechanics(1.0, 2.0, RATE**2), readout=Position(1.0, 2e-4), tolerance={"J": 1e-9, "gain": 1e-9}, name="x")
DEVICE = Device("lever", {"x": NOMINAL})


def decay(amplitude: float, angle: bool = False) -> Recording:
    true = DEVICE.with_terms({"x": {"cubic-damping": {"b3": 60.0}}}).axes["x"]
    motion = simulate_axis(true, stated_terms(true), DriveInput(np.zeros((4000, 3)), 1 / SAMPLE_RATE), (amplitude, 0.0))
    noise = 2e-4 * np.random.default_rng(3).standard_normal(motion.angle.size)
    channels = {"sense_x": (motion.angle + noise, "V", SAMPLE_RATE, 0.0)}
    if angle:
        channels["angle_x"] = (motion.angle, "rad", SAMPLE_RATE, 0.0)
    return Recording.from_arrays(channels, DEVICE)


def listed(*recordings: Recording, effect: str = "cubic-damping", device: Device = DEVICE) -> tuple[str, ...]:
    runs = [prepare_run(recording, device) for recording in recordings]
    return decay_confounders(runs, device, Candidate(catalogue()[effect], "x", "sense"))


def test_one_decay_of_a_sensor_of_motion_does_not_exclude_changes_in_time() -> None:
    assert listed(decay(0.2)) == ("gain-drift", "damping-drift")
    assert listed(decay(0.2), effect="damping-drift") == ("gain-drift", "cubic-damping")
    assert listed(decay(0.2), effect="cubic-stiffness") == ("resonance-drift",)
    assert listed(decay(0.2), effect="resonance-drift") == ("cubic-stiffness",)
    assert listed(decay(0.2), effect="sensor-cubic") == ()


def test_an_angle_channel_excludes_a_gain_that_drifts() -> None:
    assert listed(decay(0.2, angle=True)) == ("damping-drift",)


def test_another_amplitude_or_a_drive_excludes_all() -> None:
    assert listed(decay(0.2), decay(0.1)) == ()
    driven = Device(
        "lever", {"x": Axis(NOMINAL.mechanics, drive=Drive("linear", 1.0), readout=NOMINAL.readout, name="x")}
    )
    time = np.arange(4001) / SAMPLE_RATE
    channels = {
        "drive_x": (np.cos(RATE * time), "V", SAMPLE_RATE),
        "sense_x": (decay(0.2)["sense_x"].read(), "V", SAMPLE_RATE),
    }
    with_drive = Recording.from_arrays({k: (*v, 0.0) for k, v in channels.items()}, driven)
    assert listed(with_drive, device=driven) == ()
    bias = Recording.from_arrays(
        {**{k: (*v, 0.0) for k, v in channels.items()}, "drive_x": (np.ones(4001), "V", SAMPLE_RATE, 0.0)}, driven
    )
    assert listed(bias, device=driven) == listed(decay(0.2))  # a constant bias does not


def test_the_diagnosis_lists_it_with_the_measurement_that_separates_them(monkeypatch: pytest.MonkeyPatch) -> None:
    known = {effect: catalogue()[effect] for effect in ("cubic-damping", "damping-drift")}
    monkeypatch.setattr(diagnosing, "catalogue", lambda: known)
    (finding,) = diagnosing.diagnose([decay(0.2)]).findings
    assert finding.effect == "cubic-damping"
    assert {"gain-drift", "damping-drift"} <= {rival.effect for rival in finding.rivals}
    assert "record another amplitude" in str(finding.advice)


@pytest.mark.parametrize(("size", "driven"), [(1e-4, False), (1.0, True)])
def test_the_noise_of_a_recorded_drive_does_not_drive(size: float, driven: bool) -> None:
    linear = replace(NOMINAL, drive=Drive("linear", RATE**2))
    device, free = Device("lever", {"x": linear}), decay(0.2)
    drive = size * np.random.default_rng(4).standard_normal(free["sense_x"].size)
    channels = {"sense_x": (free["sense_x"].read(), "V", SAMPLE_RATE, 0.0), "drive_x": (drive, "V", SAMPLE_RATE, 0.0)}
    assert listed(Recording.from_arrays(channels, device), device=device) == (
        () if driven else ("gain-drift", "damping-drift")
    )


def test_a_comb_drives_a_mirror_that_moves() -> None:
    """Combs move no mirror at rest, from which the test began: a driven scan had the confounders of a free decay."""
    recording = imaging()[0].slice(0.0, 0.01).without_channel("intensity")
    nominal = recording.device
    assert nominal is not None
    assert listed(recording, device=nominal) == ()
