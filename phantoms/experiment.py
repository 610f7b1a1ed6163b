"""An imaging experiment as a few parameters: device, drives, drift, target, spot, detector."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from phantoms.forward import Plan, Scene, check_plan, simulate
from phantoms.optics import Detector, blur_by_spot, imaging_detector
from phantoms.targets import make_target
from phantoms.waveforms import Sine, Waveform
from scanner import devices
from scanner.device import AXES, Device
from scanner.device_toml import FINITE, NOT_NEGATIVE, POSITIVE, check_values, checked_number
from scanner.drift import Drift, exponential
from scanner.errors import BadInput
from scanner.recording import Recording

IMAGING_DRIVES = {"x": Sine(27680.0, 30.0, 30.0), "y": Sine(6540.0, 30.0, 30.0)}
"""Drives of the named device ``imaging``, with the frequencies of the papers."""

MAX_SPOT_FIELDS = 0.25
"""Largest standard deviation of the beam's spot over the field's width or height. Within two standard deviations to
either side such a spot covers the whole field, and its convolution takes half a minute."""

SETTLING_TIME_CONSTANTS, MIN_SETTLING_S = 4.0, 0.05
"""Time constants of the slowest decay, and least time [s], after which the amplitude is 98 % of its final value."""


@dataclass(frozen=True)
class Experiment:
    """A two-axis scan of a target while both resonances drift.

    Attributes:
        device: the true device; it needs a field of view.
        target: name of a target, or path of an image file.
        drives: voltage on the combs of each axis.
        duration: of the recording [s].
        sample_rate: of all channels [Hz].
        drift: relative change of each axis's stiffness that the drift approaches.
        drift_tau: time constant of the exponential drift [s].
        field_um: width of the field on the sample [um]; its height follows from the half angles.
        spot_um: standard deviation of the beam's spot [um].
        detector: that converts the light to a voltage.
        angles: whether the true angles are recorded as reference channels too.
    """

    device: Device = field(default_factory=lambda: devices.load("imaging"))
    target: str = "immunohistochemistry"
    drives: Mapping[str, Waveform] = field(default_factory=lambda: IMAGING_DRIVES)
    duration: float = field(default=0.06, metadata=POSITIVE)
    sample_rate: float = field(default=5e6, metadata=POSITIVE)
    drift: Mapping[str, float] = field(default_factory=lambda: {"x": -0.002, "y": -0.002})
    drift_tau: float = field(default=0.025, metadata=POSITIVE)
    field_um: float = field(default=250.0, metadata=POSITIVE)
    spot_um: float = field(default=0.4, metadata=NOT_NEGATIVE)
    detector: Detector = field(default_factory=lambda: imaging_detector(1000.0))
    angles: bool = False

    def __post_init__(self) -> None:
        check_values(self)
        for axis, change in self.drift.items():
            if axis not in AXES:
                raise BadInput(f"names {axis!r}", channel="drift", hint=f"name the axes {' and '.join(AXES)}")
            if checked_number(change, FINITE["must"], "drift") <= -1.0:
                raise BadInput(f"is {change:g}", channel="drift", hint="give a relative change above -1")


def plan_experiment(experiment: Experiment) -> tuple[Plan, Scene]:
    """Return what the simulation of an experiment takes, after all checks that need no simulation.

    Args:
        experiment: device, drives, drift, target, spot and detector.

    Raises:
        DeviceInvalid: the device has no field of view, a single axis, or lacks a value that the simulation needs.
        BadInput: the target is neither a known name nor a picture file, its pixels are too coarse for the spot, the
            spot is too wide for the field, or duration and sample rate cannot be simulated.
    """
    for name in AXES:
        experiment.device.axis(name)
    view = experiment.device.require_scan()
    height_um = experiment.field_um * view.half_angle_y / view.half_angle_x
    if experiment.spot_um > MAX_SPOT_FIELDS * min(experiment.field_um, height_um):
        what = f"a beam spot with a standard deviation of {experiment.spot_um:g} um is too wide for a field of "
        what += f"{experiment.field_um:g} x {height_um:.4g} um"
        raise BadInput(what, hint=f"give {MAX_SPOT_FIELDS:g} of the field or less")
    light = blur_by_spot(make_target(experiment.target), experiment.spot_um, experiment.field_um, height_um)
    plan = Plan(
        drives=experiment.drives,
        duration=experiment.duration,
        sample_rate=experiment.sample_rate,
        settle=settling_time(experiment.device),
        drift={axis: Drift(exponential(change, experiment.drift_tau)) for axis, change in experiment.drift.items()},
        references=("angle",) if experiment.angles else (),
    )
    check_plan(experiment.device, plan)
    return plan, Scene(light, experiment.detector)


def simulate_experiment(
    experiment: Experiment, seed: int = 0, nominal: Device | None = None
) -> tuple[Recording, dict[str, object]]:
    """Return the recording of an experiment and its truth.

    Args:
        experiment: device, drives, drift, target, spot and detector.
        seed: of all random noise; the same seed gives the same samples.
        nominal: the device that the recording states, if its calibration differs from the true device.

    Returns:
        The recording, and the truth as ``Recording.write`` takes it: that of ``phantoms.forward.simulate``, and
        ``spot_sd``, the standard deviation of the spot as a fraction of the field's width.

    Raises:
        BadInput: as :func:`plan_experiment`; or the drives sustain no motion, or one without limit.
    """
    plan, scene = plan_experiment(experiment)
    recording, truth = simulate(experiment.device, plan, scene, seed, nominal=nominal)
    return recording, truth | {"spot_sd": experiment.spot_um / experiment.field_um}


def settling_time(device: Device) -> float:
    """Return the time after which the amplitudes of a device have settled [s]."""
    decays = [axis.quality / (np.pi * axis.resonance) for axis in device.axes.values() if axis.mechanics]
    return max(MIN_SETTLING_S, SETTLING_TIME_CONSTANTS * max(decays, default=0.0))
