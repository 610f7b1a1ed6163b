"""A second experiment on the same scanner. The diagnosis does not get it; it tests the improved device."""

from __future__ import annotations

from dataclasses import replace
from math import pi

import numpy as np

from benchmarks.blind.motion import RATE, THETA
from benchmarks.blind.scenarios import Rng, Scenario, Tones


def other_experiment(scenario: Scenario, rng: Rng) -> Scenario:
    """The same scanner with another start, or with other frequencies, levels and phases of its drive."""
    if len(scenario.drive) == 1 and not scenario.drive[0].amplitudes:
        return _other_start(scenario, rng)
    if scenario.family == "drive":
        return _other_frequencies(scenario, rng)
    return _other_multisine(scenario, rng)


def _other_start(scenario: Scenario, rng: Rng) -> Scenario:
    """A free decay from 60 to 90 % of the amplitude, at another phase."""
    size, phase = scenario.swing * rng.uniform(0.6, 0.9), rng.uniform(0, 2 * pi)
    initial = scenario.initial.copy()
    initial[[THETA, RATE]] = size * np.cos(phase), -scenario.omega * size * np.sin(phase)
    return replace(scenario, initial=initial)


def _other_frequencies(scenario: Scenario, rng: Rng) -> Scenario:
    """Parametric drive at frequencies that are 4 to 12 Hz higher or lower, in steps without a jump of phase."""
    shift = rng.uniform(4, 12) * rng.choice([-1, 1])
    tones: list[Tones] = []
    for old in scenario.drive:
        frequency = old.frequencies[0] + shift
        phase = rng.uniform(0, 2 * pi)
        if tones:
            last = tones[-1]
            phase = last.phases[0] + 2 * pi * (last.frequencies[0] - frequency) * old.start
        tones.append(replace(old, frequencies=(frequency,), phases=(phase,)))
    return replace(scenario, drive=tuple(tones))


def _other_multisine(scenario: Scenario, rng: Rng) -> Scenario:
    """Other phases of the multisine, and 70 to 95 % of every level."""
    level = rng.uniform(0.7, 0.95)
    drive = []
    for tones in scenario.drive:
        phases = tuple(rng.uniform(0, 2 * pi, len(tones.phases)).tolist())
        drive.append(replace(tones, amplitudes=tuple(level * a for a in tones.amplitudes), phases=phases))
    return replace(scenario, drive=tuple(drive))
