"""The sine UKF: agreement with filterpy and with the bound, and the delay of a sensor."""

from __future__ import annotations

import numpy as np
import pytest
from filterpy.kalman import JulierSigmaPoints, UnscentedKalmanFilter

from benchmarks.papers import sine
from estimation.estimate import estimate
from estimation.filters.sine_ukf import estimate_delay, measure_noise_and_phase_walk, track_sine_phase
from scanner.device import Device
from scanner.devices import load
from scanner.errors import DeviceInvalid
from scanner.recording import Recording

RATE, F = 1e6, 14510.0
TURN = 2 * np.pi * F * np.arange(60000) / RATE


def noisy(noise: float, seed: int = 0, phase: float = 0.7) -> np.ndarray:
    return 0.087 * np.sin(TURN + phase) + noise * np.random.default_rng(seed).standard_normal(TURN.size)


def test_sine_ukf_equals_filterpy():
    angle, n = noisy(0.01), 400
    phase = track_sine_phase(angle[:n], TURN[:n], 0.087, 0.01, 1e-3)
    points = JulierSigmaPoints(1, kappa=2.0)
    step = TURN[1] - TURN[0]
    oracle = UnscentedKalmanFilter(1, 1, 1.0, lambda s: 0.087 * np.sin(s), lambda s, dt: s + step, points)
    basis = np.stack([np.sin(TURN[:n]), np.cos(TURN[:n])], axis=1)
    used = min(n, max(64, int(16 * np.pi / step)))
    a, b = np.linalg.lstsq(basis[:used], angle[:used], rcond=None)[0]
    oracle.x, oracle.P = np.array([TURN[0] - step + np.arctan2(b, a)]), np.array([[2 / used * (0.01 / 0.087) ** 2]])
    oracle.Q, oracle.R = np.zeros((1, 1)), np.array([[1e-4]])
    for i in range(n):
        oracle.P = oracle.P + 1e-6  # before the points are drawn, so that they carry the process noise
        oracle.predict()
        oracle.update(np.array([angle[i]]))
        assert phase[i] == pytest.approx(oracle.x[0], abs=1e-9)


def test_noise_and_phase_walk_are_estimated_separately():
    rng = np.random.default_rng(3)
    wander = np.cumsum(3e-4 * rng.standard_normal(TURN.size))
    angle = 0.087 * np.sin(TURN + wander) + 0.01 * rng.standard_normal(TURN.size)
    noise, walk = measure_noise_and_phase_walk(angle, TURN, 0.087, RATE / F)
    assert noise == pytest.approx(0.01, rel=0.15)
    assert walk == pytest.approx(3e-4, rel=0.4)


def test_error_of_a_constant_phase_is_the_cramer_rao_bound():
    errors = [track_sine_phase(noisy(0.01, seed), TURN, 0.087, 0.01, 0.0)[-1] - TURN[-1] - 0.7 for seed in range(20)]
    bound = np.sqrt(2 / TURN.size) * 0.01 / 0.087
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(bound, rel=0.5)


@pytest.mark.parametrize("late", [14e-9, -2e-6])
def test_delay_is_estimated_despite_an_amplitude_error(late):
    truth = np.sin(TURN)
    assert estimate_delay(truth, 1.03 * np.sin(TURN - 2 * np.pi * F * late), RATE) == pytest.approx(
        late * 1.0, rel=0.05
    )


@pytest.mark.parametrize("name", ["cw1012", "a7m20"])
def test_both_mirrors_reach_the_variances_of_the_paper(name):
    variances, _, _ = sine.outcome(sine.DEVICES[name](77))
    before, after = sine.PAPER[name]
    assert variances.sensor == pytest.approx(before, rel=0.5)
    assert variances.ukf == pytest.approx(after, rel=0.5)
    assert variances.sensor / variances.corrected > 15.0


def test_estimator_is_available_by_name():
    axis = sine.linear_axis(F, 300.0)
    values = {"angle_x": (noisy(0.01) + 0.002, "rad", RATE, 0.0)}
    motion = estimate(Recording.from_arrays(values, Device("m", {"x": axis})), None, "sine-ukf")
    error = motion.axes["x"].angle.read() - 0.087 * np.sin(TURN + 0.7) - 0.002
    assert np.std(error) < 1e-3
    assert motion.info["x"]["offset"] == pytest.approx(0.002, abs=2e-4)
    assert motion.axes["x"].angle_noise_sd == 0.0  # filtered, so that noise moves no single sample


def test_a_capacitive_readout_is_refused():
    values = {"sense_x": (np.cos(TURN), "V", RATE, 0.0)}
    with pytest.raises(DeviceInvalid, match="sine-ukf needs a position readout"):
        estimate(Recording.from_arrays(values, load("chen2019")), None, "sine-ukf")
