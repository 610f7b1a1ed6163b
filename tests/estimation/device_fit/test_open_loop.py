"""Open-loop prediction by a device that is not exactly right."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from estimation.candidate_terms.screening import all_candidates
from estimation.device_fit.data import prepare_run
from estimation.device_fit.model import Model
from estimation.device_fit.predict import predict
from estimation.diagnosis.diagnose import diagnose
from phantoms.forward import Plan, simulate
from phantoms.waveforms import Sine
from scanner.active_terms import stated_terms
from scanner.device import Axis, Device
from scanner.errors import DeviceInvalid
from scanner.forward_model import DriveInput, simulate_axis
from scanner.recording import Recording
from scanner.stages import Drive, Mechanics, Position
from scanner.terms import catalogue

SAMPLE_RATE_HZ = 2000.0
CREEP = 0.003  # [V]
RESONANCE = 2 * np.pi * 300.0
STAGE = Axis(
    Mechanics(1.0 / RESONANCE**2, 1.0 / RESONANCE, 1.0),
    drive=Drive("linear", 1.0),
    readout=Position(1.0, 2e-5),
    name="x",
)


def stage_recording() -> Recording:
    """A stage that is scanned in a growing spiral at 20 Hz, and creeps by a tenth of the scan after its start."""
    time = np.arange(2401) / SAMPLE_RATE_HZ
    drive = 0.03 * time / time[-1] * np.sin(2 * np.pi * 20.0 * time)
    middle = np.interp(time[:-1] + 0.5 / SAMPLE_RATE_HZ, time, drive)
    nodes = np.stack([drive[:-1], middle, drive[1:]], axis=1)
    angle = simulate_axis(STAGE, stated_terms(STAGE), DriveInput(nodes, 1 / SAMPLE_RATE_HZ), (0.0, 0.0)).angle
    sensed = angle - CREEP * np.exp(-time[: angle.size] / 0.3)
    sensed = sensed + 2e-5 * np.random.default_rng(1).standard_normal(angle.size)
    channels = {"drive_x": (drive, "V", SAMPLE_RATE_HZ), "sense_x": (sensed, "V", SAMPLE_RATE_HZ)}
    return Recording.from_arrays({name: (*channel, 0.0) for name, channel in channels.items()})


def test_the_start_of_an_axis_that_follows_its_drive_does_not_imitate_what_the_device_omits() -> None:
    predicted = predict(stage_recording(), Device("stage", {"x": STAGE}))["sense_x"]
    error = np.abs(predicted.values - predicted.measured)
    assert error.max() < 2.0 * CREEP


def test_the_start_of_an_overdamped_axis_is_that_of_the_first_samples() -> None:
    slow = 2 * np.pi / 500.0
    tank = Axis(Mechanics(1.0 / slow**2, 2.0 / slow, 1.0), drive=Drive("linear", 2.0), readout=Position(1.0, 0.02),
                name="x")  # fmt: skip
    true = Axis(Mechanics(1.4 / slow**2, 1.4 / slow, 1.0), drive=Drive("linear", 1.7), readout=Position(1.0, 0.02),
                name="x")  # fmt: skip
    drive = 2.5 + np.random.default_rng(2).uniform(-2.0, 2.0, 17).repeat(60)
    inputs = DriveInput(np.repeat(drive[:-1, None], 3, axis=1), 4.0)
    level = simulate_axis(true, stated_terms(true), inputs, (5.0, 0.0)).angle
    noise = 0.02 * np.random.default_rng(3).standard_normal(level.size)
    channels = {"drive_x": (drive, "V", 0.25, 0.0), "sense_x": (level + noise, "V", 0.25, 0.0)}
    predicted = predict(Recording.from_arrays(channels, Device("tank", {"x": true})), Device("tank", {"x": tank}))
    values = predicted["sense_x"].values
    assert abs(values[0] - level[0]) < 0.2 * np.ptp(level)


@pytest.mark.parametrize(
    ("terms", "key"),
    [
        ({"sensor-cubic": {"c3": 0.1}, "second-mode": {"c": 0.01, "f2": 1e6, "Q2": 40.0}}, r"x\.terms\.second-mode"),
        ({"second-mode": {"c": 0.01, "f2": 1e6, "Q2": 40.0}, "viscoelastic": {"k_v": 0.1, "tau_v": 1e-8}}, "x"),
    ],
)
def test_a_prediction_that_diverges_names_the_term(terms: dict[str, dict[str, float]], key: str) -> None:
    device = Device("stage", {"x": replace(STAGE, terms=terms)})
    with pytest.raises(DeviceInvalid, match=f"^{key}: lets the predicted motion diverge; "):
        predict(stage_recording(), device)
    with pytest.raises(DeviceInvalid, match=f"^{key}: lets the predicted motion diverge; "):
        diagnose([stage_recording()], device)


def test_terms_that_the_integrator_does_not_take_are_no_candidates() -> None:
    stated = {
        "cubic-stiffness": {"k3": 1.0},
        "quintic-stiffness": {"k5": 1.0},
        "quadratic-stiffness": {"k2": 1.0},
        "viscoelastic": {"k_v": 0.1, "tau_v": 1e-3},
    }
    recording, device = stage_recording(), Device("stage", {"x": replace(STAGE, terms=stated)})
    model = Model([prepare_run(recording, device)], device)
    terms = [catalogue()[effect] for effect in ("quadratic-drag", "sensor-cubic")]
    assert [candidate.term.effect for candidate in all_candidates(model, terms)] == ["sensor-cubic"]


@pytest.mark.parametrize(
    ("terms", "samples"),
    [({"channel-delay": {"delay": 2e-4}}, 200), ({"readout-lag": {"f_c": 1e4}}, 319)],
    ids=["delay", "lag"],
)
def test_samples_that_show_the_motion_before_the_recording_are_not_compared(terms: dict, samples: int) -> None:
    """A delay of three periods gave the motion a wrong start: 0.18 V beside noise of 1 mV after it, 1.1 V before."""
    axis = Axis(
        Mechanics(1e-15, 5e-13, 1e-15 * (2 * np.pi * 15_600.0) ** 2),
        drive=Drive("linear", 1e-9),
        readout=Position(10.0, 1e-3),
        terms=terms,
        name="x",
    )
    device = Device("late", {"x": axis})
    whole, _ = simulate(device, Plan({"x": Sine(15_500.0, 1.0)}, 0.005, 1e6, settle=0.02), seed=2)
    predicted = predict(whole.slice(0.001, 0.005), device)["sense_x"]
    assert np.isnan(predicted.values[:samples]).all()
    assert np.isfinite(predicted.values[samples:]).all()
    assert predicted.rmse < 1.1e-3


@pytest.mark.parametrize("size", [8000, 8001, 8007])
def test_a_prediction_reaches_the_last_sample(size: int) -> None:
    """An integration step is 10 samples here: up to 10 samples after the last whole step were NaN."""
    mechanics = Mechanics(1e-15, 5e-13, 1e-15 * (2 * np.pi * 1560.0) ** 2)
    device = Device("d", {"x": Axis(mechanics, drive=Drive("linear", 1e-9), readout=Position(10.0, 1e-6), name="x")})
    recording, _ = simulate(device, Plan({"x": Sine(1550.0, 0.2)}, size * 1e-6, 1e6, settle=0.02), seed=2)
    predicted = predict(recording, device)["sense_x"]
    assert np.abs(predicted.values - predicted.measured)[-20:].max() < 2e-5


@pytest.mark.parametrize(
    "terms",
    [{"second-mode": {"c": 0.05, "f2": 2600.0, "Q2": 60.0}}, {"viscoelastic": {"k_v": 2e-8, "tau_v": 1e-3}}],
    ids=lambda terms: next(iter(terms)),
)
def test_the_states_of_a_stated_term_at_the_first_sample_are_fitted(terms: dict) -> None:
    """They were zero, as after a rest: the error of the prediction was 45 times the noise with a second mode."""
    mechanics = Mechanics(1e-15, 1e-13, 1e-15 * (2 * np.pi * 2000.0) ** 2)
    axis = Axis(mechanics, drive=Drive("linear", 1e-9), readout=Position(10.0, 1e-4), terms=terms, name="x")
    device = Device("d", {"x": axis})
    recording, _ = simulate(device, Plan({"x": Sine(1980.0, 0.2)}, 0.02, 2e5, settle=0.1), seed=2)
    predicted = predict(recording, device)["sense_x"]
    assert predicted.rmse < 1.1e-4
