"""Drifts in scans of scanners with a position readout, and what nominal values absorb beside them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np

from benchmarks.scanner_kinds import experiment_of_kind, simulate_scan
from estimation.complete_diagnosis import diagnose_with_optics
from estimation.device_fit.fit import Fit
from estimation.device_fit.noise import Whitener, make_whitener
from estimation.device_fit.slow_noise import steeper_noise_gain
from phantoms.experiment import simulate_experiment
from scanner.arrays import Array


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
    findings = diagnose_with_optics([recording]).findings
    assert {(finding.axis, finding.effect) for finding in findings} == {("y", "resonance-drift"), ("x", "gain-drift")}


@dataclass
class CurvedLikelihood:
    """A residual that is linear in one parameter, and rises by ``curvature`` times the square of its change."""

    fit: Fit
    whiteners: tuple[tuple[Whitener, ...], ...]
    curvature: float

    def residual(self, model: Any, x: Array) -> Array:
        moved = x - self.fit.x
        return np.asarray(self.fit.residual + self.fit.jacobian @ moved + self.curvature * moved @ moved)


def test_steeper_noise_explains_no_more_than_a_simulation_confirms() -> None:
    """Without the slow cosine the parameter would move and explain the measured one, in the linear model."""
    n, size = 4000, 30.0
    turn = 2.0 * np.pi * np.arange(n) / n
    slow, measured = (np.sqrt(2.0 / n) * np.cos(k * turn) for k in (1, 12))
    residual, rows = size * (slow - measured), np.ones(n, bool)
    model: Any = SimpleNamespace(precision=np.array([1e-6]))
    fit = Fit(model, np.zeros(1), 2.0 * size**2, 0.0, residual, (slow + measured)[:, None], rows, ~rows, 0.0)
    whiteners = ((make_whitener(np.full(n // 2 + 1, float(n)), n, (0, 0), first=10.0),),)
    linear, curved = (steeper_noise_gain(CurvedLikelihood(fit, whiteners, c), fit) for c in (0.0, 1.0))  # type: ignore[arg-type]
    assert linear > 1.2 * size**2
    assert 0.5 * size**2 < curved < size**2
