"""An imaging experiment in a few numbers: device, drives, drift, target, spot, light."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from phantoms.forward import Plan, Scene, simulate
from phantoms.optics import Detector, blur
from phantoms.targets import target
from phantoms.waveforms import Sine, Waveform
from scanner import devices
from scanner.device import Device
from scanner.drift import Drift, settling
from scanner.errors import BadInput
from scanner.recording import Recording


@dataclass(frozen=True)
class Experiment:
    """A two-axis scan of a target while both resonances drift.

    Attributes:
        device: the true device; a field of view is needed.
        target: name of a target or an image file.
        drives: voltage on each axis's combs.
        duration: [s]. sample_rate: of all channels [Hz].
        drift: relative change of each axis's stiffness in the end. drift_tau: its time constant [s].
        field_um: width of the field on the sample [um]; its height follows from the half angles.
        spot_um: standard deviation of the beam's spot [um].
        detector: of the light.
        angles: record the true angles as reference channels too.
    """

    device: Device = field(default_factory=lambda: devices.load("imaging"))
    target: str = "immunohistochemistry"
    drives: Mapping[str, Waveform] = field(
        default_factory=lambda: {"x": Sine(27680.0, 30.0, 30.0), "y": Sine(6540.0, 30.0, 30.0)}
    )
    duration: float = 0.06
    sample_rate: float = 5e6
    drift: Mapping[str, float] = field(default_factory=lambda: {"x": -0.002, "y": -0.002})
    drift_tau: float = 0.025
    field_um: float = 250.0
    spot_um: float = 0.4
    detector: Detector = field(default_factory=lambda: Detector(photons_per_sample=1000.0, bits=12))
    angles: bool = False


def run(experiment: Experiment, seed: int = 0, nominal: Device | None = None) -> tuple[Recording, dict[str, object]]:
    """The recording of an experiment and its truth (see ``phantoms.forward.simulate``).

    Args:
        nominal: the device that the recording states, where its calibration differs from the truth.
    """
    view = experiment.device.require_scan()
    height_um = experiment.field_um * view.half_angle_y / view.half_angle_x
    light = blur(target(experiment.target), experiment.spot_um, experiment.field_um, height_um)
    plan = Plan(
        drives=experiment.drives,
        duration=experiment.duration,
        sample_rate=experiment.sample_rate,
        drift={axis: Drift(settling(change, experiment.drift_tau)) for axis, change in experiment.drift.items()},
        angles=experiment.angles,
    )
    recording, truth = simulate(experiment.device, plan, Scene(light, experiment.detector), seed, nominal=nominal)
    return recording, truth | {"spot_sd": experiment.spot_um / experiment.field_um}  # of the field's width


def device_named(name: str) -> Device:
    """A device by the name it comes with, else from a TOML file.

    Raises:
        BadInput: neither.
    """
    if name in devices.names():
        return devices.load(name)
    if not Path(name).exists():
        raise BadInput(f"no device is named {name!r} and no file is", hint=f"there are {', '.join(devices.names())}")
    return Device.load(name)
