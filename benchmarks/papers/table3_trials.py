"""Trials of chen2020 Table III: recordings of the circuit over the sustained band, and miscalibrated devices.

The estimator's device differs from the true one by ``ERRORS``, drawn for each trial.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from estimation.identification.fits import DrivenRecord
from phantoms.amdm import digitise, record_through_circuit
from phantoms.circuit import AmdmCircuit, match_gain
from phantoms.waveforms import Sine
from scanner.arrays import Array
from scanner.device import Axis
from scanner.devices import load

RATE = 5e6
PSD_NOISE = 2e-4  # rad, of the position detector used for calibration

ERRORS = {"scale": 0.05, "k": 0.002, "b": 0.05, "C0": 0.01, "theta0": 0.01, "lpf_hz": 0.02}
"""Relative standard deviation of the estimator's nominal values. ``scale`` applies to J, b and k together: a ringdown
determines their ratios, and J comes from dimensions of the design. ``k``: a shift of the resonance by 0.1 % after the
calibration, which a few degrees of warming cause."""


@dataclass(frozen=True)
class Scene:
    """True recordings without noise: sense [V], angle [rad], drive [V] at each drive frequency."""

    frequencies: Array
    records: Sequence[tuple[Array, Array, Array]]
    axis: Axis
    circuit: AmdmCircuit


def scene(count: int = 15, duration: float = 0.016, low: float = 31400.0, high: float = 31580.0) -> Scene:
    """Recordings over the band of a miscalibrated device; the true one oscillates from 31.26 to 31.68 kHz."""
    axis = load("chen2020-driven").axis("x")
    readout, comb = axis.require_readout(), axis.require_capacitance()
    circuit = match_gain(AmdmCircuit(), comb, 0.15, readout.a_cir, readout.b_cir)
    frequencies = np.linspace(low, high, count)
    records = [record_through_circuit(axis, circuit, Sine(f, 30.0, 30.0), duration) for f in frequencies]
    return Scene(frequencies, records, axis, circuit)


def miscalibrated(axis: Axis, rng: np.random.Generator) -> Axis:
    """The axis with errors of calibration: every value changed by a draw of ``ERRORS``."""
    off = {key: 1.0 + sd * rng.standard_normal() for key, sd in ERRORS.items()}
    m, comb, readout = axis.require_mechanics(), axis.require_capacitance(), axis.require_readout()
    return replace(
        axis,
        mechanics=replace(m, J=m.J * off["scale"], b=m.b * off["scale"] * off["b"], k=m.k * off["scale"] * off["k"]),
        capacitance=replace(comb, C0=comb.C0 * off["C0"], theta0=comb.theta0 * off["theta0"]),
        readout=replace(readout, lpf_hz=tuple(f * off["lpf_hz"] for f in readout.lpf_hz)),
    )


@dataclass(frozen=True)
class Trial:
    """One draw: noisy recordings and the nominal axis."""

    scene: Scene
    axis: Axis
    senses: Sequence[Array]
    references: Sequence[DrivenRecord]


def trial(of: Scene, seed: int) -> Trial:
    rng = np.random.default_rng(seed)
    axis = miscalibrated(of.axis, rng)
    readout = of.axis.require_readout()
    senses = [digitise(sense, readout.noise_sd, readout.bits, rng) for sense, _, _ in of.records]
    references = [
        DrivenRecord(angle + PSD_NOISE * rng.standard_normal(angle.size), drive, f / 2, RATE)
        for f, (_, angle, drive) in zip(of.frequencies, of.records, strict=True)
    ]
    return Trial(of, axis, senses, references)
