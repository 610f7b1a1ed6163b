"""Phases from the picture: a scan with no sense signal, or a poor one, comes out sharp; nothing to see is said."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from worlds import DRIVES, shared_electrode

from estimation.estimate import default_estimator, estimate
from estimation.tracker import track
from estimation.tracker.driven import UNREAD, drive_only, prepare_driven, steady
from estimation.tracker.orbit import axis_law
from phantoms.experiment import Experiment, run
from phantoms.forward import Plan, simulate
from phantoms.waveforms import Sine
from recon.mapping import Grid
from recon.picture_phase import refined
from recon.pipeline import Options, Reconstruction, reconstruct
from recon.score import axis_error, told_truth
from scanner import devices
from scanner.errors import BadInput, ChannelMissing
from scanner.motion import Motion
from scanner.recording import Recording

GRID = Grid(200, 200, 0.18, 0.18)
DURATION, RATE = 0.03, 2.5e6


@cache
def scan() -> tuple[Recording, dict]:
    """A tissue under both axes, x softening and y stiffening: phases go by 3 degrees, one each way."""
    drift = {"x": -0.0012, "y": 0.0015}
    return run(Experiment(duration=DURATION, sample_rate=RATE, drift=drift, drift_tau=0.01), seed=3)


def without(recording: Recording, *names: str, **changed: np.ndarray) -> Recording:
    channels = {k: (c.read(), c.unit, c.sample_rate, c.start) for k, c in recording.channels.items() if k not in names}
    for name, values in changed.items():
        channels[name] = (values, *channels[name][1:])
    return Recording.from_arrays(channels, recording.device)


@cache
def unheard() -> Reconstruction:
    recording, truth = scan()
    return reconstruct(without(recording, "sense"), Options(pixels=(200, 200)), told_truth(truth), quiet=True)


def rmse(motion: Motion, truth: dict) -> dict[str, float]:
    """Phase error of each axis [deg]."""
    angles = told_truth(truth).angles
    return {name: np.rad2deg(axis_error(axis, *angles[name]).phase_rmse) for name, axis in motion.axes.items()}


# --- drive alone


def test_the_drive_alone_tells_a_motion_that_does_not_drift() -> None:
    recording, truth = simulate(devices.load("imaging"), Plan(DRIVES, 0.006, RATE, settle=0.2))
    motion = drive_only(recording, recording.device)
    for name, axis in motion.axes.items():
        error = axis_error(axis, *told_truth(truth).angles[name])
        assert np.rad2deg(error.phase_rmse) < 0.02
        assert np.abs(error.amplitude).max() < 1e-3
        assert np.rad2deg(axis.phase_sd.min()) > 3.0  # a resonance known to 0.3 % leaves the phase open by degrees
        assert axis.sign == "ambiguous"


@pytest.mark.parametrize("name", ["x", "y"])
def test_the_steady_motion_answers_stiffness_and_damping_as_told(name: str) -> None:
    recording, _ = shared_electrode()
    device = recording.device
    told = steady(prepare_driven(recording, device, name))
    mechanics, step = device.axis(name).require_mechanics(), 1e-5

    def at(**relative: float) -> np.ndarray:
        changed = replace(mechanics, **{key: getattr(mechanics, key) * (1 + by) for key, by in relative.items()})
        axes = {**device.axes, name: replace(device.axis(name), mechanics=changed)}
        prepared = prepare_driven(recording, replace(device, axes=axes), name)
        assert prepared.laws[0] == axis_law(axes[name], UNREAD)
        return np.array(steady(prepared)[:2])

    for column, key in enumerate("kb"):
        slope = (at(**{key: step}) - at(**{key: -step})) / (2 * step)
        assert told.by_law[:, column] == pytest.approx(slope, rel=2e-3, abs=1e-3 * np.abs(told.by_law).max())


def test_a_drive_is_needed_and_must_sustain_a_motion() -> None:
    recording, _ = shared_electrode()
    with pytest.raises(ChannelMissing, match="drive_y"):
        drive_only(without(recording, "sense", "drive_y"), recording.device)
    weak, _ = simulate(devices.load("imaging"), Plan({**DRIVES, "y": Sine(6540.0, 3.0, 3.0)}, 0.006, settle=0.001))
    with pytest.raises(BadInput, match="sustains no motion of axis y"):
        drive_only(weak, weak.device)


def test_what_was_recorded_chooses_the_estimator() -> None:
    recording, _ = scan()
    device = recording.device
    assert default_estimator(recording, device) == "tracker"
    assert default_estimator(without(recording, "sense"), device) == "picture"
    assert default_estimator(without(recording, "sense", "intensity"), device) == "sensor"
    assert default_estimator(without(recording, "sense", "drive_x"), device) == "sensor"


# --- the picture


def test_a_scan_without_a_sense_signal_comes_out_sharp() -> None:
    result = unheard()
    assert result.motion.estimator == "picture"
    before = rmse(estimate(without(scan()[0], "sense"), method="picture"), scan()[1])
    for name, axis in result.motion.axes.items():
        error = result.errors[name]
        assert before[name] > 1.5
        assert np.rad2deg(error.phase_rmse) < 0.15
        sd = np.interp(error.time, axis.time, axis.phase_sd)
        assert np.mean(np.abs(error.phase) < 3 * sd) > 0.95
        assert np.rad2deg(np.median(sd)) < 0.15
    assert sum("measured in the picture" in note for note in result.notes) == 2


def test_a_featureless_sample_tells_nothing_and_it_is_said() -> None:
    recording, _ = scan()
    grey = np.random.default_rng(0).poisson(500.0, recording["intensity"].size).astype(float)
    result = reconstruct(without(recording, "sense", intensity=grey), Options(pixels=(200, 200)), quiet=True)
    assert result.motion.info["picture"]["told"] == {"x": 0, "y": 0}
    assert sum("shows nothing of the phase" in note for note in result.notes) == 2
    for axis in result.motion.axes.values():
        assert np.rad2deg(axis.phase_sd.min()) > 3.0


def test_bars_tell_the_phase_across_them_and_not_the_one_along() -> None:
    recording, truth = scan()
    s = told_truth(truth).angles["x"][0] / 0.18
    chirp = np.sin(40 * s + 25 * s**2)  # equal bars would look alike a bar further on
    bars = 500.0 + 300.0 * chirp + np.random.default_rng(1).normal(0, 10, s.size)
    field = without(recording, "sense", intensity=bars)
    motion, notes = refined(field, field.device, drive_only(field, field.device), field["intensity"], GRID, {})
    assert rmse(motion, truth)["x"] < 0.15
    assert motion.info["picture"]["told"]["y"] == 0  # type: ignore[index]
    assert any("nothing of the phase of y" in note for note in notes)


def test_a_poor_sense_signal_is_helped_and_a_good_one_left_alone() -> None:
    recording, truth = scan()
    device, intensity = recording.device, recording["intensity"]
    good = track(recording, device)
    assert refined(recording, device, good, intensity, GRID, {})[0] is good
    noise = np.random.default_rng(2).normal(0.0, 1.0, recording["sense"].size)
    poor = without(recording, sense=recording["sense"].read() + noise)
    alone = track(poor, device)
    helped, _ = refined(poor, device, alone, intensity, GRID, {})
    before, after = rmse(alone, truth), rmse(helped, truth)
    for name in "xy":
        assert after[name] < 0.5 * before[name]
        assert after[name] < 0.15


def test_a_flipped_axis_is_measured_alike() -> None:
    recording, _ = run(Experiment(duration=0.01, sample_rate=RATE), seed=4)
    silent = without(recording, "sense")
    device, intensity = silent.device, silent["intensity"]
    found = [
        refined(silent, device, estimate(silent, device, "picture", flips), intensity, GRID, flips)[0]
        for flips in ({}, {"x": True})
    ]
    plain, flipped = (motion.axes["x"] for motion in found)
    assert np.allclose(flipped.phase - plain.phase, np.pi, atol=1e-3)
    assert np.allclose(flipped.angle.read(), -plain.angle.read(), atol=1e-4)


def test_phases_are_told_against_the_drive_that_pulls() -> None:
    plain = devices.load("imaging")
    lagging = {n: replace(a, terms={"drive-lag": {"f_c": 1.5e5}}) for n, a in plain.axes.items()}
    device = replace(plain, axes=lagging)
    recording, truth = run(Experiment(device=device, duration=0.01, sample_rate=RATE, drift={}), seed=5)
    silent = without(recording, "sense")
    found, _ = refined(silent, device, estimate(silent, device, "picture"), silent["intensity"], GRID, {})
    assert max(rmse(found, truth).values()) < 0.2  # the lag alone turns the phase of x by 5 degrees
