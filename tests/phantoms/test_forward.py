"""The forward simulation: accuracy of the integration, laws of the readouts, drifts, and agreement with the truth."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from phantoms.experiment import Experiment, simulate_experiment
from phantoms.forward import InitialState, Plan, settled_state, simulate, simulate_trajectory
from phantoms.optics import Detector
from phantoms.waveforms import Constant, Multisine, Sine
from scanner import devices
from scanner.device import Device
from scanner.drift import Drift, exponential
from scanner.errors import BadInput
from scanner.harmonics import capacitance_harmonics, readout_response
from scanner.laws import capacitance_slope
from scanner.lock_in import block_phasors
from scanner.stages import Drive, Position
from tests.support.simulated import DRIVES, imaging, own_electrodes, separate_electrodes, shared_electrode


def test_integration_error_is_below_a_tenth_of_the_noise() -> None:
    """Twice the number of steps changes the sense signal by less than a tenth of its noise."""
    device = devices.load("imaging")
    quiet = replace(device, readout=replace(device.readout, noise_var=0.0, bits=None))
    start = {"x": InitialState(0.19, 0.0), "y": InitialState(0.19, 0.0)}
    signals = []
    for substeps in (2, 4):
        plan = Plan(DRIVES, 0.004, substeps=substeps)
        signals.append(simulate(quiet, plan, start=start)[0]["sense"].read())
    assert np.abs(signals[0] - signals[1]).max() < 0.1 * device.readout.noise_sd
    assert np.ptp(signals[0]) > 100 * device.readout.noise_sd


def test_seed_changes_only_the_noise() -> None:
    first, again, other = (simulate_experiment(Experiment(duration=0.002), seed)[0] for seed in (3, 3, 4))
    assert np.array_equal(first["sense"].read(), again["sense"].read())
    assert np.array_equal(first["intensity"].read(), again["intensity"].read())
    differs = first["sense"].read() - other["sense"].read()
    sd = np.sqrt(2 * (1.92e-4 + (10 / 4096) ** 2 / 12))
    assert differs.std() == pytest.approx(sd, rel=0.03)
    assert abs(differs.mean()) < 5 * sd / np.sqrt(differs.size)


def test_shared_electrode_has_the_second_harmonics_of_both_axes() -> None:
    """Each second harmonic is multiplied by the response of the sections at its frequency."""
    recording, truth = shared_electrode(duration=0.006, drift=0.0)
    device = devices.load("imaging")
    for name, f in (("x", 13840.0), ("y", 3270.0)):
        n = round(5e6 * 15 / 3270.0)
        angle = truth[f"angle_{name}"][0][:n].astype(float)
        _, motion = block_phasors(angle, 5e6, 0.0, f, n)
        tc, line = block_phasors(recording["sense"].read(0, n), 5e6, 0.0, 2 * f, n)
        c2 = capacitance_harmonics(abs(motion[0]), device.axis(name).require_capacitance())[2]
        expected = c2 * readout_response(device.readout, 2 * f)
        assert abs(line[0]) == pytest.approx(abs(expected), rel=5e-3)
        # line = Im(Z e^..) and C = Re(c2 e^{2iu}): they differ by a quarter turn
        turn = np.angle(line[0] * -1j / (expected * np.exp(2j * np.angle(motion[0]))))
        assert abs(turn) < 0.01
        assert tc[0] > 0


def test_transimpedance_signal_is_proportional_to_the_rate_of_capacitance() -> None:
    device = devices.load("chen2019")
    axis = device.axis("x")
    quiet = replace(device, axes={"x": replace(axis, readout=replace(axis.require_readout(), noise_sd=0.0, bits=None))})
    plan = Plan({"x": Constant(10.0)}, 0.004, sample_rate=5e5)
    recording, truth = simulate(quiet, plan, start={"x": InitialState(0.15, 0.0)})
    angle = truth["angle_x"][0].astype(float)
    comb = axis.require_capacitance()
    expected = -1e7 * 10.0 * capacitance_slope(angle, comb.C0, comb.theta0, comb.theta_th) * np.gradient(angle, 2e-6)
    assert np.abs(recording["sense_x"].read() - expected)[2:-2].max() < 2e-3 * np.abs(expected).max()


def test_response_of_a_linear_axis_is_its_transfer_function() -> None:
    axis = devices.load("chen2020-driven").axis("x")
    axis = replace(axis, drive=Drive("linear", 1e-9), readout=Position(gain=10.0, noise_sd=0.0), capacitance=None)
    f = 15_300.0
    plan = Plan({"x": Multisine((f,), (5.0,), (0.4,))}, 0.004, sample_rate=1e6, settle=0.05)
    recording, _ = simulate(Device("linear", {"x": axis}), plan)
    tc, z = block_phasors(recording["sense_x"].read(), 1e6, 0.0, f, 4000)
    m, s = axis.require_mechanics(), 2j * np.pi * f
    response = 10.0 * 1e-9 * 5.0 / (m.J * s**2 + m.b * s + m.k)
    assert z[0] * np.exp(-1j * (2 * np.pi * f * tc[0] + 0.4)) == pytest.approx(response, rel=1e-4)


@pytest.mark.parametrize(("rate", "duration"), [(1e6, 0.05), (1_000_033.0, 0.05), (1e6, 0.0300001)])
def test_a_simulation_in_pieces_is_that_of_the_whole(rate: float, duration: float) -> None:
    """Pieces of 10 ms join at whole samples at any rate; a free decay has no jump of its phase and no lost sample."""
    axis = devices.load("chen2020-driven").axis("x")
    axis = replace(axis, drive=Drive("linear", 1e-9), readout=Position(gain=1.0, noise_sd=0.0), capacitance=None)
    plan = Plan({"x": Constant(0.0)}, duration, rate, substeps=4)
    recording, _ = simulate(Device("linear", {"x": axis}), plan, start={"x": InitialState(0.1, 0.0)})
    m, time = axis.require_mechanics(), np.arange(round(duration * rate)) / rate
    loss = 0.5 * m.b / m.J
    w = np.sqrt(m.k / m.J - loss**2)
    decay = 0.1 * np.exp(-loss * time) * (np.cos(w * time) + loss / w * np.sin(w * time))
    np.testing.assert_allclose(recording["sense_x"].read(), decay, atol=1e-5)
    assert recording["drive_x"].size == time.size


@pytest.mark.parametrize(
    "terms", [{}, {"readout-lag": {"f_c": 2e4}}, {"channel-delay": {"delay": 2e-5}}], ids=["sections", "lag", "delay"]
)
def test_a_settled_signal_does_not_depend_on_where_the_recording_begins(terms: dict) -> None:
    """Low-pass sections and delays started anew: the first 20 us were up to half of the signal off."""
    device = devices.load("imaging")
    quiet = replace(device, readout=replace(device.readout, noise_var=0.0, bits=None))
    quiet = replace(quiet, axes=dict(quiet.axes) | {"x": replace(quiet.axis("x"), terms=terms)})
    signals = []
    for lead in (0.0, 3e-4):
        drives = {name: lambda t, drive=drive, lead=lead: drive(t - lead) for name, drive in DRIVES.items()}
        plan = Plan(drives, 2e-4 + lead, settle=0.01 - lead)
        signals.append(simulate(quiet, plan)[0]["sense"].read()[-1000:])
    assert np.abs(signals[0] - signals[1]).max() < 1e-6 * np.ptp(signals[1])


def test_resonance_follows_the_drift_of_the_stiffness() -> None:
    device = devices.load("chen2020-driven")
    axis = device.axis("x")
    free = replace(axis, mechanics=replace(axis.require_mechanics(), b=1e-18))
    plan = Plan({"x": Constant(0.0)}, 0.02, drift={"x": Drift(stiffness=exponential(-0.004, 1e-4))})
    angle = simulate_trajectory(free, plan, InitialState(0.1, 0.0), 0.0, 0.02).angle
    tc, z = block_phasors(angle, 1e7, 0.0, axis.resonance, 20_000)
    slope = np.diff(np.unwrap(np.angle(z * np.exp(-2j * np.pi * axis.resonance * tc))))[3:].mean() / 2e-3 / (2 * np.pi)
    assert slope / axis.resonance == pytest.approx(np.sqrt(1 - 0.004) - 1, rel=2e-3)


def test_amplitude_drifts_with_damping_and_drive() -> None:
    axis = devices.load("chen2020-driven").axis("x")
    drives = {"x": Sine(31400.0, 30.0, 30.0)}
    steady = Plan(drives, 0.02, settle=0.02)
    start = settled_state(axis, steady)
    swings = {}
    drifts = {
        "none": Drift(),
        "damping": Drift(damping=exponential(0.2, 2e-3)),
        "drive": Drift(drive=exponential(-0.05, 2e-3)),
    }
    for name, drift in drifts.items():
        angle = simulate_trajectory(axis, replace(steady, drift={"x": drift}), start, 0.0, 0.02).angle
        swings[name] = np.abs(angle[-10_000:]).max()
    assert swings["damping"] < swings["none"]
    assert swings["drive"] < swings["none"]


def test_drive_below_the_threshold_is_refused() -> None:
    plan = Plan({"x": Sine(31200.0, 30.0, 30.0)}, 0.01)
    with pytest.raises(BadInput, match=r"drive_x: the drive does not sustain a motion"):
        simulate(devices.load("chen2020"), plan)


def test_intensity_is_the_scene_at_the_true_angles() -> None:
    recording, truth = imaging()
    intensity, scene = recording["intensity"].read(), truth["scene"]
    s = [truth[f"angle_{axis}"][0] / 0.18 for axis in "xy"]
    column, row = (np.clip((0.5 * 1600 * (v + 1)).astype(int), 0, 1599) for v in s)
    assert np.corrcoef(intensity, scene[row, column])[0, 1] > 0.99
    assert {"sense", "drive_x", "drive_y", "intensity"} == set(recording.channels)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"drift_tau": float("nan")}, "drift_tau: is nan and must be a number greater than 0"),
        ({"drift": {"x": float("nan")}}, "drift: is nan and must be a finite number"),
        ({"drift": {"y": -1.0}}, "drift: is -1; give a relative change above -1"),
        ({"drift": {"x": 1e14}}, "x: the simulated motion has diverged at"),
        ({"duration": 1e9}, r"1e\+09 s at 5e\+06 samples a second are 5e\+15 samples; simulate 1e\+08 at most"),
        ({"spot_um": 100.0}, "a standard deviation of 100 um is too wide for a field of 250 x 250 um; give 0.25"),
    ],
)
def test_senseless_experiments_are_refused(changes: dict, words: str) -> None:
    with pytest.raises(BadInput, match=words):
        simulate_experiment(Experiment(**{"duration": 0.001, "target": "siemens_star"} | changes))


def test_a_drive_or_a_detector_without_a_finite_number_is_refused() -> None:
    with pytest.raises(BadInput, match="offset: is inf and must be a finite number"):
        Sine(1000.0, 1.0, float("inf"))
    with pytest.raises(BadInput, match=r"photons_per_sample is 1e\+30; give at most 1e\+18"):
        Detector(photons_per_sample=1e30)


def test_a_long_settling_takes_no_more_memory() -> None:
    axis, peaks = devices.find("imaging").axis("x"), []
    for settle in (0.05, 1.0):
        tracemalloc.start()
        settled_state(axis, Plan({"x": DRIVES["x"]}, 0.01, 5e5, settle=settle))
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 2.0 * peaks[0]


def test_device_is_loaded_by_name() -> None:
    assert devices.find("chen2019").axis("x").resonance == pytest.approx(624.6, abs=0.1)
    with pytest.raises(BadInput, match="there are chen2019, chen2020, chen2020-driven, imaging"):
        devices.find("unheard-of")
    assert own_electrodes().readout is None
    assert {"sense_x", "sense_y"} <= set(separate_electrodes()[0].channels)


def test_nominal_device_may_differ_from_the_true_one() -> None:
    experiment = Experiment(duration=0.001)
    nominal = replace(experiment.device, name="as calibrated")
    recording, _ = simulate_experiment(experiment, nominal=nominal)
    assert recording.device == nominal
