"""One sealed recording: a world, what is hidden in it, and the file that a diagnosis is given.

The key (what is hidden) and the recording leave this module apart; who writes them keeps them apart.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import tomli_w
from numpy.typing import NDArray

from benchmarks.concealed.effects import CATALOGUE, Effect, Scene, Shape
from benchmarks.concealed.motion import THETA
from benchmarks.concealed.readout import Noise, digitise, limited, move, observe, settle
from benchmarks.concealed.scanner_truth import Truth
from benchmarks.concealed.unlisted import UNLISTED
from benchmarks.concealed.worlds import FAMILIES, World

Array = NDArray[np.float64]
Rng = np.random.Generator

EFFECTS: dict[str, Effect] = {effect.name: effect for effect in CATALOGUE + UNLISTED}
DRAWS = 40
"""Worlds and sizes drawn for one recording before it is given up."""


@dataclass(frozen=True)
class Order:
    """What is asked for.

    Attributes:
        name: of the recording.
        kind: ``"none"``, ``"one"``, ``"two"`` or ``"unlisted"``.
        family: see :mod:`benchmarks.concealed.worlds`.
        effects: names of what is hidden.
        coloured: the noise has a colour that the device file does not tell.
        seed: of everything that is drawn.
    """

    name: str
    kind: str
    family: str
    effects: tuple[str, ...]
    coloured: bool
    seed: int


@dataclass(frozen=True)
class Hidden:
    """One effect as drawn: its size, its shape and the numbers they became."""

    effect: Effect
    size: float
    shape: Shape
    fields: dict[str, float]


@dataclass(frozen=True)
class Sealed:
    """A recording and everything that is known of it.

    Attributes:
        world: settled, so that its initial state is the truth's own.
        truth: with all that is hidden.
        noise: of the sense channel.
        channels: as recorded, name -> (samples,).
    """

    order: Order
    world: World
    scene: Scene
    truth: Truth
    hidden: tuple[Hidden, ...]
    noise: Noise
    channels: dict[str, Array]

    def key(self) -> dict[str, Any]:
        """What only a scorer may read."""
        return {
            "kind": self.order.kind,
            "family": self.order.family,
            "coloured": self.order.coloured,
            "angle": self.world.angle_sd is not None,
            "seed": self.order.seed,
            "effects": [
                {
                    "effect": h.effect.name,
                    "stage": h.effect.stage,
                    "listed": h.effect.listed,
                    "size": h.size,
                    "parameters": h.effect.key(h.fields),
                }
                for h in self.hidden
            ],
        }


def seal(order: Order) -> Sealed:
    """The recording that ``order`` asks for; RuntimeError where no draw of it can be recorded at all."""
    rng = np.random.default_rng(order.seed)
    effects = [EFFECTS[name] for name in order.effects]
    for attempt in range(DRAWS):
        world = FAMILIES[order.family](rng)
        if not all(effect.shows_in(world) for effect in effects):
            continue
        settled = settle(world, world.truth)
        clean = observe(settled, world.truth)["sense_x"]
        scene = Scene(world, 0.5 * float(clean.max() + clean.min()), 0.5 * float(np.ptp(clean)))
        truth, hidden = conceal(world.truth, scene, effects, 0.9**attempt, rng)
        settled = settle(world, truth)
        if not swings(settled, truth):
            continue
        noise = _noise(world, order.coloured, rng)
        return Sealed(order, settled, scene, truth, hidden, noise, record(settled, truth, noise, rng))
    raise RuntimeError(f"{order.name}: no draw of {order.effects} in {order.family} keeps the mirror swinging")


def conceal(
    truth: Truth, scene: Scene, effects: list[Effect], modesty: float, rng: Rng
) -> tuple[Truth, tuple[Hidden, ...]]:
    """The truth with every effect in it; ``modesty`` below one draws sizes from the lower part of their range.

    Parametric drive lives on a narrow branch: an effect that would end the motion leaves nothing to diagnose.
    """
    hidden = []
    for effect in effects:
        low, _ = effect.sizes[scene.world.family]
        size, shape = effect.draw_size(scene.world.family, rng), rng.random(3)
        size = float(np.sign(size)) * low * (abs(size) / low) ** modesty
        fields = effect.law(scene, truth, size, shape)
        truth = truth._replace(**fields)
        hidden.append(Hidden(effect, size, shape, fields))
    return truth, tuple(hidden)


def swings(world: World, truth: Truth) -> bool:
    """Whether the motion is one that a scanner would be used at, in every third of the recording."""
    theta = move(world, truth).at(world.times, THETA)
    if not np.all(np.isfinite(theta)) or np.abs(theta).max() > 2 * world.swing:
        return False
    peaks = [np.abs(third[len(third) // 2 :]).max() for third in np.array_split(theta, 3)]
    return world.family != "drive" or min(peaks) > 0.4 * world.swing


def record(world: World, truth: Truth, noise: Noise, rng: Rng) -> dict[str, Array]:
    """Every channel of the file, (samples,) each."""
    clean = observe(world, truth)
    full_scale = world.full_scale or 4 * float(np.abs(clean["sense_x"]).max())
    noisy = limited(clean["sense_x"] + noise.draw(world.times, rng), truth)
    channels = {
        "bias_x" if world.family == "ring" else "drive_x": world.command(world.times),
        "sense_x": digitise(noisy, world.device["x"]["readout"]["bits"], full_scale),
    }
    if world.angle_sd is not None:
        channels["angle_x"] = clean["angle_x"] + world.angle_sd * rng.standard_normal(world.samples)
    return channels


def write(sealed: Sealed, path: Path) -> None:
    """The recording as a file, without a trace of what is hidden in it; it appears whole or not at all."""
    beside = path.with_suffix(".part")
    with h5py.File(beside, "w") as file:
        file.attrs.update({"format": "lissajous-recording", "version": 1, "name": sealed.order.name})
        file.create_group("device").attrs["toml"] = tomli_w.dumps(sealed.world.device)
        for name, values in sealed.channels.items():
            data = file.create_dataset(
                f"channels/{name}", data=values.astype(np.float32), compression="gzip", compression_opts=4, shuffle=True
            )
            unit = "rad" if name.startswith("angle") else "V"
            data.attrs.update({"unit": unit, "sample_rate": sealed.world.sample_rate, "start": 0.0})
    os.replace(beside, path)


def _noise(world: World, coloured: bool, rng: Rng) -> Noise:
    readout = world.device["x"]["readout"]
    sd = float(np.sqrt(readout["noise_var"])) if "noise_var" in readout else readout["noise_sd"]
    return Noise.coloured(sd, world.sample_rate, rng) if coloured else Noise(sd)
