"""The drive at which an axis keeps swinging over its field: against the simulated motion."""

import numpy as np
import pytest

from phantoms.experiment import Experiment, simulate_experiment
from phantoms.waveforms import Sine
from scanner.device import AXES, Device
from scanner.device_templates import KnownAxis, new_device
from scanner.steady_drive import steady_drive


@pytest.mark.parametrize(
    ("kind", "known"),
    [
        ("electromagnetic", KnownAxis(2000.0, 40.0, 0.05)),
        ("galvo", KnownAxis(7960.0, 100.0, 0.08)),
        ("parametric", KnownAxis(8000.0, 60.0, 0.1)),
        ("parametric", KnownAxis(24000.0, 400.0, 0.15)),
    ],
)
def test_the_motion_fills_the_field(kind: str, known: KnownAxis) -> None:
    other = KnownAxis(0.31 * (known.resonance or 1.0), known.quality, known.amplitude)
    device = Device.from_toml(new_device(kind, {"x": known, "y": other}))
    half_angles = dict(zip(AXES, device.require_scan().mechanical_half_angles, strict=True))
    drives = {name: Sine(*steady_drive(axis, half_angles[name])) for name, axis in device.axes.items()}
    still = dict.fromkeys(AXES, 0.0)
    _, truth = simulate_experiment(Experiment(device=device, drives=drives, duration=0.01, drift=still))
    for axis in AXES:
        reached = np.abs(np.asarray(truth[f"angle_{axis}"][0])).max()  # type: ignore[index]
        assert reached == pytest.approx(half_angles[axis], rel=0.1)


def test_a_stated_frequency_is_used() -> None:
    """Far below the resonance the angle is the static one."""
    text = new_device("galvo", {})
    axis = Device.from_toml(text.replace("# frequency", "frequency")).axis("y")
    frequency, volts, offset = steady_drive(axis, 0.08)
    drive = axis.require_drive()
    assert frequency == drive.frequency
    assert drive.torque_per_volt is not None
    assert volts == pytest.approx(0.08 * axis.require_mechanics().k / drive.torque_per_volt, rel=0.05)
    assert offset == 0.0
