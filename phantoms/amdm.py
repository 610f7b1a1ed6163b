"""A recording of one axis behind the circuit itself, not behind the formula that the estimators use for it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from phantoms.forward import quantised
from phantoms.waveforms import Waveform
from scanner.circuit import AmdmCircuit, run
from scanner.device import Axis
from scanner.trajectory import integrate, thirds

Array = NDArray[np.float64]

FINE = 8
"""Steps of mechanics and circuit a sample: 40 MHz for a recording at 5 MHz, 80 steps a carrier period."""


def recorded(
    axis: Axis,
    circuit: AmdmCircuit,
    drive: Waveform,
    duration: float,
    *,
    settle: float = 0.04,
    kick: float = 0.2,
    sample_rate: float = 5e6,
) -> tuple[Array, Array, Array]:
    """Noiseless output of the circuit under a drive that has run for ``settle`` seconds from an angle of ``kick``.

    Mechanics and circuit share a clock of ``FINE`` steps a sample; the mirror feels the carrier's torque too.

    Args:
        axis: the true axis. drive: voltage without the carrier. duration: of the recording, which starts at t = 0 [s].

    Returns:
        (sense [V], angle [rad], drive voltage [V]) at the samples, shape (round(duration sample_rate),) each.
    """
    comb = axis.require_capacitance()
    clock = FINE * sample_rate
    before, n = round(settle * sample_rate) * FINE, round(duration * sample_rate) * FINE
    half_steps = (np.arange(2 * (before + n) + 1) - 2 * before) / (2 * clock)
    volt = drive(half_steps)
    angle, rate = integrate(axis, (kick, 0.0), thirds(volt + circuit.carrier(half_steps)), 1 / clock)
    cut = slice(max(0, before - round(2e-4 * clock)), before + n)  # the sections' switching on stays before t = 0
    stages = run(circuit, comb, angle[cut], rate[cut], volt[::2][cut], clock, (cut.start - before) / clock)
    kept = slice(before - cut.start, None, FINE)
    return stages.y[kept], angle[cut][kept], volt[::2][cut][kept]


def digitised(
    sense: Array, noise_sd: float, bits: int | None, rng: np.random.Generator, full_range: float = 10.0
) -> Array:
    """A recording's sense channel: white noise of ``noise_sd`` [V] and a converter over +- full_range / 2."""
    return quantised(sense + rng.normal(0.0, noise_sd, sense.size), bits, full_range)
