"""How plainly a recording shows what is hidden in it, and how far that lies from its nearest look-alike, in sigma.

Linearised at the truth: every effect is the change that it makes in the whitened channels, scaled to its size; what the
nominal parameters within their tolerances, the unknown start and a free offset can imitate is projected out, then
what each look-alike at any size can. Two hypotheses at distance d are told apart with probability Phi(d/2).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from math import pi
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.concealed.effects import CATALOGUE, Effect
from benchmarks.concealed.generator import Sealed
from benchmarks.concealed.motion import RATE, THETA
from benchmarks.concealed.readout import limited, observe
from benchmarks.concealed.scanner_truth import Truth
from benchmarks.concealed.worlds import World

Array = NDArray[np.float64]

UNSTATED = 0.02
"""Relative uncertainty of a nominal value whose tolerance the device file does not state."""
START = 0.1
"""Uncertainty of the state in which a recording finds the mirror, over its swing."""
FIELDS = {"b_cir": "offset"}
"""Nominal values that the truth calls by another name."""


def distances(sealed: Sealed) -> list[dict[str, Any]]:
    """For every hidden effect ``sigma``, its own size, and the ``distance`` to its ``nearest`` listed look-alike."""
    world, truth = sealed.world, sealed.truth
    here = _whitened(sealed, world, truth)

    def change(to: Truth, by: float, start: World = world) -> Array:
        return (_whitened(sealed, start, to) - here) / by

    hidden = [_tangent(sealed, i, change) for i in range(len(sealed.hidden))]
    nuisances, priors = zip(*_nuisances(sealed, change), strict=True)
    rivals = list(_rivals(sealed, change))
    columns = np.array([*hidden, *nuisances, *(column for _, column in rivals)])
    gram = columns @ columns.T
    first = len(hidden)
    known = list(range(first, first + len(nuisances)))
    gram[known, known] += np.array(priors)
    found = []
    for i, secret in enumerate(sealed.hidden):
        others = known + [j for j in range(first) if j != i]
        apart: dict[str, float] = {}
        for name in dict.fromkeys(name for name, _ in rivals):
            rival = [first + len(nuisances) + j for j, (other, _) in enumerate(rivals) if other == name]
            apart[name] = _left_over(gram, i, others + rival)
        apart = dict(sorted(apart.items(), key=lambda item: item[1]))
        nearest = next(iter(apart))
        found.append({
            "effect": secret.effect.name,
            "sigma": _left_over(gram, i, others),
            "nearest": nearest,
            "distance": apart[nearest],
            "rivals": {name: apart[name] for name in list(apart)[:5]},
        })  # fmt: skip
    return found


def _left_over(gram: Array, i: int, projected: list[int]) -> float:
    """Length of column i once the span of the ``projected`` columns, each held by its prior, is taken out."""
    scale = np.sqrt(np.diag(gram)[projected])
    scale[scale == 0] = 1.0
    inner = gram[np.ix_(projected, projected)] / np.outer(scale, scale)
    outer = gram[i, projected] / scale
    return float(np.sqrt(max(gram[i, i] - outer @ np.linalg.pinv(inner, rcond=1e-11, hermitian=True) @ outer, 0.0)))


def _whitened(sealed: Sealed, world: World, truth: Truth) -> Array:
    """All measured channels in units of their noise, one after another, (n,)."""
    channels = observe(world, truth)
    volts = limited(channels["sense_x"], truth)
    noise, n = sealed.noise, world.samples
    if noise.is_coloured:
        frequency = np.arange(n // 2 + 1) * world.sample_rate / n
        volts = np.fft.irfft(np.fft.rfft(volts) / np.sqrt(noise.density(frequency, world.sample_rate / n)), n)
    white = [volts / noise.sd]
    if world.angle_sd is not None:
        white.append(channels["angle_x"] / world.angle_sd)
    return np.concatenate(white)


def _tangent(sealed: Sealed, i: int, change: Callable[..., Array]) -> Array:
    """What the i-th hidden effect does to the channels, from its slope at the truth."""
    less = 0.005
    sizes = [h.size * (1 - less * (j == i)) for j, h in enumerate(sealed.hidden)]
    return change(_with_sizes(sealed, sizes), -less)


def _with_sizes(sealed: Sealed, sizes: list[float]) -> Truth:
    truth = sealed.scene.world.truth
    for h, size in zip(sealed.hidden, sizes, strict=True):
        truth = h.effect.on(truth, sealed.scene, size, h.shape)
    return truth


def _nuisances(sealed: Sealed, change: Callable[..., Array]) -> Iterator[tuple[Array, float]]:
    """Columns of what a fit is free to move, and the weight of the prior that holds each: 1 of a tolerance, 0 none."""
    world, truth = sealed.world, sealed.truth
    tolerance: dict[str, float] = dict(world.device["x"]["tolerance"])
    if not truth.torque_per_volt:
        tolerance.setdefault("J", UNSTATED)
    for name, relative in tolerance.items():
        field = str(FIELDS.get(name, name))
        moved: dict[str, float] = {field: getattr(truth, field) * (1 + 0.01 * relative)}
        yield change(truth._replace(**moved), 0.01), 1.0
    for state, size in ((THETA, world.swing), (RATE, world.swing * world.omega)):
        initial = world.initial.copy()
        initial[state] += 1e-4 * size
        yield change(truth, 1e-4 / START, replace(world, initial=initial)), 1.0
    yield change(truth._replace(offset=truth.offset + 1e-3 * sealed.scene.height), 1e-3), 0.0
    t = world.times
    silent = np.zeros(world.samples if world.angle_sd is not None else 0)
    for harmonic in range(1, len(sealed.noise.hum) + 1):
        turn = 2 * pi * sealed.noise.mains * harmonic * t
        for wave in (np.sin(turn), np.cos(turn)):
            yield np.concatenate([wave, silent]), 0.0


def _rivals(sealed: Sealed, change: Callable[..., Array]) -> Iterator[tuple[str, Array]]:
    """Directions that the catalogue's other effects would move the channels in; several where the law has a shape."""
    taken = {field for h in sealed.hidden for field in h.fields}
    for effect in CATALOGUE:
        if not effect.shows_in(sealed.world) or any(effect.name == h.effect.name for h in sealed.hidden):
            continue
        for u in (0.15, 0.45, 0.8) if effect.shaped else (0.5,):
            fields = _small(sealed, effect, u)
            if not taken & fields.keys():
                yield effect.name, change(sealed.truth._replace(**fields), 1.0)


def _small(sealed: Sealed, effect: Effect, u: float) -> dict[str, float]:
    """An effect at half its smallest size."""
    shape = np.array([u, 1 - u, u])
    return effect.law(sealed.scene, sealed.truth, 0.5 * effect.sizes[sealed.world.family][0], shape)
