"""Drifts in scans of scanners with a position readout, and what nominal values absorb beside them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from benchmarks.scanner_kinds import experiment_of_kind, simulate_scan
from estimation.complete_diagnosis import diagnose_with_optics
from estimation.device_fit.noise import make_whitener
from estimation.device_fit.slow_noise import gain_of_steeper_noise
from phantoms.experiment import simulate_experiment


def test_the_drift_of_a_resonant_galvanometer_is_named() -> None:
    recording, drift = simulate_scan("galvo", 1)
    (finding,) = diagnose_with_optics([recording]).findings
    assert (finding.effect, finding.axis) == ("resonance-drift", "x")
    alpha, _ = finding.parameters
    assert alpha.ci95[0] < drift["x"] < alpha.ci95[1]


def test_a_gain_that_nominal_values_have_absorbed_is_named_beside_the_drift_of_the_other_axis() -> None:
    experiment = experiment_of_kind("electromagnetic", {"x": 0.0, "y": -5.9e-4}, drift_tau=0.5)
    nominal = experiment.device
    true = nominal.with_terms({"x": {"gain-drift": {"g": 0.02, "T": experiment.duration}}})
    recording, _ = simulate_experiment(replace(experiment, device=true), 7, nominal=nominal)
    found = diagnose_with_optics([recording])
    loops = found.open_loop["sense_x"]
    assert loops["improved"]["rmse"] < 0.1 * loops["nominal"]["rmse"]
    assert {(finding.axis, finding.effect) for finding in found.findings} == {
        ("y", "resonance-drift"),
        ("x", "gain-drift"),
    }


def test_slow_noise_explains_nothing_in_white_noise_however_precise_the_signal() -> None:
    """Parameters that a signal of 80 dB determines, two of them nearly together: their misfit is above rounding."""
    n, rng = 4000, np.random.default_rng(3)
    turn = 2.0 * np.pi * np.arange(n) / n
    signal, residual = 1e4 * np.sin(100.0 * turn), rng.normal(size=n)
    sensitivities = np.column_stack([signal, turn * signal, (1.0 + 1e-4 * turn) * signal + rng.normal(size=n)])
    residual -= sensitivities @ np.linalg.lstsq(sensitivities, residual, rcond=None)[0]
    whitener = make_whitener(np.full(n // 2 + 1, float(n)), n, (0, 0), first=10.0)
    columns, x = np.column_stack([sensitivities, residual]), np.array([1.0, -1.0, 0.5])
    assert gain_of_steeper_noise([whitener], columns, np.ones(n, bool), np.ones(3), x) < 2.0
