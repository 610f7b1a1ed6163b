"""Families in which the nominal device is far from the truth, so that a linearisation at the nominal values fails."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import pi, sqrt

import numpy as np

from benchmarks.blind.scanner_truth import Truth
from benchmarks.blind.scenarios import Rng, Scenario, Tones, initial_states, nominal_device, ring, tf

PENDULUM_SWING = np.deg2rad(135.0)


def pendulum(rng: Rng) -> Scenario:
    """A free decay from 135 degrees with the torque k sin(theta), against a nominal linear spring."""
    f0, quality, J = rng.uniform(0.8, 1.6), rng.uniform(50, 150), rng.uniform(1e-3, 5e-3)
    k, gain = J * (2 * pi * f0) ** 2, rng.uniform(1.0, 3.0)
    truth = Truth(J=J, b=sqrt(k * J) / quality, k=k, torque_per_volt=1e-3, gain=gain)
    rate = 200.0
    samples = int(rate * 40 / f0)
    readout = {
        "kind": "position",
        "gain": gain,
        "offset": 0.0,
        "noise_sd": gain * PENDULUM_SWING / rng.uniform(400, 2000),
    }
    tolerance = {"k": 0.02, "b": 0.1, "gain": 0.02, "torque_per_volt": 0.05}
    return Scenario(
        family="tf",
        truth=truth,
        device=nominal_device(truth, readout | {"bits": 16}, tolerance, rng),
        drive=(Tones(-1.0),),
        sample_rate=rate,
        samples=samples,
        steps_per_second=2000.0,
        initial=initial_states(PENDULUM_SWING, 0.0, PENDULUM_SWING, 0.0),
        omega=2 * pi * f0,
        swing=PENDULUM_SWING,
        angle_sd=None,
    )


def strong_spring(rng: Rng) -> Scenario:
    """A ringdown or a driven mirror; its spring is 30 % off at full swing by the effect that is injected."""
    return ring(rng) if rng.random() < 0.5 else tf(rng)


def sharp_resonance(rng: Rng) -> Scenario:
    """A linear actuator at a quality of 300; the stated resonance is 3 % off, within a tolerance of 8 % of k."""
    scenario = tf(rng, (290, 310))
    axis = scenario.device["x"]
    mechanics = axis["mechanics"] | {"k": scenario.truth.k * (1 + 0.03 * rng.choice([-1, 1])) ** 2}
    tolerance = axis["tolerance"] | {"k": 0.08}
    return replace(scenario, device=scenario.device | {"x": axis | {"mechanics": mechanics, "tolerance": tolerance}})


LARGE_FAMILIES: dict[str, Callable[[Rng], Scenario]] = {
    "pendulum": pendulum,
    "strong-spring": strong_spring,
    "sharp-resonance": sharp_resonance,
}
