"""Short simulated recordings that several tests share, cached because a simulation takes longer than a test."""

from dataclasses import replace
from functools import cache

import numpy as np

from estimation.signals import phase_reference, sense_channels
from estimation.tracker.observations import BlockObservations, demodulate_blocks, lay_out_blocks
from phantoms.experiment import Experiment, simulate_experiment
from phantoms.forward import Plan, simulate
from phantoms.sense_channels import quantise
from phantoms.waveforms import Sine
from scanner import devices
from scanner.device import Device
from scanner.drift import Drift, exponential
from scanner.recording import Recording
from scanner.stages import Amdm

DRIVES = {"x": Sine(27680.0, 30.0, 30.0), "y": Sine(6540.0, 30.0, 30.0)}


@cache
def shared_electrode(duration: float = 0.012, drift: float = -0.002, seed: int = 0) -> tuple[Recording, dict]:
    """Both axes of the imaging scanner in one sense signal; no intensity."""
    plan = Plan(DRIVES, duration, drift={axis: Drift(exponential(drift, 0.025)) for axis in "xy"})
    return simulate(devices.load("imaging"), plan, seed=seed)


def own_electrodes() -> Device:
    """The imaging scanner with a readout for each axis."""
    device = devices.load("imaging")
    assert isinstance(device.readout, Amdm)
    readout = replace(device.readout, b_cir=4.95)  # half the sum of two combs is within the converter's range
    axes = {name: replace(axis, readout=readout) for name, axis in device.axes.items()}
    return replace(device, axes=axes, readout=None)


@cache
def separate_electrodes(duration: float = 0.012, drift: float = -0.002, seed: int = 0) -> tuple[Recording, dict]:
    """Each axis with its own sense signal."""
    plan = Plan(DRIVES, duration, drift={axis: Drift(exponential(drift, 0.025)) for axis in "xy"})
    return simulate(own_electrodes(), plan, seed=seed)


@cache
def imaging(duration: float = 0.02, seed: int = 1) -> tuple[Recording, dict]:
    """A scan of the tissue picture, as the demo's but shorter."""
    return simulate_experiment(Experiment(duration=duration), seed)


def with_sense(recording: Recording, change, device: Device | None = None) -> Recording:  # type: ignore[no-untyped-def]
    """The recording with each of its sense signals changed."""
    channels = {k: (c.read(), c.unit, c.sample_rate, c.start) for k, c in recording.channels.items()}
    for name in channels:
        if name.startswith("sense"):
            channels[name] = (change(channels[name][0].copy()), *channels[name][1:])
    return Recording.from_arrays(channels, device or recording.device)


@cache
def quiet() -> tuple[Recording, dict]:
    """Both axes in one sense signal, drifting, without noise."""
    device = devices.load("imaging")
    assert isinstance(device.readout, Amdm)
    silent = replace(device, readout=replace(device.readout, noise_var=0.0, bits=None))
    plan = Plan(DRIVES, 0.03, drift={axis: Drift(exponential(-0.002, 0.025)) for axis in "xy"})
    return simulate(silent, plan)


def noisy(seed: int, sd: float = 0.01386) -> Recording:
    """The noiseless recording with noise of a seed. A simulation for each seed would take a hundred times longer."""
    rng = np.random.default_rng(seed)
    return with_sense(
        quiet()[0], lambda y: quantise(y + rng.normal(0.0, sd, y.size), 12, 10.0), devices.load("imaging")
    )


@cache
def prepared_of(seed: int) -> BlockObservations:
    """The blocks of ``noisy``."""
    return blocks_of(noisy(seed), devices.load("imaging"))


def blocks_of(recording: Recording, device: Device) -> BlockObservations:
    """The blocks of a recording's only sense signal."""
    (sense,) = sense_channels(recording, device)
    references = {n: phase_reference(recording, device, n, sense.channel, True) for n in sense.axes}
    return demodulate_blocks(lay_out_blocks(recording, device, sense, references))
