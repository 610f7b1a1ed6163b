"""Estimators compensate the effects that the device states as terms."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from estimation.describing_function import torque_harmonics
from estimation.estimate import estimate
from phantoms.forward import Plan, simulate
from phantoms.waveforms import Sine
from recon.evaluation import evaluate_axis
from scanner import devices
from scanner.active_terms import ActiveTerm
from scanner.device import Axis, Device
from scanner.recording import Recording
from scanner.stages import Drive, Mechanics, Position
from scanner.terms import catalogue

DURATION_S = 0.006
DRIVES = {"x": Sine(27680.0, 30.0, 30.0), "y": Sine(6540.0, 30.0, 30.0)}
TERM_PARAMETERS: dict[str, dict[str, float]] = {
    "readout-lag": {"f_c": 2e5},
    "comb-offset": {"theta_c": 0.01},
    "square-law": {"w": 3e10},
    "channel-delay": {"delay": 1e-6},
    "gain-drift": {"g": 0.2, "T": DURATION_S},
    "feedthrough": {"g": 0.005, "h": 0.005, "omega_d": 2 * np.pi * 27680.0},
    "drive-lag": {"f_c": 1.5e5},
    "quadratic-stiffness": {"k2": 6e-7},
}


def stated(device: Device, effect: str, axis: str = "x") -> Device:
    terms = {effect: TERM_PARAMETERS[effect]}
    return replace(device, axes=dict(device.axes) | {axis: replace(device.axis(axis), terms=terms)})


@cache
def recorded(effect: str) -> tuple[Recording, Mapping]:
    """The imaging device, both axes on one electrode, with an effect on x."""
    return simulate(stated(devices.load("imaging"), effect), Plan(DRIVES, DURATION_S), seed=1)


def errors(device: Device, effect: str, method: str) -> tuple[float, float]:
    """Largest of both axes' errors: phase [deg] and angle, root mean square [rad]; with the right sign if ambiguous."""
    recording, truth = recorded(effect)
    motion, found = estimate(recording, device, method), []
    for name, axis in motion.axes.items():
        angle = truth[f"angle_{name}"][0]
        is_turned = axis.sign == "ambiguous" and evaluate_axis(axis, angle, 5e6, 0.0).mirrored
        found.append(evaluate_axis(axis.negated() if is_turned else axis, angle, 5e6, 0.0))
        assert not found[-1].mirrored
    return max(np.degrees(each.phase_rmse) for each in found), max(each.angle_rmse for each in found)


@pytest.mark.parametrize("effect", sorted(TERM_PARAMETERS.keys() - {"drive-lag"}))
def test_the_tracker_compensates_a_stated_term(effect: str) -> None:
    device = devices.load("imaging")
    before, after = (errors(each, effect, "tracker") for each in (device, stated(device, effect)))
    assert after[0] < 0.02
    assert after[0] < 0.5 * before[0] or after[1] < 0.25 * before[1]


def test_the_tracker_absorbs_a_drive_lag_as_a_stiffness_change() -> None:
    device = devices.load("imaging")  # it matters without a sense signal
    for known_device in (device, stated(device, "drive-lag")):
        assert errors(known_device, "drive-lag", "tracker")[0] < 0.02


@pytest.mark.parametrize("beside", [{}, {"feedthrough": TERM_PARAMETERS["feedthrough"]}], ids=["alone", "feedthrough"])
def test_samples_that_a_stated_saturation_clips_are_treated_as_clipped(beside: dict[str, dict[str, float]]) -> None:
    """As signals of the motion estimated so far they kept its error: 3e-4 and 7e-4 rad in y."""
    device = devices.load("imaging")
    terms = {"saturation": {"limit": 1.08}} | beside
    clipping = replace(device, axes=dict(device.axes) | {"x": replace(device.axis("x"), terms=terms)})
    recording, truth = simulate(clipping, Plan(DRIVES, DURATION_S), seed=1)
    sense = recording["sense"].read()
    assert np.mean(sense == sense.max()) > 0.04
    motion = estimate(recording, clipping, "tracker")
    for name, most in (("x", 1e-3), ("y", 1.5e-4)):
        axis = motion.axes[name]
        is_turned = evaluate_axis(axis, truth[f"angle_{name}"][0], 5e6, 0.0).mirrored
        found = evaluate_axis(axis.negated() if is_turned else axis, truth[f"angle_{name}"][0], 5e6, 0.0)
        assert found.angle_rmse < most
        assert np.degrees(found.phase_rmse) < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("method", ["ekf", "constant"])
def test_other_estimators_compensate_a_stated_term(method: str) -> None:
    device = devices.load("imaging")
    before, after = (errors(each, "readout-lag", method)[0] for each in (device, stated(device, "readout-lag")))
    assert after < 0.2 < 2.0 < before


def test_either_axis_may_state_a_term_of_a_shared_electrode() -> None:
    device = devices.load("imaging")
    assert errors(stated(device, "readout-lag", "y"), "readout-lag", "tracker")[0] < 0.02


def test_the_nonlinearity_and_lag_of_a_position_sensor_are_inverted() -> None:
    axis = devices.load("chen2020-driven").axis("x")
    readout = Position(gain=10.0, noise_sd=1e-3)
    axis = replace(axis, drive=Drive("linear", 1e-9), readout=readout, capacitance=None)
    nonlinear = Device(
        "linear", {"x": replace(axis, terms={"sensor-cubic": {"c3": -0.05}, "readout-lag": {"f_c": 1e5}})}
    )
    recording, simulated_truth = simulate(nonlinear, Plan({"x": Sine(15500.0, 20.0)}, 0.004, 1e6, settle=0.02), seed=2)
    truth: Mapping[str, Any] = simulated_truth
    rms = [
        evaluate_axis(estimate(recording, device, "sensor").axes["x"], truth["angle_x"][0], 1e6, 0.0).angle_rmse
        for device in (Device("linear", {"x": axis}), nonlinear)
    ]
    assert rms[1] < 1e-3 < 5 * rms[1] < rms[0]  # inverting a lag amplifies noise


@pytest.mark.parametrize("order", [1, -1], ids=["sensor first", "lag first"])
def test_the_order_in_the_device_file_does_not_place_a_lag(order: int) -> None:
    """The angle had an error of 6.2e-4 rad where the file stated the lag last: the simulation applied it there."""
    device = devices.load("imaging")
    terms = dict([("sensor-cubic", {"c3": -0.05}), ("readout-lag", {"f_c": 1e5})][::order])
    device = replace(device, axes=dict(device.axes) | {"x": replace(device.axis("x"), terms=terms)})
    recording, truth = simulate(device, Plan(DRIVES, DURATION_S), seed=1)
    axis = estimate(recording, device, "tracker").axes["x"]
    is_turned = evaluate_axis(axis, truth["angle_x"][0], 5e6, 0.0).mirrored
    assert evaluate_axis(axis.negated() if is_turned else axis, truth["angle_x"][0], 5e6, 0.0).angle_rmse < 4e-4


def test_torque_harmonics_equal_the_describing_function() -> None:
    axis = devices.load("chen2020-driven").axis("x")
    cubic = torque_harmonics(ActiveTerm(catalogue()["cubic-stiffness"], (2.0,)), axis, 0.1, 1e5, 0.0)
    assert cubic[1] == pytest.approx(1j * 0.75 * 2.0 * 0.1**3)  # -k3 a^3 (3 sin u - sin 3u) / 4
    assert cubic[3] == pytest.approx(-1j * 0.25 * 2.0 * 0.1**3)
    drag = torque_harmonics(ActiveTerm(catalogue()["quadratic-drag"], (1e-14,)), axis, 0.1, 1e5, 0.0)
    assert -drag[1].real == pytest.approx(8 / (3 * np.pi) * 1e-14 * (0.1 * 1e5) ** 2, rel=1e-3)
    k_v, tau = 1e-6, 2e-5
    solid = torque_harmonics(ActiveTerm(catalogue()["viscoelastic"], (k_v, tau)), axis, 0.1, 1e5, 0.0)
    assert solid[1] == pytest.approx(1j * 0.1 * k_v * (1 - 1 / (1 + 1j * 1e5 * tau)), rel=1e-3)


def test_a_term_that_the_tracker_approximates_is_noted() -> None:
    recording, _ = recorded("quadratic-stiffness")
    motion = estimate(recording, stated(devices.load("imaging"), "quadratic-stiffness"), "tracker")
    assert "quadratic-stiffness of x" in motion.notes[0]


@pytest.mark.parametrize("k2", [6e-7, -6e-7])
def test_an_even_torque_determines_the_sign_of_the_motion(k2: float) -> None:
    """It moves the mean to one side: the sense signal then has odd harmonics with the sign of the motion."""
    device = devices.load("imaging")
    terms = {"quadratic-stiffness": {"k2": k2}}
    device = replace(device, axes=dict(device.axes) | {"x": replace(device.axis("x"), terms=terms)})
    recording, simulated_truth = simulate(device, Plan(DRIVES, DURATION_S), seed=3)
    truth: Mapping[str, Any] = simulated_truth
    motion = estimate(recording, device, "tracker")
    assert motion.axes["x"].sign.startswith("known: a torque")
    assert motion.axes["y"].sign == "ambiguous"
    found = evaluate_axis(motion.axes["x"], truth["angle_x"][0], 5e6, 0.0)
    assert not found.mirrored
    assert np.degrees(found.phase_rmse) < 0.02
    mean = np.mean(motion.axes["x"].angle.read(0, motion.axes["x"].angle.size))
    assert mean == pytest.approx(np.mean(truth["angle_x"][0]), rel=0.1)


def test_a_drift_counts_from_the_start_of_the_whole_recording() -> None:
    """In its second half a gain that rises by 20 % is 15 % larger than at the beginning."""
    rate, resonance = 1e5, 2 * np.pi * 1e3
    time = np.arange(10_000) / rate
    drift = {"gain-drift": {"g": 0.2, "T": 0.1}}
    axis = Axis(Mechanics(1.0, 60.0, resonance**2), readout=Position(10.0, 1e-4), terms=drift, name="x")
    angle = 0.1 * np.sin(resonance * time)
    sensed = 10.0 * angle * (1.0 + 0.2 * time / 0.1)
    device = Device("stage", {"x": axis})
    half = Recording.from_arrays({"sense_x": (sensed, "V", rate, 0.0)}, device).part(0.05, np.inf)
    found = estimate(half, device, "sensor").axes["x"].angle.read(0, 5000)
    np.testing.assert_allclose(found, angle[5000:], atol=1e-4)
