"""Phases from the picture: scans without a sense signal, or with a poor one, become sharp."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from estimation.estimate import default_estimator, estimate
from estimation.tracker import PhaseMeasurement, track
from estimation.tracker.averaged_dynamics import axis_parameters
from estimation.tracker.drive_only import NO_READOUT, drive_only_observations, track_drive_only
from estimation.tracker.steady_motion import find_steady_motion
from phantoms.experiment import Experiment, simulate_experiment
from phantoms.forward import Plan, simulate
from phantoms.waveforms import Sine
from recon.evaluation import evaluate_axis, truth_from_simulation
from recon.imaging.picture import Grid
from recon.imaging.scan_phase.image_phase import end_of_rounds, keep_determined, refine_motion
from recon.pipeline import reconstruct
from recon.steps.reconstruction import Options, Reconstruction
from scanner import devices
from scanner.errors import BadInput, ChannelMissing
from scanner.motion import Motion
from scanner.recording import Recording
from tests.support.simulated import DRIVES, shared_electrode

GRID = Grid(200, 200, 0.18, 0.18)
DURATION_S, SAMPLE_RATE_HZ = 0.03, 2.5e6


@cache
def scan() -> tuple[Recording, dict]:
    """A scan of tissue. x softens and y stiffens, so that their phases change by 3 degrees in opposite directions."""
    drift = {"x": -0.0012, "y": 0.0015}
    return simulate_experiment(
        Experiment(duration=DURATION_S, sample_rate=SAMPLE_RATE_HZ, drift=drift, drift_tau=0.01), seed=3
    )


def without(recording: Recording, *names: str, **changed: np.ndarray) -> Recording:
    channels = {k: (c.read(), c.unit, c.sample_rate, c.start) for k, c in recording.channels.items() if k not in names}
    for name, values in changed.items():
        channels[name] = (values, *channels[name][1:])
    return Recording.from_arrays(channels, recording.device)


@cache
def reconstructed_without_sense() -> Reconstruction:
    recording, truth = scan()
    return reconstruct(
        without(recording, "sense"), Options(pixels=(200, 200)), truth_from_simulation(truth), quiet=True
    )


def rmse(motion: Motion, truth: dict) -> dict[str, float]:
    """Phase error of each axis [deg]."""
    angles = truth_from_simulation(truth).angles
    return {name: np.rad2deg(evaluate_axis(axis, *angles[name]).phase_rmse) for name, axis in motion.axes.items()}


# --- from the drive alone


def test_the_drive_alone_determines_a_motion_without_drift() -> None:
    recording, truth = simulate(devices.load("imaging"), Plan(DRIVES, 0.006, SAMPLE_RATE_HZ, settle=0.2))
    motion = track_drive_only(recording, recording.device)
    for name, axis in motion.axes.items():
        error = evaluate_axis(axis, *truth_from_simulation(truth).angles[name])
        assert np.rad2deg(error.phase_rmse) < 0.02
        assert np.abs(error.amplitude).max() < 1e-3
        assert np.rad2deg(axis.phase_sd.min()) > 3.0  # 0.3 % of the resonance are degrees of phase
        assert axis.sign == "ambiguous"


@pytest.mark.parametrize("name", ["x", "y"])
def test_derivatives_of_the_steady_motion_equal_finite_differences(name: str) -> None:
    recording, _ = shared_electrode()
    device = recording.device
    steady_motion = find_steady_motion(drive_only_observations(recording, device, name))
    mechanics, step = device.axis(name).require_mechanics(), 1e-5

    def at(**relative: float) -> np.ndarray:
        changed = replace(mechanics, **{key: getattr(mechanics, key) * (1 + by) for key, by in relative.items()})
        axes = {**device.axes, name: replace(device.axis(name), mechanics=changed)}
        prepared = drive_only_observations(recording, replace(device, axes=axes), name)
        assert prepared.parameters[0] == axis_parameters(axes[name], NO_READOUT)
        return np.array(find_steady_motion(prepared)[:2])

    for column, key in enumerate("kb"):
        slope = (at(**{key: step}) - at(**{key: -step})) / (2 * step)
        assert steady_motion.by_parameters[:, column] == pytest.approx(
            slope, rel=2e-3, abs=1e-3 * np.abs(steady_motion.by_parameters).max()
        )


def test_a_drive_is_needed_and_must_sustain_a_motion() -> None:
    recording, _ = shared_electrode()
    with pytest.raises(ChannelMissing, match="drive_y"):
        track_drive_only(without(recording, "sense", "drive_y"), recording.device)
    weak, _ = simulate(devices.load("imaging"), Plan({**DRIVES, "y": Sine(6540.0, 3.0, 3.0)}, 0.006, settle=0.001))
    with pytest.raises(BadInput, match="sustains no motion of axis y"):
        track_drive_only(weak, weak.device)


def _phases_of_x(time: list[float], change: list[float], sd: float) -> dict[str, PhaseMeasurement]:
    """Measured phases of x that differ by ``change`` [rad] from the steady motion."""
    recording, _ = scan()
    axis = track_drive_only(recording, recording.device).axes["x"]
    phase = np.interp(time, axis.time, axis.phase) + change
    return {"x": PhaseMeasurement(np.array(time), phase, np.full(len(time), sd))}


def test_a_smoothed_motion_that_diverges_is_not_used() -> None:
    recording, _ = scan()
    phases = _phases_of_x([0.0045, 0.0191, 0.0198], [0.72, -0.72, 3.08], 0.088)  # one of four drifts diverges
    axis = track_drive_only(recording, recording.device, phases).axes["x"]
    assert np.isfinite(axis.phase).all()
    assert 0.0 < axis.amplitude.min() < axis.amplitude.max() < 1.0
    phases = _phases_of_x([0.0013, 0.0191, 0.021, 0.0211], [0.69, -2.64, -1.57, 0.46], 0.0015)  # all four do
    with pytest.raises(BadInput, match="no motion of axis x under this drive has the phases"):
        track_drive_only(recording, recording.device, phases)


def test_the_channels_determine_the_default_estimator() -> None:
    recording, _ = scan()
    device = recording.device
    assert default_estimator(recording, device) == "tracker"
    assert default_estimator(without(recording, "sense"), device) == "picture"
    assert default_estimator(without(recording, "sense", "intensity"), device) == "sensor"
    assert default_estimator(without(recording, "sense", "drive_x"), device) == "sensor"


# --- from the picture


@pytest.mark.slow
def test_a_scan_without_a_sense_signal_is_sharp() -> None:
    result = reconstructed_without_sense()
    assert result.motion.estimator == "picture"
    before = rmse(estimate(without(scan()[0], "sense"), method="picture"), scan()[1])
    for name, axis in result.motion.axes.items():
        error = result.evaluation[name]
        assert before[name] > 1.5
        assert np.rad2deg(error.phase_rmse) < 0.15
        sd = np.interp(error.time, axis.time, axis.phase_sd)
        assert np.mean(np.abs(error.phase) < 3 * sd) > 0.95
        assert np.rad2deg(np.median(sd)) < 0.15
    assert sum("measured in the picture" in note for note in result.notes) == 2


def test_a_featureless_sample_is_reported_to_determine_no_phase() -> None:
    recording, _ = scan()
    grey = np.random.default_rng(0).poisson(500.0, recording["intensity"].size).astype(float)
    result = reconstruct(without(recording, "sense", intensity=grey), Options(pixels=(200, 200)), quiet=True)
    assert result.motion.info["picture"]["determined"] == {"x": 0, "y": 0}
    assert sum("shows nothing of the phase" in note for note in result.notes) == 2
    for axis in result.motion.axes.values():
        assert np.rad2deg(axis.phase_sd.min()) > 3.0


@pytest.mark.slow
def test_bars_determine_only_the_phase_across_them() -> None:
    recording, truth = scan()
    s = truth_from_simulation(truth).angles["x"][0] / 0.18
    chirp = np.sin(40 * s + 25 * s**2)  # equal bars would be ambiguous by one period
    bars = 500.0 + 300.0 * chirp + np.random.default_rng(1).normal(0, 10, s.size)
    field = without(recording, "sense", intensity=bars)
    motion, notes = refine_motion(
        field, field.device, track_drive_only(field, field.device), field["intensity"], GRID, {}
    )
    assert rmse(motion, truth)["x"] < 0.15
    assert motion.info["picture"]["determined"]["y"] == 0  # type: ignore[index]
    assert any("nothing of the phase of y" in note for note in notes)


@pytest.mark.slow
def test_the_picture_improves_a_poor_sense_signal_and_does_not_change_a_good_one() -> None:
    recording, truth = scan()
    device, intensity = recording.device, recording["intensity"]
    good = track(recording, device)
    assert refine_motion(recording, device, good, intensity, GRID, {})[0] is good
    noise = np.random.default_rng(2).normal(0.0, 1.0, recording["sense"].size)
    poor = without(recording, sense=recording["sense"].read() + noise)
    alone = track(poor, device)
    refined, _ = refine_motion(poor, device, alone, intensity, GRID, {})
    before, after = rmse(alone, truth), rmse(refined, truth)
    for name in "xy":
        assert after[name] < 0.5 * before[name]
        assert after[name] < 0.15


def test_rounds_do_not_alternate_where_a_slice_is_hardly_determined() -> None:
    # About the improved motion the picture does not determine the last slice of y; about a motion without it, it does.
    drift = {"x": 0.00183, "y": -0.00168}
    recording, truth = simulate_experiment(
        Experiment(target="cell", duration=0.02, sample_rate=SAMPLE_RATE_HZ, drift=drift, drift_tau=0.01), seed=104
    )
    noise = np.random.default_rng(0).normal(0.0, 1.0, recording["sense"].size)
    poor = without(recording, sense=recording["sense"].read() + noise)
    motion, _ = refine_motion(poor, poor.device, track(poor, poor.device), poor["intensity"], GRID, {})
    assert max(rmse(motion, truth).values()) < 0.15
    assert motion.info["picture"]["rounds"] < 6  # type: ignore[index]


def test_an_undetermined_slice_keeps_its_earlier_measurement() -> None:
    time = np.array([1.0, 2.0])
    earlier = PhaseMeasurement(time, np.array([0.1, 0.2]), np.array([0.01, 0.02]))
    found = PhaseMeasurement(time, np.array([0.15, np.nan]), np.array([0.03, np.inf]))
    kept = keep_determined(earlier, found)
    np.testing.assert_array_equal(kept.phase, [0.15, 0.2])
    np.testing.assert_array_equal(kept.sd, [0.03, 0.02])
    other = PhaseMeasurement(time[:1], found.phase[1:], found.sd[1:])
    assert keep_determined(earlier, other) is other


def test_rounds_end_where_two_motions_alternate_with_the_smaller_stated_error() -> None:
    recording, _ = shared_electrode()
    start = track(recording, recording.device)

    def moved(by: float, sd: float) -> Motion:
        axes = {
            name: replace(axis, phase=axis.phase + by, phase_sd=np.full(axis.time.size, sd))
            for name, axis in start.axes.items()
        }
        return replace(start, axes=axes)

    first, second, third = moved(0.0, 0.01), moved(0.1, 0.02), moved(1e-4, 0.01)
    assert end_of_rounds(first, second, third, "xy") == (True, third)
    assert end_of_rounds(second, third, second, "xy") == (True, third)
    assert end_of_rounds(moved(-0.1, 0.01), second, third, "xy") == (False, third)  # still moving
    assert end_of_rounds(second, first, third, "xy") == (True, third)  # converged


def test_a_flipped_axis_has_the_same_phase_plus_pi() -> None:
    recording, _ = simulate_experiment(Experiment(duration=0.01, sample_rate=SAMPLE_RATE_HZ), seed=4)
    silent = without(recording, "sense")
    device, intensity = silent.device, silent["intensity"]
    motions = [
        refine_motion(silent, device, estimate(silent, device, "picture", flips), intensity, GRID, flips)[0]
        for flips in ({}, {"x": True})
    ]
    plain, flipped = (motion.axes["x"] for motion in motions)
    assert np.allclose(flipped.phase - plain.phase, np.pi, atol=1e-3)
    assert np.allclose(flipped.angle.read(), -plain.angle.read(), atol=1e-4)


def test_phases_refer_to_the_drive_behind_its_lag() -> None:
    plain = devices.load("imaging")
    lagging = {n: replace(a, terms={"drive-lag": {"f_c": 1.5e5}}) for n, a in plain.axes.items()}
    device = replace(plain, axes=lagging)
    recording, truth = simulate_experiment(
        Experiment(device=device, duration=0.01, sample_rate=SAMPLE_RATE_HZ, drift={}), seed=5
    )
    silent = without(recording, "sense")
    motion, _ = refine_motion(silent, device, estimate(silent, device, "picture"), silent["intensity"], GRID, {})
    assert max(rmse(motion, truth).values()) < 0.2  # the lag is 5 degrees of the phase of x
