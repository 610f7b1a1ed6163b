"""The tracker: its dynamics compared with the averaged equations, its tracks with the true motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation.estimate import estimate
from estimation.tracker import PhaseMeasurement, track
from estimation.tracker.angle_synthesis import SEGMENT_SAMPLES, PhasorAngle
from estimation.tracker.averaged_dynamics import average_cycle, axis_parameters
from phantoms.forward import InitialState, Plan, simulate
from phantoms.waveforms import Constant, Sequence, Sine
from recon.imaging.gridding import accumulate_samples
from recon.imaging.phasor_gridding import accumulate_phasors
from recon.imaging.picture import Grid
from scanner import devices
from scanner.device import Axis, Device
from scanner.drift import Drift, exponential
from scanner.errors import BadInput
from scanner.parametric import sine_drive, slow_flow, steady_state
from scanner.recording import Recording
from scanner.stages import Drive, Mechanics, Position
from tests.support.simulated import (
    DRIVES,
    noisy,
    own_electrodes,
    quiet,
    separate_electrodes,
    shared_electrode,
    with_sense,
)
from tests.support.tracks import track_errors

RATE = 5e6


# --- averaged dynamics


@pytest.mark.parametrize("name", ["x", "y"])
@settings(max_examples=20, deadline=None)
@given(amplitude=st.floats(0.02, 0.3), phase=st.floats(-3.0, 3.0))
def test_rates_agree_with_the_averaged_equations(name: str, amplitude: float, phase: float) -> None:
    device = devices.load("imaging")
    axis, drive = device.axis(name), DRIVES[name]
    assert device.readout is not None
    m, w = axis.require_mechanics(), np.pi * drive.frequency
    force = np.array([1350.0, -1800j, -450.0, 0.0])  # of (30 + 30 sin)^2
    law = axis_parameters(axis, device.readout)
    cycle = average_cycle(law, amplitude, phase, w, m.k, m.b, force)
    rate_a, rate_p = slow_flow(axis, sine_drive(drive.frequency, 30.0, 30.0), amplitude, phase)
    scale = 0.01 * w / axis.quality  # the averaged equations leave the motion's own harmonics out
    assert abs(cycle.rate - (rate_a / amplitude + 1j * rate_p)) < scale
    step = 1e-5
    by_phase = (
        average_cycle(law, amplitude, phase + step, w, m.k, m.b, force).rate
        - average_cycle(law, amplitude, phase - step, w, m.k, m.b, force).rate
    ) / (2 * step)
    by_log = (
        average_cycle(law, amplitude * np.exp(step), phase, w, m.k, m.b, force).rate
        - average_cycle(law, amplitude * np.exp(-step), phase, w, m.k, m.b, force).rate
    ) / (2 * step)
    # by_phase omits the derivative of the term J r' / (2 i w J + b), with r' = by_phase Im r + by_log Re r.
    # Under a parametric drive the rates depend on the phase as exp(-2 i phi), so that a derivative doubles them.
    rates = [average_cycle(law, amplitude, p, w, m.k, m.b, force) for p in np.linspace(0.0, np.pi, 16, endpoint=False)]
    slope, rate = max(abs(r.by_phase) for r in rates), max(abs(r.rate) for r in rates)
    assert abs(cycle.by_phase - by_phase) < (2.0 * slope * rate + slope**2) / (2.0 * w)
    assert abs(cycle.by_log - by_log) < 0.02 * scale / 0.01


def test_harmonics_of_the_motion_agree_with_the_integrated_motion() -> None:
    _, truth = shared_electrode(0.012, 0.0)
    device = devices.load("imaging")
    for name in "xy":
        axis, f = device.axis(name), 0.5 * DRIVES[name].frequency
        result = steady_state(axis, sine_drive(2 * f, 30.0, 30.0))
        assert result is not None
        assert device.readout is not None
        m = axis.require_mechanics()
        force = np.array([1350.0, -1800j, -450.0, 0.0])
        cycle = average_cycle(
            axis_parameters(axis, device.readout), result[0], result[1], 2 * np.pi * f, m.k, m.b, force
        )
        angle = truth[f"angle_{name}"][0].astype(float)[: round(0.01 * RATE)]
        psi = 2 * np.pi * f * np.arange(angle.size) / RATE
        columns = [part(n * psi) for n in (1, 3, 5) for part in (np.cos, np.sin)]
        fitted = np.linalg.lstsq(np.array(columns).T, angle, rcond=None)[0]
        third = (fitted[2] - 1j * fitted[3]) * np.exp(-3j * (np.angle(fitted[0] - 1j * fitted[1]) + np.pi / 2))
        assert abs(third - cycle.motion_harmonics[3]) < 0.02 * abs(cycle.motion_harmonics[3])


# --- tracks


def test_model_error_is_below_two_thousandths_of_a_degree() -> None:
    rng = np.random.default_rng(0)
    recording = with_sense(quiet()[0], lambda y: y + rng.normal(0.0, 1e-3, y.size), devices.load("imaging"))
    motion = estimate(recording, None, "tracker")
    assert motion.info["sense"]["mean_squared_innovation"] < 1.3  # type: ignore[index]
    for name, axis in motion.axes.items():
        phase, log = track_errors(axis, quiet()[1][f"angle_{name}"][0])
        assert np.rad2deg(np.sqrt(np.mean(phase[1:-1] ** 2))) < 2e-3
        assert np.abs(log[1:-1]).max() < 1e-3


def test_phase_error_on_a_shared_electrode_is_below_three_hundredths_of_a_degree() -> None:
    motion = estimate(noisy(1), None, "tracker")
    for name, axis in motion.axes.items():
        phase, log = track_errors(axis, quiet()[1][f"angle_{name}"][0])
        assert np.rad2deg(np.sqrt(np.mean(phase**2))) < 0.03
        assert np.std(log) < 5e-4
        angle = quiet()[1][f"angle_{name}"][0]
        miss = np.minimum(np.abs(axis.angle.read() - angle).max(), np.abs(axis.angle.read() + angle).max())
        assert miss < 3e-3 * axis.amplitude.mean()
        assert axis.sign == "ambiguous"


def test_95_percent_intervals_cover_the_truth() -> None:
    device, covered = devices.load("imaging"), []
    for seed in range(12):
        motion = track(noisy(seed), device)
        for name, axis in motion.axes.items():
            phase, _ = track_errors(axis, quiet()[1][f"angle_{name}"][0])
            covered.append(np.abs(phase) < 1.96 * axis.phase_sd)
    assert 0.92 < np.mean(covered) < 0.985


def test_smoother_has_a_smaller_error_than_the_filter() -> None:
    device = devices.load("imaging")
    later, causal = track(noisy(3), device), track(noisy(3), device, causal=True)
    assert causal.estimator == "tracker-causal"
    for name in "xy":
        angle = quiet()[1][f"angle_{name}"][0]
        rms = [np.sqrt(np.mean(track_errors(m.axes[name], angle)[0] ** 2)) for m in (later, causal)]
        assert rms[0] < rms[1] < np.deg2rad(0.08)
    # at the last block both use all samples
    assert later.axes["x"].phase[-1] == pytest.approx(causal.axes["x"].phase[-1], abs=1e-12)


def test_calibration_errors_do_not_increase_the_phase_error() -> None:
    device = devices.load("imaging")
    off = {
        n: replace(a, mechanics=replace(a.require_mechanics(), k=1.001 * a.mechanics.k, b=1.05 * a.mechanics.b))
        for n, a in device.axes.items()
        if a.mechanics
    }
    motion = track(noisy(4), replace(device, axes=off))
    for name, axis in motion.axes.items():
        phase, _ = track_errors(axis, quiet()[1][f"angle_{name}"][0])
        assert np.rad2deg(np.sqrt(np.mean(phase**2))) < 0.015


def test_uncertainty_grows_in_a_gap_and_covers_the_error() -> None:
    def gap(y: np.ndarray) -> np.ndarray:
        y[60_000:90_000] = np.nan
        return y

    motion = track(with_sense(noisy(5), gap), devices.load("imaging"))
    for name, axis in motion.axes.items():
        phase, _ = track_errors(axis, quiet()[1][f"angle_{name}"][0])
        inside = (axis.time > 0.012) & (axis.time < 0.018)
        assert np.abs(phase[inside]).max() < np.deg2rad(0.15)
        assert axis.phase_sd[inside].max() > 1.5 * np.median(axis.phase_sd[~inside])
        assert np.mean(np.abs(phase) < 3 * axis.phase_sd) > 0.97


def test_phases_from_the_picture_reduce_the_uncertainty_in_a_gap() -> None:
    def gap(y: np.ndarray) -> np.ndarray:
        y[50_000:110_000] = np.nan
        return y

    device, recording = devices.load("imaging"), with_sense(noisy(9), gap)
    alone = track(recording, device)
    whole = track(noisy(9), device)
    time = np.linspace(0.0105, 0.0215, 12)
    measurements = {}
    for name, axis in whole.axes.items():
        phase = np.interp(time, axis.time, axis.phase)
        phase[3] = np.nan  # a slice without a measurement
        measurements[name] = PhaseMeasurement(time, phase, np.full(12, np.deg2rad(0.02)))
    combined = track(recording, device, phases=measurements)
    for name in "xy":
        inside = (whole.axes[name].time > 0.0105) & (whole.axes[name].time < 0.0215)
        assert combined.axes[name].phase_sd[inside].max() < 0.7 * alone.axes[name].phase_sd[inside].max()
        phase, _ = track_errors(combined.axes[name], quiet()[1][f"angle_{name}"][0])
        assert np.rad2deg(np.abs(phase).max()) < 0.1


def test_clipped_peaks_do_not_increase_the_phase_error() -> None:
    motion = track(with_sense(noisy(6), lambda y: np.clip(y, *np.quantile(y, [0.15, 0.85]))), devices.load("imaging"))
    assert motion.info["sense"]["used"] < 0.85  # type: ignore[index]
    for name, axis in motion.axes.items():
        phase, _ = track_errors(axis, quiet()[1][f"angle_{name}"][0])
        assert np.rad2deg(np.sqrt(np.mean(phase**2))) < 0.05


def test_axes_on_separate_electrodes() -> None:
    recording, truth = separate_electrodes()
    motion = estimate(recording, own_electrodes(), "tracker")
    for name, axis in motion.axes.items():
        phase, _ = track_errors(axis, truth[f"angle_{name}"][0])
        assert np.rad2deg(np.sqrt(np.mean(phase**2))) < 0.03


def test_the_first_angles_are_right_where_no_drive_was_recorded() -> None:
    recording, truth = separate_electrodes()
    senses = {n: (c.read(), c.unit, c.sample_rate, c.start) for n, c in recording.channels.items() if "sense" in n}
    motion = track(Recording.from_arrays(senses, own_electrodes()), own_electrodes())
    for name, axis in motion.axes.items():
        true = truth[f"angle_{name}"][0]
        error = np.minimum(np.abs(axis.angle.read() - true), np.abs(axis.angle.read() + true))
        first = error[: round(5e-4 * RATE)]
        assert first.max() < 0.01 * np.abs(true).max()  # with the constants of a free decay: 0.09


def test_sign_follows_from_combs_that_are_off_centre() -> None:
    device = devices.load("imaging")
    axes = {n: replace(a, capacitance=replace(a.require_capacitance(), theta_th=0.004)) for n, a in device.axes.items()}
    device = replace(device, axes=axes)
    recording, truth = simulate(device, Plan(DRIVES, 0.01))
    motion = track(recording, device)
    for name, axis in motion.axes.items():
        assert axis.sign == "known: the combs' offset theta_th"
        angle = truth[f"angle_{name}"][0]
        assert np.corrcoef(axis.angle.read(), angle)[0, 1] > 0.999
        assert np.allclose(axis.angle.negated().read(), -axis.angle.read(), atol=1e-12)


def test_drive_that_stops_and_starts() -> None:
    device = own_electrodes()
    device = replace(device, axes={"x": device.axis("x")}, scan=None)
    drive = Sequence(((DRIVES["x"], 0.01), (Constant(0.0), 0.004), (DRIVES["x"], 0.016)))
    recording, truth = simulate(device, Plan({"x": drive}, 0.03))
    axis = track(recording, device).axes["x"]
    angle = truth["angle_x"][0]
    miss = axis.angle.read() - angle
    if np.abs(miss).max() > np.abs(angle).max():
        miss = axis.angle.read() + angle
    assert np.abs(miss).max() < 0.01 * np.abs(angle).max()  # where the drive stops and starts
    on = np.arange(angle.size) / RATE < 0.009
    assert np.abs(miss[on]).max() < 2e-3 * np.abs(angle).max()


def test_free_decay_with_a_transimpedance_readout() -> None:
    device = devices.load("chen2019")
    plan = Plan({"x": Constant(10.0)}, 0.06, sample_rate=5e5, sense_range=20.0)
    recording, truth = simulate(device, plan, start={"x": InitialState(0.15, 0.0)})
    channels = {
        "sense_x": (recording["sense_x"].read(), "V", 5e5, 0.0),
        "bias_x": (np.full(recording["sense_x"].size, 10.0), "V", 5e5, 0.0),
    }
    axis = track(Recording.from_arrays(channels, device), device).axes["x"]
    assert axis.reference == "absolute"
    angle = truth["angle_x"][0]
    assert np.sqrt(np.mean((axis.angle.read() - angle) ** 2)) < 5e-3 * np.sqrt(np.mean(angle**2))


def test_position_readout_and_linear_drive() -> None:
    axis = devices.load("chen2020-driven").axis("x")
    axis = replace(axis, drive=Drive("linear", 1e-9), readout=Position(gain=10.0, noise_sd=0.01), capacitance=None)
    device = Device("linear", {"x": axis})
    plan = Plan({"x": Sine(15500.0, 10.0)}, 0.02, 1e6, settle=0.02, drift={"x": Drift(exponential(-0.002, 0.025))})
    recording, truth = simulate(device, plan)
    result = track(recording, device).axes["x"]
    assert result.sign == "known: position readout"
    angle = truth["angle_x"][0]
    assert np.sqrt(np.mean((result.angle.read() - angle) ** 2)) < 2e-3 * np.abs(angle).max()


def test_a_slow_decay_does_not_hide_a_turn_of_the_phase() -> None:
    """The amplitude falls to a tenth and grows again with the opposite phase, far faster than the decay of 67 ms."""
    mechanics = Mechanics(J=1e-10, b=2.998e-9, k=1.579e-2)
    axis = Axis(mechanics, name="x", drive=Drive("linear", 1e-6), readout=Position(gain=20.0, noise_sd=2e-3))
    device = Device("high Q", {"x": axis})
    recording, truth = simulate(
        device, Plan({"x": Sine(2000.0, 3.22)}, 0.06, 2e5), start={"x": InitialState(0.025, 0.0)}
    )
    result = track(recording, device).axes["x"]
    assert result.amplitude.min() < 0.1 * result.amplitude.max()
    error = result.angle.read() - truth["angle_x"][0]
    assert np.sqrt(np.mean(error**2)) < 5e-3 * result.amplitude.max()


# --- the angle


def test_angle_of_a_part_equals_the_part_of_the_angle() -> None:
    axis = track(noisy(7), devices.load("imaging")).axes["x"]
    whole = axis.angle.read()
    assert whole.size == axis.angle.size == 150_000
    for first, stop in ((0, 1), (3, 3 + SEGMENT_SAMPLES), (1_234, 77_777), (149_990, 150_000)):
        assert np.allclose(axis.angle.read(first, stop), whole[first:stop], rtol=0.0, atol=2e-7)


def test_angle_equals_the_sum_of_its_harmonics() -> None:
    axis = track(noisy(7), devices.load("imaging")).axes["y"]
    assert isinstance(axis.angle, PhasorAngle)
    time = np.arange(axis.angle.size) / RATE
    phase, lines = axis.angle.motion.at(time)
    direct = (lines * np.exp(1j * phase[:, None] * np.array([1, 3, 5]))).real.sum(axis=1)
    assert np.abs(axis.angle.read() - direct).max() < 1e-7


def test_gridding_from_phasors_equals_gridding_from_angles() -> None:
    motion = track(noisy(7), devices.load("imaging"))
    x, y = motion.axes["x"].angle, motion.axes["y"].angle
    assert isinstance(x, PhasorAngle)
    assert isinstance(y, PhasorAngle)
    intensity = np.random.default_rng(0).normal(size=x.size).astype(np.float32)
    intensity[1000:2000] = np.nan
    grid = Grid(400, 300, 0.18, 0.17)
    sums = counts = other_sums = other_counts = None
    for first, stop in ((0, 60_001), (60_001, x.size)):
        part = intensity[first:stop]
        sums, counts = accumulate_phasors(x, y, first, part, grid, sums, counts)
        angles = x.read(first, stop), y.read(first, stop)
        other_sums, other_counts = accumulate_samples(*angles, part, grid, other_sums, other_counts)
    assert counts is not None
    assert np.array_equal(counts, other_counts)
    assert np.allclose(sums, other_sums)
    assert 0 < counts.sum() < x.size - 1000
    with pytest.raises(BadInput, match="give one intensity for each angle"):
        accumulate_phasors(x, y, 1, intensity, grid)


# --- input that cannot be used


def test_signal_without_motion_is_refused() -> None:
    rng = np.random.default_rng(0)
    still = with_sense(shared_electrode()[0], lambda y: rng.normal(0.0, 0.014, y.size))
    with pytest.raises(BadInput, match="shows no motion of axis x"):
        track(still, devices.load("imaging"))


def test_signal_without_samples_is_refused() -> None:
    empty = with_sense(shared_electrode()[0], lambda y: np.full(y.size, np.nan))
    with pytest.raises(BadInput, match="no sample that can be used"):
        track(empty, devices.load("imaging"))


def test_constant_signal_is_refused() -> None:
    constant = with_sense(shared_electrode()[0], np.zeros_like)
    with pytest.raises(BadInput, match="is constant, 0 V"):
        track(constant, devices.load("imaging"))
