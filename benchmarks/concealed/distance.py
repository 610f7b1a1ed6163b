"""How plainly a recording shows what is hidden in it, and how far that lies from its nearest look-alike, in sigma.

Linearised at the scanner without the effect: the effect is the change that it makes in the whitened channels, scaled to
its size; what the nominal parameters within their tolerances, the unknown start and a free offset can imitate is
projected out, then what each look-alike at any size can. Two hypotheses at distance d are told apart with probability
Phi(d/2). Not at the truth: there, scaling laws make an effect look like a change of gain and torque together.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from math import pi
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.fft import dct, idct

from benchmarks.concealed.effects import CATALOGUE, Effect, Scene, Shape
from benchmarks.concealed.generator import Hidden, Sealed
from benchmarks.concealed.motion import RATE, THETA, Trajectory
from benchmarks.concealed.readout import AFTER_MOTION, limited, move, read, settle
from benchmarks.concealed.scanner_truth import Truth
from benchmarks.concealed.worlds import World

Array = NDArray[np.float64]

UNSTATED = 0.02
"""Relative uncertainty of a nominal value whose tolerance the device file does not state, the reference angle's gain
included: nothing says how well that one is calibrated."""
START = 0.1
"""Uncertainty of the state in which a recording finds the mirror, over its swing."""
SHAPES = np.array([[0.15, 0.85, 0.1], [0.45, 0.55, 0.4], [0.8, 0.2, 0.75]])
"""At which a look-alike whose law has a shape is tried, in order of their first number."""
NOMINAL = {
    **{name: name for name in ("J", "b", "k", "torque_per_volt", "C0", "Cb", "theta0", "R_s", "a_cir", "gain")},
    "b_cir": "offset",
    "lpf_hz": "sections",
}
"""Values that device files state, and what the truth calls them."""


def distances(sealed: Sealed) -> list[dict[str, Any]]:
    """For every hidden effect ``sigma``, its own size, and the ``distance`` to its ``nearest`` listed look-alike."""
    return [_distance(sealed, secret) for secret in sealed.hidden]


def _distance(sealed: Sealed, secret: Hidden) -> dict[str, Any]:
    scene = sealed.scene
    others = [h for h in sealed.hidden if h is not secret]
    base = _hiding(scene, others)
    world = settle(scene.world, base)
    motion = move(world, base)
    here = _whitened(sealed, world, base, motion)

    def change(to: Truth, by: float, start: World = world) -> Array:
        unmoved = start is world and to == base._replace(**{name: getattr(to, name) for name in AFTER_MOTION})
        return (_whitened(sealed, start, to, motion if unmoved else move(start, to)) - here) / by

    def column(effect: Effect, size: float, shape: Shape) -> Array:
        """What an effect adds, from a share of it small enough to be linear in.

        With it from long before the recording on: switched on at its start, a second mode would ring.
        """
        to = effect.on(base, scene, effect.gentle * size, shape)
        start = settle(scene.world, to) if effect.stage == "mechanics" else world
        return change(to, effect.gentle**effect.power, start)

    nuisances, priors = zip(*_nuisances(sealed, world, base, change, here), strict=True)
    free = [change(_hiding(scene, [replace(h, size=1.005 * h.size) for h in others]), 0.005)] if others else []
    taken = {name for h in sealed.hidden for name in h.fields}
    rivals = [
        (effect.name, i, column(effect, size, shape))
        for effect in CATALOGUE
        if effect.shows_in(world)
        for i, shape in enumerate(SHAPES[: len(SHAPES) if effect.shaped else 1])
        # A law that no small share is linear in bends with its size: its smallest and its largest span the bend.
        for size in effect.sizes[world.family][: 1 if effect.is_linear else 2]
        if not taken & effect.law(scene, base, size, shape).keys()
    ]
    columns = np.array([column(secret.effect, secret.size, secret.shape), *nuisances, *free, *(c for *_, c in rivals)])
    gram = columns @ columns.T
    held = np.arange(1, 1 + len(nuisances))
    gram[held, held] += np.array(priors)
    first = 1 + len(nuisances) + len(free)
    known = list(range(1, first))
    apart: dict[str, float] = {}
    for name, i, _ in rivals:
        # Two neighbouring shapes span a law and its slope in that shape; more would imitate what no one law can.
        near = [first + j for j, (other, k, _) in enumerate(rivals) if other == name and k in (i, i + 1)]
        apart[name] = min(apart.get(name, np.inf), left_over(gram, 0, known + near))
    nearest_first = sorted(apart, key=lambda name: apart[name])
    return {
        "sigma": left_over(gram, 0, known),
        "nearest": nearest_first[0],
        "distance": apart[nearest_first[0]],
        "rivals": {name: apart[name] for name in nearest_first[:5]},
    }


def left_over(gram: Array, i: int, projected: list[int]) -> float:
    """Length of column i once the span of the ``projected`` columns, each held by its prior, is taken out."""
    scale = np.sqrt(np.diag(gram)[projected])
    scale[scale == 0] = 1.0
    inner = gram[np.ix_(projected, projected)] / np.outer(scale, scale)
    outer = gram[i, projected] / scale
    return float(np.sqrt(max(gram[i, i] - outer @ np.linalg.pinv(inner, rcond=1e-11, hermitian=True) @ outer, 0.0)))


def _whitened(sealed: Sealed, world: World, truth: Truth, motion: Trajectory) -> Array:
    """All measured channels in units of their noise, one after another, (n,)."""
    channels = read(world, truth, motion)
    volts = limited(channels["sense_x"], truth)
    noise, n = sealed.noise, world.samples
    if noise.is_coloured:
        # a cosine transform: taken round in a circle, what drifts would end in a step, which is easy to see
        frequency = np.arange(n) * world.sample_rate / (2 * n)
        density = noise.density(frequency, world.sample_rate / n)
        volts = idct(dct(volts, norm="ortho") / np.sqrt(density), norm="ortho")
    white = [volts / noise.sd]
    if world.angle_sd is not None:
        white.append(channels["angle_x"] / world.angle_sd)
    return np.concatenate(white)


def _hiding(scene: Scene, hidden: Iterable[Hidden]) -> Truth:
    """The scene's scanner with these effects in it."""
    truth = scene.world.truth
    for h in hidden:
        truth = h.effect.on(truth, scene, h.size, h.shape)
    return truth


def _nuisances(
    sealed: Sealed, world: World, truth: Truth, change: Callable[..., Array], here: Array
) -> Iterator[tuple[Array, float]]:
    """Columns of what a fit is free to move, and the weight of the prior that holds each: 1 of a tolerance, 0 none."""
    stated: dict[str, float] = world.device["x"]["tolerance"]
    for name, field in NOMINAL.items():
        if value := getattr(truth, field):
            moved: dict[str, float] = {field: value * (1 + 0.01 * stated.get(name, UNSTATED))}
            yield change(truth._replace(**moved), 0.01), 1.0
    for state, size in ((THETA, world.swing), (RATE, world.swing * world.omega)):
        initial = world.initial.copy()
        initial[state] += 1e-4 * size
        yield change(truth, 1e-4 / START, replace(world, initial=initial)), 1.0
    yield change(truth._replace(offset=truth.offset + 1e-3 * sealed.scene.height), 1e-3), 0.0
    t = world.times
    angle = here[world.samples :]
    silent = np.zeros(angle.size)
    if angle.size:
        yield np.concatenate([np.zeros(t.size), UNSTATED * angle]), 1.0
        yield np.concatenate([np.zeros(t.size), np.ones(t.size)]), 0.0
    for harmonic in range(1, len(sealed.noise.hum) + 1):
        turn = 2 * pi * sealed.noise.mains * harmonic * t
        for wave in (np.sin(turn), np.cos(turn)):
            yield np.concatenate([wave, silent]), 0.0
