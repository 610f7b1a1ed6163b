"""One blind recording: a scenario, the effects injected into it, its key, and the file that a diagnosis reads."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import tomli_w
from numpy.typing import NDArray

from benchmarks.blind.effects import CATALOGUE, Effect, InjectedEffect, SizeReference
from benchmarks.blind.imaging import imaging, intensity, partner_angle, with_partner_drift
from benchmarks.blind.imperfections import IMPERFECTIONS
from benchmarks.blind.large_misfit import LARGE_FAMILIES
from benchmarks.blind.motion import THETA
from benchmarks.blind.noise import KINDS, Noise
from benchmarks.blind.out_of_catalogue import OUT_OF_CATALOGUE, SINE_STIFFNESS
from benchmarks.blind.readout import apply_limit, digitise, noiseless_channels, settle_start, simulate_motion
from benchmarks.blind.scanner_truth import Truth
from benchmarks.blind.scenarios import FAMILIES, Scenario
from benchmarks.blind.share import PlacedImperfection, place_imperfection
from benchmarks.blind.unused import other_experiment

Array = NDArray[np.float64]
Rng = np.random.Generator

EFFECTS: dict[str, Effect] = {effect.name: effect for effect in (*CATALOGUE, *OUT_OF_CATALOGUE, SINE_STIFFNESS)}
ALL_FAMILIES = {**FAMILIES, "imaging": imaging, **LARGE_FAMILIES}
FIXED_SIZES = {"strong-spring": 0.3}
"""Size of the effect in families whose size is not drawn."""
MAX_DRAWS = 40
"""Draws of scenario and size before a case is refused. Sizes shrink by 0.9 of their logarithmic range at every draw, so
40 reach the smallest size to 2 %; an effect that still ends the oscillation cannot be recorded."""


@dataclass(frozen=True)
class Case:
    """The specification of one recording.

    Attributes:
        name: of the recording.
        kind: ``"none"``, ``"one"``, ``"two"`` or ``"unlisted"``.
        family: see :data:`ALL_FAMILIES`.
        effects: names of the injected effects.
        noise: kind of noise, see :mod:`benchmarks.blind.noise`.
        seed: of all random draws.
        imperfection: name of an unlisted imperfection beside the effects, empty for none.
        noise_scale: factor on the family's noise; the device file states the scaled noise.
    """

    name: str
    kind: str
    family: str
    effects: tuple[str, ...]
    noise: str
    seed: int
    imperfection: str = ""
    noise_scale: float = 1.0


@dataclass(frozen=True)
class BlindRecording:
    """A recording and all that is known of it.

    Attributes:
        scenario: with the settled initial state of the truth.
        truth: with all injected effects.
        noise: of the sense channel.
        channels: as recorded, name -> (samples,).
    """

    case: Case
    scenario: Scenario
    reference: SizeReference
    truth: Truth
    injected: tuple[InjectedEffect, ...]
    imperfection: PlacedImperfection | None
    noise: Noise
    channels: dict[str, Array]

    def key(self) -> dict[str, Any]:
        """The key, which only the scorer may read."""
        placed = self.imperfection
        beside = (
            None
            if placed is None
            else {
                "name": placed.imperfection.name,
                "stage": placed.imperfection.stage,
                "share": placed.share,
                "law_share": 1 - placed.share,
                "misfit_sigma": float(np.sqrt(placed.misfit)),
                "fields": placed.fields,
            }
        )
        return {
            "imperfection": beside,
            "kind": self.case.kind,
            "family": self.case.family,
            "coloured": self.case.noise != "white",
            "noise": self.case.noise,
            "noise_scale": self.case.noise_scale,
            "angle": self.scenario.angle_sd is not None,
            "seed": self.case.seed,
            "effects": [
                {
                    "effect": h.effect.name,
                    "stage": h.effect.stage,
                    "axis": "x",
                    "listed": h.effect.listed,
                    "also_right": list(h.effect.also_right),
                    "size": h.size,
                    "parameters": h.effect.key(h.fields),
                }
                for h in self.injected
            ]
            + self._partner_effects(),
        }

    def _partner_effects(self) -> list[dict[str, Any]]:
        """The drift of y's resonance, if there is one."""
        partner = self.scenario.partner
        if partner is None or not partner.truth.dk:
            return []
        parameters = {"dk": partner.truth.dk, "tau": partner.truth.dk_tau}
        return [
            {"effect": "resonance-drift", "stage": "mechanics", "axis": "y", "listed": True, "also_right": [],
             "size": partner.truth.dk, "parameters": parameters}
        ]  # fmt: skip

    def unused_channels(self) -> dict[str, Array]:
        """Another recording of the same scanner, for a test of the improved device."""
        rng = np.random.default_rng([self.case.seed, 2])
        other = settle_start(other_experiment(self.scenario, rng), self.truth)
        return record(other, self.truth, self.noise, rng)

    def true_angles(self) -> dict[str, Array]:
        """Both axes' true angles at the samples of an imaging scan, each (samples,) [rad]."""
        assert self.scenario.partner is not None
        x = simulate_motion(self.scenario, self.truth).at(self.scenario.times, THETA)
        return {"x": x, "y": partner_angle(self.scenario.partner, self.scenario.duration, self.scenario.times)}


def generate_recording(case: Case) -> BlindRecording:
    """The recording of ``case``.

    Raises:
        RuntimeError: the mirror swings in no draw.
    """
    rng = np.random.default_rng(case.seed)
    effects = [EFFECTS[name] for name in case.effects]
    for attempt in range(MAX_DRAWS):
        scenario = with_scaled_noise(ALL_FAMILIES[case.family](rng), case.noise_scale)
        if not all(effect.is_visible_in(scenario) for effect in effects):
            continue
        if scenario.partner is not None and "resonance-drift" in case.effects:
            scenario = with_partner_drift(
                scenario, rng.choice([-1, 1]) * 10 ** rng.uniform(-3.3, -2.7), scenario.duration * rng.uniform(0.3, 1.0)
            )
        settled = settle_start(scenario, scenario.truth)
        clean = noiseless_channels(settled, scenario.truth)["sense_x"]
        reference = SizeReference(scenario, 0.5 * float(clean.max() + clean.min()), 0.5 * float(np.ptp(clean)))
        fixed = FIXED_SIZES.get(case.family)
        truth, injected = inject_effects(scenario.truth, reference, effects, 0.9**attempt, rng, fixed)
        settled = settle_start(scenario, truth)
        if not swings(settled, truth):
            continue
        noise = _noise(scenario, reference, case.noise, rng)
        imperfection = None
        if case.imperfection:
            # From a separate random stream: the same seed gives the same scanner with and without imperfection.
            imperfection = place_imperfection(
                IMPERFECTIONS[case.imperfection],
                reference,
                noise,
                truth,
                injected,
                np.random.default_rng([case.seed, 1]),
            )
            if imperfection is None:
                continue
            truth = truth._replace(**imperfection.fields)
            settled = settle_start(scenario, truth)
        channels = record(settled, truth, noise, rng)
        return BlindRecording(case, settled, reference, truth, injected, imperfection, noise, channels)
    raise RuntimeError(f"{case.name}: no draw of {case.effects} in {case.family} keeps the mirror swinging")


def with_scaled_noise(scenario: Scenario, scale: float) -> Scenario:
    """The scenario with another level of the stated noise of its readouts."""
    if scale == 1.0:
        return scenario

    def scaled(table: dict[str, Any]) -> dict[str, Any]:
        if "noise_sd" in table:
            return table | {"noise_sd": scale * table["noise_sd"]}
        return table | {"noise_var": scale**2 * table["noise_var"]}

    device = dict(scenario.device)
    for name in ("x", "y"):
        if "readout" in device.get(name, {}):
            device[name] = device[name] | {"readout": scaled(device[name]["readout"])}
    if "readout" in device:
        device["readout"] = scaled(device["readout"])
    return replace(scenario, device=device)


def inject_effects(
    truth: Truth,
    reference: SizeReference,
    effects: list[Effect],
    size_scale: float,
    rng: Rng,
    fixed_size: float | None = None,
) -> tuple[Truth, tuple[InjectedEffect, ...]]:
    """The truth with every effect; ``size_scale`` below one draws smaller sizes.

    Parametric drive has a narrow stable branch. An effect that ends the motion leaves nothing to diagnose.
    """
    injected = []
    for effect in effects:
        low, _ = effect.sizes[reference.scenario.family]
        size, shape = effect.draw_size(reference.scenario.family, rng), rng.random(3)
        size = float(np.sign(size)) * (fixed_size or low * (abs(size) / low) ** size_scale)
        fields = effect.law(reference, truth, size, shape)
        truth = truth._replace(**fields)
        injected.append(InjectedEffect(effect, size, shape, fields))
    return truth, tuple(injected)


def swings(scenario: Scenario, truth: Truth) -> bool:
    """Whether the motion stays finite and, under parametric drive, large in every third of the recording."""
    theta = simulate_motion(scenario, truth).at(scenario.times, THETA)
    if not np.all(np.isfinite(theta)) or np.abs(theta).max() > 2 * scenario.swing:
        return False
    peaks = [np.abs(third[len(third) // 2 :]).max() for third in np.array_split(theta, 3)]
    return scenario.family != "drive" or min(peaks) > 0.4 * scenario.swing


def record(scenario: Scenario, truth: Truth, noise: Noise, rng: Rng) -> dict[str, Array]:
    """Every channel of the file, each (samples,)."""
    clean = noiseless_channels(scenario, truth)
    bits, full_scale = scenario.readout["bits"], scenario.full_scale or 4 * float(np.abs(clean["sense_x"]).max())
    noisy = apply_limit(clean["sense_x"] + noise.draw(scenario.times, rng, clean["sense_x"]), truth)
    channels = {
        "bias_x" if scenario.family == "ring" else "drive_x": scenario.command(scenario.times),
        "sense_x": digitise(noisy, bits, full_scale),
    }
    if scenario.angle_sd is not None:
        channels["angle_x"] = clean["angle_x"] + scenario.angle_sd * rng.standard_normal(scenario.samples)
    if scenario.partner is not None:
        partner, times = scenario.partner, scenario.times
        channels["drive_y"] = partner.drive(times)
        if "sense_y" in clean:
            channels["sense_y"] = digitise(
                clean["sense_y"] + noise.sd * rng.standard_normal(times.size), bits, full_scale
            )
        else:
            channels["sense"] = channels.pop("sense_x")
        x = simulate_motion(scenario, truth).at(times, THETA)
        channels["intensity"] = intensity(x, partner_angle(partner, scenario.duration, times), rng)
    return channels


def write(blind: BlindRecording, path: Path, channels: dict[str, Array] | None = None) -> None:
    """Write the recording, or other channels of it, without its key; the file appears complete or not at all."""
    part = path.with_suffix(".part")
    with h5py.File(part, "w") as file:
        file.attrs.update({"format": "lissajous-recording", "version": 1, "name": blind.case.name})
        file.create_group("device").attrs["toml"] = tomli_w.dumps(blind.scenario.device)
        for name, values in (channels or blind.channels).items():
            data = file.create_dataset(
                f"channels/{name}", data=values.astype(np.float32), compression="gzip", compression_opts=4, shuffle=True
            )
            unit = "rad" if name.startswith("angle") else "1" if name == "intensity" else "V"
            data.attrs.update({"unit": unit, "sample_rate": blind.scenario.sample_rate, "start": 0.0})
    os.replace(part, path)


def _noise(scenario: Scenario, reference: SizeReference, kind: str, rng: Rng) -> Noise:
    readout = scenario.readout
    sd = float(np.sqrt(readout["noise_var"])) if "noise_var" in readout else readout["noise_sd"]
    swing = abs(reference.middle) + reference.height
    return KINDS[kind](sd, scenario.sample_rate, scenario.duration, swing, rng)
