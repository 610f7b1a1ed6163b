"""The size of an injected effect in a recording, and its distance to the nearest confounder, both in sigma.

The signal is linearised at the scanner without the effect. The effect is the change that it makes in the whitened
channels, scaled to its size. First, what nominal parameters within their tolerances, the unknown start and a free
offset can imitate is projected out; the length of the rest is the size. Then the part that a confounder of any size can
imitate is projected out; the length of the rest is the distance d. Two hypotheses at distance d are distinguished with
probability Phi(d/2). The linearisation is not at the truth, because there scaling laws make an effect equal to a change
of gain and torque together.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.blind.effects import CATALOGUE, Effect, InjectedEffect, Shape
from benchmarks.blind.generator import BlindRecording
from benchmarks.blind.readout import AFTER_MOTION, settle_start, simulate_motion
from benchmarks.blind.scanner_truth import Truth
from benchmarks.blind.scenarios import Scenario
from benchmarks.blind.sensitivity import channels_in_sigma, nuisance_columns, unprojected_norm, with_effects

Array = NDArray[np.float64]

TRIED_SHAPES = np.array([[0.15, 0.85, 0.1], [0.45, 0.55, 0.4], [0.8, 0.2, 0.75]])
"""Shapes at which a confounder with a free shape is linearised, ordered by their first number."""


def distances(blind: BlindRecording) -> list[dict[str, Any]]:
    """By injected effect: size ``sigma``, ``distance`` to the ``nearest`` confounder, and the five ``rivals``."""
    return [_distance(blind, target) for target in blind.injected]


def _distance(blind: BlindRecording, target: InjectedEffect) -> dict[str, Any]:
    reference = blind.reference
    others = [h for h in blind.injected if h is not target]
    base = with_effects(reference, others)
    scenario = settle_start(reference.scenario, base)
    motion = simulate_motion(scenario, base)
    here = channels_in_sigma(blind.noise, scenario, base, motion)

    def change(to: Truth, by: float, start: Scenario = scenario) -> Array:
        unmoved = start is scenario and to == base._replace(**{name: getattr(to, name) for name in AFTER_MOTION})
        return (
            channels_in_sigma(blind.noise, start, to, motion if unmoved else simulate_motion(start, to)) - here
        ) / by

    def column(effect: Effect, size: float, shape: Shape) -> Array:
        """Change of the channels by an effect, from a part of its size that is small enough to be linear.

        The effect acts long before the recording starts. Switched on at the start, a second mode would ring.
        """
        to = effect.applied_to(base, reference, effect.linear_fraction * size, shape)
        start = settle_start(reference.scenario, to) if effect.stage == "mechanics" else scenario
        return change(to, effect.linear_fraction**effect.power, start)

    nuisances, priors = zip(*nuisance_columns(reference, blind.noise, scenario, base, change, here), strict=True)
    free = [change(with_effects(reference, [replace(h, size=1.005 * h.size) for h in others]), 0.005)] if others else []
    injected_fields = {name for h in blind.injected for name in h.fields}
    rivals = [
        (effect.name, i, column(effect, size, shape))
        for effect in CATALOGUE
        if effect.is_visible_in(scenario)
        for i, shape in enumerate(TRIED_SHAPES[: len(TRIED_SHAPES) if effect.shaped else 1])
        # A law that is not linear in its size changes direction with it. Smallest and largest size span that change.
        for size in effect.sizes[scenario.family][: 1 if effect.is_linear else 2]
        if not injected_fields & effect.law(reference, base, size, shape).keys()
    ]
    columns = np.array([column(target.effect, target.size, target.shape), *nuisances, *free, *(c for *_, c in rivals)])
    gram = columns @ columns.T
    nuisance_indices = np.arange(1, 1 + len(nuisances))
    gram[nuisance_indices, nuisance_indices] += np.array(priors)
    first = 1 + len(nuisances) + len(free)
    known = list(range(1, first))
    distance: dict[str, float] = {}
    for name, i, _ in rivals:
        # Two neighbouring shapes span a law and its derivative by the shape. More would imitate what no single law can.
        near = [first + j for j, (other, k, _) in enumerate(rivals) if other == name and k in (i, i + 1)]
        distance[name] = min(distance.get(name, np.inf), unprojected_norm(gram, 0, known + near))
    nearest_first = sorted(distance, key=lambda name: distance[name])
    return {
        "sigma": unprojected_norm(gram, 0, known),
        "nearest": nearest_first[0],
        "distance": distance[nearest_first[0]],
        "rivals": {name: distance[name] for name in nearest_first[:5]},
    }
