"""Small simulated recordings that several tests share; cached, because a simulation costs more than a test."""

from dataclasses import replace
from functools import cache

from phantoms.experiment import Experiment, run
from phantoms.forward import Plan, simulate
from phantoms.waveforms import Sine
from scanner import devices
from scanner.device import Amdm, Device
from scanner.drift import Drift, settling
from scanner.recording import Recording

DRIVES = {"x": Sine(27680.0, 30.0, 30.0), "y": Sine(6540.0, 30.0, 30.0)}


@cache
def shared_electrode(duration: float = 0.012, drift: float = -0.002, seed: int = 0) -> tuple[Recording, dict]:
    """Both axes of the imaging scanner in one sense signal; no intensity."""
    plan = Plan(DRIVES, duration, drift={axis: Drift(settling(drift, 0.025)) for axis in "xy"})
    return simulate(devices.load("imaging"), plan, seed=seed)


def own_electrodes() -> Device:
    """The imaging scanner with a readout for each axis."""
    device = devices.load("imaging")
    assert isinstance(device.readout, Amdm)
    readout = replace(device.readout, b_cir=4.95)  # half the sum of two combs stays within the converter's range
    axes = {name: replace(axis, readout=readout) for name, axis in device.axes.items()}
    return replace(device, axes=axes, readout=None)


@cache
def separate_electrodes(duration: float = 0.012, drift: float = -0.002, seed: int = 0) -> tuple[Recording, dict]:
    """Each axis with its own sense signal."""
    plan = Plan(DRIVES, duration, drift={axis: Drift(settling(drift, 0.025)) for axis in "xy"})
    return simulate(own_electrodes(), plan, seed=seed)


@cache
def imaging(duration: float = 0.02, seed: int = 1) -> tuple[Recording, dict]:
    """A scan of the tissue picture, as the demo's but shorter."""
    return run(Experiment(duration=duration), seed)
