"""The filters: agreement with filterpy, consistency of the uncertainty, accuracy on simulated recordings."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from estimation import estimate as registry
from estimation.estimate import estimate
from estimation.filters.fast_capacitance import TABLE_STEPS, fast_gaussian, gaussian_capacitance
from estimation.filters.filterpy_engine import (
    measurement_jacobian,
    predict_measurement,
    predict_state,
    run_filterpy,
    state_jacobian,
)
from estimation.filters.inputs import prepare_filter_inputs
from estimation.filters.model import axis_capacitance, axis_step
from estimation.filters.run import (
    PUBLISHED_ACCELERATION_VARIANCE,
    estimate_with_filter,
    process_noise_covariances,
    run_compiled,
    tune_torque_noise,
)
from phantoms.forward import InitialState, Plan, simulate
from phantoms.waveforms import Constant, Multisine, Sine
from recon.evaluation import evaluate_axis
from scanner import devices, laws
from scanner.arrays import Array
from scanner.device import Device
from scanner.errors import BadInput
from scanner.recording import Recording
from scanner.stages import Amdm, Drive, Position
from tests.support.simulated import separate_electrodes, shared_electrode

HEIGHTS = np.array([6e14, 6e12])


def ringdown() -> tuple[Recording, Device]:
    device = devices.load("chen2019")
    plan = Plan({"x": Constant(10.0)}, 0.03, sample_rate=5e5, sense_range=20.0)
    recording, _ = simulate(device, plan, start={"x": InitialState(0.15, 0.0)})
    bias = {"bias_x": (np.full(recording["sense_x"].size, 10.0), "V", 5e5, 0.0)}
    sense = {"sense_x": (recording["sense_x"].read(), "V", 5e5, 0.0)}
    return Recording.from_arrays(bias | sense, device), device


def position_scan() -> tuple[Recording, Device]:
    axis = devices.load("chen2020-driven").axis("x")
    axis = replace(axis, drive=Drive("linear", 1e-9), readout=Position(gain=10.0, noise_sd=0.01), capacitance=None)
    device = Device("linear", {"x": axis})
    plan = Plan({"x": Multisine((15500.0, 15400.0), (10.0, 3.0), (0.0, 1.0))}, 0.004, sample_rate=1e6, settle=0.01)
    return simulate(device, plan)[0], device


def no_sections(device: Device) -> Device:
    assert isinstance(device.readout, Amdm)
    return replace(device, readout=replace(device.readout, lpf_hz=()))


CASES = {
    "shared electrode, two sections": lambda: (shared_electrode()[0], devices.load("imaging")),
    "shared electrode, no section": lambda: (shared_electrode()[0], no_sections(devices.load("imaging"))),
    "own electrode": lambda: (separate_electrodes()[0], separate_electrodes()[0].device),
    "transimpedance ringdown": ringdown,
    "position, linear drive": position_scan,
}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ekf", "ukf"])
@pytest.mark.parametrize("case", CASES)
def test_compiled_filter_equals_filterpy(case: str, name: str) -> None:
    recording, device = CASES[case]()
    for problem in prepare_filter_inputs(recording, device):
        heights = tune_torque_noise(problem) if case.endswith("drive") else HEIGHTS[: len(problem.model.axes)]
        n = 600
        signal = problem.signal.copy()
        signal[200:230] = np.nan  # a gap: both engines only predict there
        problem = replace(problem, signal=signal)
        states, covariances = run_filterpy(problem, name, heights, n)
        compiled = run_compiled(problem, name, heights, n)
        swing = np.abs(states).max(axis=0)
        for a in range(len(problem.model.axes)):
            assert np.abs(compiled.theta[a] - states[:, 2 * a]).max() < 1e-9 * swing[2 * a]
            at = np.arange(1, compiled.track.shape[1] + 1) * compiled.stride
            assert np.abs(compiled.track[a, :, 0] - states[at, 2 * a + 1]).max() < 1e-9 * swing[2 * a + 1]
            for column, (i, j) in enumerate(((0, 0), (0, 1), (1, 1)), start=1):
                expected = covariances[at, 2 * a + i, 2 * a + j]
                assert np.allclose(
                    compiled.track[a, :, column], expected, rtol=1e-7, atol=1e-9 * np.abs(expected).max()
                )


@pytest.mark.slow
def test_compiled_ekf_equals_filterpy_over_a_whole_recording() -> None:
    recording, _ = separate_electrodes(duration=0.003)
    problem = prepare_filter_inputs(recording, recording.device)[0]
    states, _ = run_filterpy(problem, "ekf", HEIGHTS[:1])
    assert np.abs(run_compiled(problem, "ekf", HEIGHTS[:1]).theta[0] - states[:, 0]).max() < 1e-9


def test_likelihood_has_the_logarithms_of_all_innovation_variances() -> None:
    recording, _ = separate_electrodes(duration=0.003)
    problem = prepare_filter_inputs(recording, recording.device)[0]
    model, heights, v = problem.model, np.array([1e20]), problem.voltage
    q11, q12, q22 = process_noise_covariances(model, heights)[0]
    Q = np.diag([q11, q22, *[model.section_noise] * len(model.sections)])
    Q[0, 1] = Q[1, 0] = q12
    n, logs = 2000, []
    states, covariances = run_filterpy(problem, "ekf", heights, n)
    for i in range(1, n):
        F = state_jacobian(model, states[i - 1], v[:, i - 1], v[:, i])
        H = measurement_jacobian(model, predict_state(model, states[i - 1], v[:, i - 1], v[:, i]))
        logs.append(np.log((H @ (F @ covariances[i - 1] @ F.T + Q) @ H.T)[0, 0] + model.noise_var))
    assert np.sum(logs) - (n - 1) * np.log(model.noise_var) > np.log(
        1e150
    )  # beyond the product at which the logarithm is taken
    assert run_compiled(problem, "ekf", heights, n).logdet == pytest.approx(np.sum(logs), rel=1e-9)


def capacitance_curvature(theta: Array, C0: float, theta0: float, theta_th: float) -> Array:
    """Second derivative of the capacitance over the angle [F/rad2]."""
    u = (theta - theta_th) / theta0
    return (4.0 * u * u - 2.0) / theta0**2 * C0 * np.exp(-u * u)


@pytest.mark.parametrize("size", [1e-3, 0.3, 4.0])
def test_fast_capacitance_agrees_with_the_law_and_its_derivatives(size: float) -> None:
    C0, Cb, theta0, theta_th = 3e-12, 5e-12, 0.06, 0.004
    theta = theta_th + size * theta0 * np.random.default_rng(0).uniform(-1.0, 1.0, 5000)
    value, slope, curvature = np.array([gaussian_capacitance(t, C0, Cb, 1.0 / theta0, theta_th) for t in theta]).T
    assert np.allclose(value, laws.capacitance(theta, C0, Cb, theta0, theta_th), rtol=1e-15, atol=0.0)
    height = np.abs(value - Cb)
    for derivative, law, unit in (
        (slope, laws.capacitance_slope, height / theta0),
        (curvature, capacitance_curvature, height / theta0**2),
    ):
        assert np.abs(derivative - law(theta, C0, theta0, theta_th)).max() < 4e-15 * unit.max()


def test_fast_exponential_is_accurate_to_the_last_digits_and_passes_nan() -> None:
    v = np.linspace(-50.0, 50.0, 20_001)
    assert np.allclose([fast_gaussian(at) for at in v], np.exp(-((v / TABLE_STEPS) ** 2)), rtol=1.5e-15, atol=0.0)
    assert fast_gaussian(60.0) == 0.0
    assert np.isnan([fast_gaussian(np.nan), fast_gaussian(-np.nan), fast_gaussian(np.inf)]).all()


def test_jacobian_is_the_derivative_of_the_process() -> None:
    problem = prepare_filter_inputs(*CASES["shared electrode, two sections"]())[0]
    model, x, v = problem.model, problem.x, problem.voltage[:, 7]
    F = state_jacobian(model, x, v, v + 1.0)
    for j, scale in enumerate(np.sqrt(np.diag(problem.P)) * 1e-3):
        step = np.eye(model.states)[j] * scale
        numeric = (predict_state(model, x + step, v, v + 1.0) - predict_state(model, x - step, v, v + 1.0)) / (
            2 * scale
        )
        assert np.allclose(F[:, j], numeric, rtol=1e-5, atol=1e-6 * np.abs(F).max(axis=1))
    assert predict_measurement(model, x).shape == (1,)


def test_process_step_conserves_energy() -> None:
    """An Euler step would add a negative damping of omega^2 Ts / 2 = 950 1/s at 15.5 kHz and 5 MHz."""
    axis = devices.load("chen2020-driven").axis("x")
    device = Device("undamped", {"x": replace(axis, mechanics=replace(axis.require_mechanics(), b=1e-30))})
    parameters = prepare_parameters(device)
    theta, omega = 0.1, 0.0
    for _ in range(50_000):
        (theta, omega), *_ = axis_step(theta, omega, axis_capacitance(theta, *parameters), 0.0, 0.0, *parameters)
    w = 2 * np.pi * axis.resonance
    assert np.hypot(theta, omega / w) == pytest.approx(0.1, rel=1e-9)


def prepare_parameters(device: Device) -> list[float]:
    from estimation.filters.model import axis_parameters

    return axis_parameters(device.axis("x"), 2e-7, device.axis("x").require_readout())


def test_uncertainty_is_consistent_for_data_of_the_model() -> None:
    """For truth drawn from the filter's model, with torque noise, innovations and state errors obey chi-square."""
    recording, _ = separate_electrodes(duration=0.006, drift=0.0)
    problem = prepare_filter_inputs(recording, recording.device)[0]
    model, heights = problem.model, np.array([1e14])
    rng = np.random.default_rng(5)
    q11, q12, q22 = process_noise_covariances(model, heights)[0]
    assert q11 * q22 == pytest.approx(q12**2)
    n, runs, burn = 3000, 12, 500
    nees, innovations = [], []
    for _ in range(runs):
        x = problem.x + np.sqrt(np.diag(problem.P)) * rng.standard_normal(model.states)
        true, signal = np.empty((n, model.states)), np.empty(n)
        for i in range(n):
            if i:
                x = predict_state(model, x, problem.voltage[:, i - 1], problem.voltage[:, i])
                kick = np.sqrt(q22) * rng.standard_normal()
                x[:2] += kick * model.step / 2, kick
            true[i], signal[i] = x, predict_measurement(model, x)[0] + np.sqrt(model.noise_var) * rng.standard_normal()
        filtered = run_compiled(replace(problem, signal=signal, voltage=problem.voltage[:, :n]), "ekf", heights)
        innovations.append(filtered.chi2 / filtered.updates)
        at = np.arange(1, filtered.track.shape[1] + 1) * filtered.stride
        omega, p11, p12, p22 = filtered.track[0].T
        e = np.stack([filtered.theta[0, at] - true[at, 0], omega - true[at, 1]])
        square = (p22 * e[0] ** 2 - 2 * p12 * e[0] * e[1] + p11 * e[1] ** 2) / (p11 * p22 - p12**2)
        nees.append(square[at > burn].mean())
    low, high = stats.chi2.ppf([1e-3, 1 - 1e-3], runs * (n - 1)) / (runs * (n - 1))
    assert low < np.mean(innovations) < high
    # errors of neighbouring samples are correlated: the scatter of the runs gives the interval
    assert abs(np.mean(nees) - 2.0) < 4 * np.std(nees, ddof=1) / np.sqrt(runs)


@pytest.mark.slow
@pytest.mark.parametrize(("method", "most"), [("ekf", 0.2), ("ukf", 0.15)])
def test_drifting_axes_on_a_shared_electrode_are_tracked(method: str, most: float) -> None:
    recording, truth = shared_electrode(duration=0.03)
    motion = estimate_with_filter(recording, recording.device, method)
    for name, axis in motion.axes.items():
        values, attrs = truth[f"angle_{name}"]
        error = evaluate_axis(axis, values.astype(float), attrs["sample_rate"], attrs["start"])
        assert np.degrees(error.phase_rmse) < most
        assert np.abs(error.amplitude).max() < 0.01
        inside = np.abs(error.phase) < 1.96 * np.interp(error.time, axis.time, axis.phase_sd)
        assert inside.mean() > 0.95  # the mean over a block scatters less than an instant
        assert axis.sign == "ambiguous"
        assert axis.frequency.mean() == pytest.approx({"x": 13840.0, "y": 3270.0}[name], abs=1.0)


def test_tuned_process_noise_is_more_likely_than_the_published_one() -> None:
    recording, _ = shared_electrode(duration=0.03)
    problem = prepare_filter_inputs(recording, recording.device)[0]
    tuned = run_compiled(problem, "ekf", tune_torque_noise(problem)).log_likelihood
    assert tuned > run_compiled(problem, "ekf", np.full(2, PUBLISHED_ACCELERATION_VARIANCE)).log_likelihood + 1000


def test_constant_phase_and_model_alone_do_not_follow_a_drift() -> None:
    recording, truth = shared_electrode(duration=0.03)
    for method in ("constant", "acm"):
        motion = estimate(recording, None, method)
        for name, axis in motion.axes.items():
            values, attrs = truth[f"angle_{name}"]
            error = evaluate_axis(axis, values.astype(float), attrs["sample_rate"], attrs["start"])
            assert np.degrees(np.abs(error.phase[-1])) > 2.0
            assert np.degrees(np.abs(error.phase[0])) < 0.4


def test_axes_on_separate_electrodes_are_tracked() -> None:
    recording, truth = separate_electrodes()
    motion = estimate(recording, None, "ukf")
    assert list(motion.axes) == ["x", "y"]
    for name, axis in motion.axes.items():
        values, attrs = truth[f"angle_{name}"]
        assert np.degrees(evaluate_axis(axis, values.astype(float), attrs["sample_rate"], 0.0).phase_rmse) < 0.15


def test_sign_follows_from_the_offset_of_the_combs() -> None:
    device = devices.load("imaging")
    axes = {
        name: replace(axis, capacitance=replace(axis.require_capacitance(), theta_th=0.004))
        for name, axis in device.axes.items()
    }
    device = replace(device, axes=axes)
    plan = Plan({"x": Sine(27680.0, 30.0, 30.0), "y": Sine(6540.0, 30.0, 30.0)}, 0.006)
    kicks = {"x": InitialState(0.19, 0.0), "y": InitialState(-0.19, 0.0)}
    for signs in (1, -1):
        start = {name: replace(kick, angle=signs * kick.angle) for name, kick in kicks.items()}
        recording, truth = simulate(device, plan, start=start)
        for name, axis in estimate(recording, None, "ekf").axes.items():
            values, attrs = truth[f"angle_{name}"]
            assert axis.sign == "known: the combs' offset theta_th"
            assert not evaluate_axis(axis, values.astype(float), attrs["sample_rate"], 0.0).mirrored


def test_sign_follows_from_flip_option_and_angle_channel() -> None:
    recording, truth = shared_electrode()
    plain = estimate(recording, None, "ekf")
    flipped = estimate(recording, None, "ekf", {"x": True})
    assert flipped.axes["x"].sign == "known: --flip-x"
    assert np.allclose(flipped.axes["x"].angle.read(), -plain.axes["x"].angle.read())
    assert np.allclose(flipped.axes["y"].angle.read(), plain.axes["y"].angle.read())
    channels = {n: (c.read(), c.unit, c.sample_rate, c.start) for n, c in recording.channels.items()}
    for name in "xy":
        channels[f"angle_{name}"] = (truth[f"angle_{name}"][0], "rad", 5e6, 0.0)
    known = estimate(Recording.from_arrays(channels, recording.device), None, "ekf")
    for name in "xy":
        assert known.axes[name].sign == f"known: angle_{name}"
        assert np.corrcoef(known.axes[name].angle.read(), truth[f"angle_{name}"][0])[0, 1] > 0.99


def test_sensor_estimator_uses_position_readouts() -> None:
    recording, device = position_scan()
    axis = estimate(recording, device).axes["x"]
    assert axis.sign == "known: sense_x"
    assert np.allclose(axis.angle.read(), recording["sense_x"].read() / 10.0)
    assert abs(axis.phase[0]) <= np.pi


def test_error_of_an_unknown_estimator_lists_the_known_ones() -> None:
    recording, _ = shared_electrode()
    with pytest.raises(BadInput, match="no estimator is named 'kalman'; there are acm, constant, edges, ekf, hyb"):
        registry.estimate(recording, None, "kalman")


def test_signal_without_motion_is_refused() -> None:
    recording, _ = shared_electrode()
    channels = {n: (c.read(), c.unit, c.sample_rate, c.start) for n, c in recording.channels.items()}
    quiet = 0.5 + 0.014 * np.random.default_rng(0).standard_normal(recording["sense"].size)
    channels["sense"] = (quiet, "V", 5e6, 0.0)
    with pytest.raises(BadInput, match=r"sense: shows no motion of axis x at 13840 Hz"):
        estimate(Recording.from_arrays(channels, recording.device), None, "ukf")
