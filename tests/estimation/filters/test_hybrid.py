"""The hybrid filter: equal to the EKF without crossings, more accurate with them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.papers import hybrid as table
from estimation.estimate import estimate
from estimation.estimators import estimators
from estimation.filters.hybrid import make_detector, run_hybrid
from estimation.filters.run import run_compiled
from scanner.devices import load
from scanner.errors import DeviceInvalid
from scanner.recording import Recording


@pytest.fixture(scope="module")
def trials():
    return [table.trial(2019 + i) for i in range(3)]


@pytest.mark.slow
def test_hybrid_filter_without_crossings_is_the_ekf(trials):
    problem = trials[0].problem
    hybrid = run_hybrid(problem, trials[0].axis, 1e8, events=False)
    ekf = run_compiled(problem, "ekf", np.array([1e8]))
    np.testing.assert_allclose(hybrid.theta, ekf.theta, atol=1e-9)
    assert hybrid.log_likelihood == pytest.approx(ekf.log_likelihood, rel=1e-9)
    np.testing.assert_allclose(hybrid.track, ekf.track, rtol=1e-6, atol=1e-12)


def test_crossings_reduce_the_error_most_for_weak_signals(trials):
    rows = table.table(trials, None, full_jacobian=False)
    gain = 1 - np.array(rows["hyb"][0]) / np.array(rows["ekf"][0])
    assert gain[3] > 0.3
    assert gain[3] > gain[0]
    assert gain[4] > 0.1


def test_segments_have_the_signal_to_noise_ratios_of_the_paper(trials):
    power = (
        np.mean([[np.var(q) for q in table.segments_of(t.problem.signal)] for t in trials], axis=0) / 0.0435**2 - 1.0
    )
    np.testing.assert_allclose(power, [85.0, 22.0, 5.0, 1.0], rtol=0.2)


def test_full_jacobian_has_a_smaller_error_than_that_of_the_paper(trials):
    reduced, full = (table.table(trials, None, jacobian)["ekf"][0][4] for jacobian in (False, True))
    assert full < 0.85 * reduced


def test_estimator_is_available_by_name(trials):
    problem = trials[0].problem
    channel = problem.sense.channel
    device = replace(load("chen2019"), axes={"x": trials[0].axis})
    values = {
        "sense_x": (channel.read(), "V", channel.sample_rate, 0.0),
        "bias_x": (np.full(channel.size, 10.0), "V", channel.sample_rate, 0.0),
    }
    motion = estimate(Recording.from_arrays(values, device), None, "hyb")
    error = motion.axes["x"].angle.read() - trials[0].angle
    assert np.sqrt(np.mean(error**2)) < 0.004
    assert motion.axes["x"].sign.startswith("known")
    info = motion.info["sense_x"]
    assert info["crossings"] > 90
    assert info["latency_s"] == pytest.approx(make_detector(problem).latency / channel.sample_rate)


def test_a_readout_without_crossings_is_refused():
    device = load("chen2020-driven")
    n, rate, f = 20000, 5e6, 31500.0
    turn = np.pi * f * np.arange(n) / rate
    sense = 1.0 + 0.3 * np.cos(2 * turn + 0.3)
    values = {"sense_x": (sense, "V", rate, 0.0), "drive_x": (30 + 30 * np.sin(2 * turn), "V", rate, 0.0)}
    with pytest.raises(DeviceInvalid, match=r"x\.readout\.kind: is amdm; hyb detects crossings"):
        estimate(Recording.from_arrays(values, device), None, "hyb")
    assert "hyb" in estimators()
