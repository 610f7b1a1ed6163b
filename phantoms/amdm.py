"""Simulated recordings of one axis whose readout is the circuit itself, not the formula that the estimators use."""

from __future__ import annotations

import numpy as np

from phantoms.circuit import AmdmCircuit, run_circuit
from phantoms.sense_channels import quantise
from phantoms.waveforms import Waveform
from scanner.arrays import Array
from scanner.device import Axis
from scanner.integrator.nodes import to_nodes
from scanner.integrator.trajectories import integrate

STEPS_PER_SAMPLE = 8
"""Integration steps of mechanics and circuit per sample: 40 MHz for a recording at 5 MHz, which is 80 steps in a period
of the 500 kHz carrier."""


def record_through_circuit(
    axis: Axis,
    circuit: AmdmCircuit,
    drive: Waveform,
    duration: float,
    *,
    settle: float = 0.04,
    kick: float = 0.2,
    sample_rate: float = 5e6,
) -> tuple[Array, Array, Array]:
    """Return the noiseless output of the circuit under a drive that has run for ``settle`` seconds.

    Mechanics and circuit share a clock of ``STEPS_PER_SAMPLE`` steps a sample. The torque of the carrier acts on the
    mirror too.

    Args:
        axis: the true axis.
        circuit: of the readout.
        drive: voltage without the carrier.
        duration: of the recording, which starts at t = 0 [s].
        settle: time that the drive has run before [s].
        kick: angle from which the motion starts [rad].
        sample_rate: of the recording [Hz].

    Returns:
        (sense [V], angle [rad], drive voltage [V]) at the samples, shape (round(duration sample_rate),) each.
    """
    comb = axis.require_capacitance()
    clock = STEPS_PER_SAMPLE * sample_rate
    before, n = round(settle * sample_rate) * STEPS_PER_SAMPLE, round(duration * sample_rate) * STEPS_PER_SAMPLE
    half_steps = (np.arange(2 * (before + n) + 1) - 2 * before) / (2 * clock)
    volt = drive(half_steps)
    angle, rate = integrate(axis, (kick, 0.0), to_nodes(volt + circuit.carrier(half_steps)), 1 / clock)
    cut = slice(
        max(0, before - round(2e-4 * clock)), before + n
    )  # from 0.2 ms before t = 0, so that the sections have settled
    stages = run_circuit(circuit, comb, angle[cut], rate[cut], volt[::2][cut], clock, (cut.start - before) / clock)
    samples = slice(before - cut.start, None, STEPS_PER_SAMPLE)
    return stages.y[samples], angle[cut][samples], volt[::2][cut][samples]


def digitise(
    sense: Array, noise_sd: float, bits: int | None, rng: np.random.Generator, full_range: float = 10.0
) -> Array:
    """Return the sense channel (n,) [V] after white noise of ``noise_sd`` [V] and the converter."""
    return quantise(sense + rng.normal(0.0, noise_sd, sense.size), bits, full_range)
