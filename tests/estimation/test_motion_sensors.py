"""Readouts of velocity and acceleration: simulated, tracked, filtered, predicted and diagnosed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from estimation.device_fit.data import prepare_run
from estimation.device_fit.open_loop import fit_start_only
from estimation.device_fit.predict import predict
from estimation.estimate import default_estimator, estimate
from phantoms.forward import InitialState, Plan, simulate
from phantoms.waveforms import Constant, Sine
from scanner.device import Axis, Device
from scanner.errors import BadInput, DeviceInvalid, UnitUnknown
from scanner.forward_model import acceleration
from scanner.recording import Recording
from scanner.stages import Acceleration, Drive, Mechanics, MotionSensor, Position, Velocity

RESONANCE_HZ, QUALITY = 1000.0, 50.0
W = 2 * np.pi * RESONANCE_HZ
SENSORS = {0: Position(10.0, 0.01), 1: Velocity(10.0 / W, 0.01, 0.02), 2: Acceleration(10.0 / W**2, 0.01, -0.03)}
"""Sensors of the same output for a motion at the resonance, by their order."""


def bench(readout: MotionSensor, **terms: dict[str, float]) -> Device:
    axis = Axis(
        Mechanics(1e-10, 1e-10 * W / QUALITY, 1e-10 * W**2),
        drive=Drive("linear", 1e-6), readout=readout, name="x", terms=terms,
    )  # fmt: skip
    return Device("bench", {"x": axis})


def driven(order: int, duration: float = 0.05, references: tuple[str, ...] = (), **terms: dict[str, float]):  # type: ignore[no-untyped-def]
    plan = Plan({"x": Sine(1003.0, 8.0)}, duration, 1e5, settle=0.1, references=references)
    return simulate(bench(SENSORS[order], **terms), plan, seed=11)


def test_acceleration_of_a_polynomial_of_degree_five_is_exact() -> None:
    t = 0.3 * np.arange(9.0)
    power = np.polynomial.Polynomial([1.0, -2.0, 0.5, 0.25, -0.125, 0.0625])
    assert np.allclose(acceleration(power(t), power.deriv(1)(t), 0.3), power.deriv(2)(t), rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("order", [1, 2])
def test_a_free_decay_is_read_out_by_its_law(order: int) -> None:
    readout = replace(SENSORS[order], noise_sd=0.0)
    plan = Plan({"x": Constant(0.0)}, 0.03, 1e5, references=("velocity", "acceleration"))  # several pieces
    recording, _ = simulate(bench(readout), plan, start={"x": InitialState(0.1, 0.0)})
    loss, t = W / QUALITY / 2, recording["sense_x"].time()
    turn = np.sqrt(W**2 - loss**2)
    pole = -loss + 1j * turn
    expected = 0.1 * (pole**order * (1 - 1j * loss / turn) * np.exp(pole * t)).real
    signal = (recording["sense_x"].read() - readout.offset) / readout.gain
    assert np.abs(signal - expected).max() < 1e-5 * np.abs(expected).max()
    channel = recording[("velocity_x", "acceleration_x")[order - 1]]
    assert channel.unit == ("rad/s", "rad/s2")[order - 1]
    assert np.abs(channel.read() - expected).max() < 1e-5 * np.abs(expected).max()


@pytest.mark.parametrize("order", [1, 2])
def test_the_tracker_follows_velocity_and_acceleration_as_well_as_position(order: int) -> None:
    errors = []
    for each in (0, order):
        recording, truth = driven(each)
        assert each == 0 or default_estimator(recording, bench(SENSORS[each])) == "tracker"
        axis = estimate(recording, recording.device, "tracker").axes["x"]
        assert axis.sign == f"known: {SENSORS[each].kind} readout"
        errors.append(np.sqrt(np.mean((axis.angle.read() - truth["angle_x"][0]) ** 2)))
    assert errors[1] < 1.3 * errors[0] + 1e-5


def test_a_reference_velocity_without_a_readout_is_tracked() -> None:
    recording, truth = driven(0, references=("velocity",))
    channels = {k: (c.read(), c.unit, c.sample_rate, c.start) for k, c in recording.channels.items() if k != "sense_x"}
    alone = Recording.from_arrays(channels, recording.device)
    assert default_estimator(alone, recording.device) == "tracker"
    angle = estimate(alone).axes["x"].angle.read()
    assert np.abs(angle - truth["angle_x"][0]).max() < 2e-3 * np.abs(angle).max()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ekf", "ukf"])
def test_filters_follow_a_velocity_and_refuse_an_acceleration(name: str) -> None:
    recording, truth = driven(1)
    angle = estimate(recording, recording.device, name).axes["x"].angle.read()
    assert np.abs(angle - truth["angle_x"][0])[1000:].max() < 0.02 * np.abs(angle).max()
    recording, _ = driven(2)
    with pytest.raises(DeviceInvalid, match="choose the tracker"):
        estimate(recording, recording.device, name)


@pytest.mark.parametrize("order", [1, 2])
def test_the_prediction_of_a_derivative_leaves_its_noise(order: int) -> None:
    recording, _ = driven(order, references=("angle",))
    predicted = predict(recording, recording.device)
    assert predicted["sense_x"].rmse == pytest.approx(0.01, rel=0.1)
    assert predicted["angle_x"].rmse < 2e-3 * np.std(predicted["angle_x"].measured)


@pytest.mark.parametrize("order", [1, 2])
def test_a_cubic_spring_acts_on_the_derivatives_as_on_the_angle(order: int) -> None:
    spring = {"cubic-stiffness": {"k3": 0.5 * 1e-10 * W**2}}
    recording, _ = driven(order, **spring)
    run, device = prepare_run(recording, recording.device), recording.device
    model, x = fit_start_only([run], device)
    assert np.std(run.outputs[0].data - model.outputs(x)[0][0]) < 0.012
    linear, x = fit_start_only([run], bench(SENSORS[order]))
    assert np.std(run.outputs[0].data - linear.outputs(x)[0][0]) > 0.03


def test_units_of_derivatives_are_converted_and_others_refused() -> None:
    made = Recording.from_arrays(
        {"velocity_x": (np.ones(9), "deg/s", 10.0), "acceleration_x": (np.ones(9), "rad/s^2", 10.0)}
    )
    assert made["velocity_x"].read()[0] == pytest.approx(np.pi / 180)
    assert made["acceleration_x"].unit == "rad/s2"
    with pytest.raises(UnitUnknown, match="m/s"):
        Recording.from_arrays({"velocity_x": (np.ones(9), "m/s", 10.0)})


def test_one_sensor_of_the_motion_reads_one_axis() -> None:
    axes = {"x": bench(SENSORS[0]).axes["x"], "y": replace(bench(SENSORS[0]).axes["x"], name="y")}
    shared = Device("shared", axes, readout=SENSORS[1])
    with pytest.raises(BadInput, match="a velocity sensor reads one axis"):
        simulate(shared, Plan({"x": Sine(1003.0, 8.0), "y": Sine(900.0, 8.0)}, 0.01, 1e5))
