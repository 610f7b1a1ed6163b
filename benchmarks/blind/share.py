"""The share of the misfit that an imperfection takes beside the true law, and the strength for a stated share.

The misfit is the residual sum of squares of the best nominal device, fitted to the noiseless channels, in units of the
white noise's variance. The true law's share is the part of it that vanishes when the true law is fitted as well. The
rest is the imperfection's share.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import log

import numpy as np
from numpy.typing import NDArray

from benchmarks.blind.effects import InjectedEffect, SizeReference
from benchmarks.blind.imperfections import Imperfection
from benchmarks.blind.motion import RATE, THETA
from benchmarks.blind.noise import Noise
from benchmarks.blind.readout import AFTER_MOTION, settle_start, simulate_motion
from benchmarks.blind.scanner_truth import Truth
from benchmarks.blind.scenarios import Scenario
from benchmarks.blind.sensitivity import NOMINAL, START_SD, UNSTATED_TOLERANCE, channels_in_sigma, nuisance_columns

Array = NDArray[np.float64]

SHARES = (0.003, 0.03)
"""Smallest and largest share of the misfit: the range that real recordings show beside their main effect."""
MAX_RELATIVE_RMS = 0.05
"""Largest rms of what the imperfection leaves after the fit, over the signal's. Where the nominal device misses most of
the signal, as for a pendulum at 135 degrees, the share is smaller, as an imperfection is small against the signal."""
MIN_MISFIT_SIGMA = 15.0
"""Smallest misfit of the injected effect. In a smaller one, a share of 3 % is hidden in the noise."""
SHARE_TOLERANCE = 1.25
"""Factor by which the share may miss its target. The achieved share is what the key states."""
MAX_TRIALS = 8
"""Trials of strength. A power law needs two; a rail or missing codes need a few more."""
MAX_ITERATIONS = 6
"""Gauss-Newton steps of the nominal fit. It starts at the true constants, so few are needed."""
MIN_IMPROVEMENT = 0.02
"""Relative decrease of the sum of squares below which the nominal fit ends."""


@dataclass(frozen=True)
class PlacedImperfection:
    """An imperfection with the strength that gives it its share.

    Attributes:
        imperfection: which one.
        strength: see :class:`Imperfection`.
        share: part of the misfit that remains when the true law is fitted.
        misfit: of the best nominal device, in units of the white noise's variance.
        fields: what it sets in the truth.
    """

    imperfection: Imperfection
    strength: float
    share: float
    misfit: float
    fields: dict[str, float]


def place_imperfection(
    imperfection: Imperfection,
    reference: SizeReference,
    noise: Noise,
    truth: Truth,
    injected: Sequence[InjectedEffect],
    rng: np.random.Generator,
) -> PlacedImperfection | None:
    """The imperfection at a share drawn from :data:`SHARES`; None where the misfit is too small for a share.

    Args:
        imperfection: which one.
        reference: scales of the scenario.
        noise: of the sense channel; its standard deviation is the unit.
        truth: the scanner with the injected effects.
        injected: the effects, which a fit of the true law adjusts.
        rng: source of randomness.
    """
    target = float(np.exp(rng.uniform(*np.log(SHARES))))
    shape = rng.random(3)
    scenario = settle_start(reference.scenario, truth)
    here = channels_in_sigma(noise, scenario, truth, simulate_motion(scenario, truth), whiten=False)
    columns = _columns_of_true_law(reference, noise, scenario, truth, injected, here)
    misfit = nominal_misfit(reference, noise, scenario, here)
    if misfit < MIN_MISFIT_SIGMA**2:
        return None
    signal = float(np.sum((here[: scenario.samples] - here[: scenario.samples].mean()) ** 2))
    target = min(target, MAX_RELATIVE_RMS**2 * signal / misfit)
    strength, power, last = imperfection.strength, 2.0, None
    for _ in range(MAX_TRIALS):
        fields = imperfection.law(reference, truth, strength, shape)
        imperfect = truth._replace(**fields)
        start = settle_start(reference.scenario, imperfect)
        there = channels_in_sigma(noise, start, imperfect, simulate_motion(start, imperfect), whiten=False)
        rest = columns.residual(there - here)
        share = rest / (misfit + rest)
        if target / SHARE_TOLERANCE < share < target * SHARE_TOLERANCE:
            return PlacedImperfection(imperfection, strength, share, misfit + rest, fields)
        if last and share > 0 and last[1] > 0 and strength != last[0]:
            power = min(max(log(share / last[1]) / log(strength / last[0]), 0.5), 8.0)
        last = (strength, share)
        factor = (target / share) ** (1 / power) if share > 0 else 4.0
        strength = min(strength * min(max(factor, 0.02), 20.0), imperfection.largest)
        if strength == last[0]:
            return None
    return None


@dataclass(frozen=True)
class _Columns:
    """Columns that a fit adjusts, (m, n), and the weights of their priors, (m,)."""

    columns: Array
    priors: Array

    def residual(self, change: Array) -> float:
        """Sum of squares of a change of the channels, (n,), after a fit of the columns."""
        scale = np.sqrt(np.einsum("mn,mn->m", self.columns, self.columns) + self.priors)
        scale[scale == 0] = 1.0
        matrix = np.vstack([(self.columns / scale[:, None]).T, np.diag(np.sqrt(self.priors) / scale)])
        padded = np.concatenate([change, np.zeros(len(self.priors))])
        fit, *_ = np.linalg.lstsq(matrix, padded, rcond=1e-10)
        return float(np.sum((change - matrix[: change.size] @ fit) ** 2))


def _columns_of_true_law(
    reference: SizeReference,
    noise: Noise,
    scenario: Scenario,
    truth: Truth,
    injected: Sequence[InjectedEffect],
    here: Array,
) -> _Columns:
    """Derivatives at the truth by the nominal parameters and by size and shape of the injected effects."""
    motion = simulate_motion(scenario, truth)

    def change(to: Truth, by: float, start: Scenario = scenario) -> Array:
        same_motion = start is scenario and to == truth._replace(**{name: getattr(to, name) for name in AFTER_MOTION})
        there = motion if same_motion else simulate_motion(start, to)
        return (channels_in_sigma(noise, start, to, there, whiten=False) - here) / by

    columns, priors = (list(part) for part in zip(*nuisance_columns(reference, noise, scenario, truth, change, here),
                                                  strict=True))  # fmt: skip
    for effect in injected:
        law = effect.effect.law
        for size, shape in [
            (1.002 * effect.size, effect.shape),
            *((effect.size, effect.shape + 2e-3 * row) for row in np.eye(3) if effect.effect.shaped),
        ]:
            to = truth._replace(**law(reference, truth, size, shape))
            if to != truth:
                columns.append(change(to, 0.002))
                priors.append(0.0)
    return _Columns(np.array(columns), np.array(priors))


def nominal_misfit(reference: SizeReference, noise: Noise, scenario: Scenario, channels: Array) -> float:
    """Least sum of squares of the residual of a nominal device, in units of the white noise's variance.

    A Gauss-Newton fit, from the true constants on, of the nominal values (priors: their tolerances), the initial state
    and an offset to noiseless ``channels``, (n,).
    """
    clean = reference.scenario.truth
    parameters = [(field, value * scenario.tolerance.get(name, UNSTATED_TOLERANCE))
                  for name, field in NOMINAL.items() if (value := getattr(clean, field))]  # fmt: skip
    states = [(THETA, START_SD * scenario.swing), (RATE, START_SD * scenario.swing * scenario.omega)]
    priors = np.array([1.0] * len(parameters) + [1.0, 1.0, 0.0])

    def residual(x: Array) -> Array:
        changed = {field: getattr(clean, field) + unit * z for (field, unit), z in zip(parameters, x, strict=False)}
        initial = scenario.initial.copy()
        for (state, unit), z in zip(states, x[len(parameters) :], strict=False):
            initial[state] += unit * z
        to = clean._replace(**changed)
        to = to._replace(offset=to.offset + reference.height * x[-1])
        start = replace(scenario, initial=initial)
        with np.errstate(over="ignore", invalid="ignore"):
            return channels_in_sigma(noise, start, to, simulate_motion(start, to), whiten=False) - channels

    x = np.zeros(len(priors))
    r = residual(x)
    cost = float(r @ r)
    for _ in range(MAX_ITERATIONS):
        step = 1e-3
        jacobian = np.array([(residual(x + step * row) - r) / step for row in np.eye(x.size)]).T
        hessian = jacobian.T @ jacobian + np.diag(priors)
        gradient = jacobian.T @ r + priors * x
        scale = 1 / np.sqrt(np.diag(hessian))
        damping, before = 1e-6, cost
        for _ in range(5):
            normal = hessian * np.outer(scale, scale) + damping * np.eye(x.size)
            trial = x - scale * np.linalg.solve(normal, scale * gradient)
            there = residual(trial)
            total = float(there @ there) + float(priors @ trial**2)
            if np.isfinite(total) and total < cost + float(priors @ x**2):
                x, r, cost = trial, there, float(there @ there)
                break
            damping = max(30 * damping, 1e-3)
        if cost > (1 - MIN_IMPROVEMENT) * before:
            break
    return cost
