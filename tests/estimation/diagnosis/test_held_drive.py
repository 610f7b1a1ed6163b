"""A drive that a converter holds between its samples is recognised by its delay."""

from __future__ import annotations

import numpy as np
import pytest

from estimation.diagnosis.diagnose import diagnose
from estimation.diagnosis.finding import Finding, ParameterEstimate
from estimation.diagnosis.held_drive import with_held_drives
from scanner.active_terms import stated_terms
from scanner.device import Axis, Device
from scanner.forward_model import DriveInput, sense_signal, simulate_axis
from scanner.integrator.nodes import to_nodes
from scanner.recording import Recording
from scanner.stages import Drive, Mechanics, Position

RESONANCE = 2 * np.pi * 1000.0
DEVICE = Device(
    "stage",
    {
        "x": Axis(
            Mechanics(1.0, RESONANCE / 60.0, RESONANCE**2),
            drive=Drive("linear", 1e5),
            readout=Position(100.0, 2e-3),
            tolerance={"J": 1e-9, "gain": 1e-9, "k": 0.02, "b": 0.2, "torque_per_volt": 0.05},
            name="x",
        )
    },
)


@pytest.mark.parametrize(("rate", "held"), [(4e4, True), (4e4, False), (1.2e4, True)])
def test_a_delay_of_half_a_sample_of_the_drive_is_that_of_a_converter(rate: float, held: bool) -> None:
    """At 12 samples a period two low-pass filters share the delay."""
    rng, axis, count, parts = np.random.default_rng(9), DEVICE.axes["x"], round(0.2 * rate), 8
    delay = 0.0 if held else 0.7 / rate
    fine = np.arange(2 * parts * count + 1) / (2 * parts * rate)  # the samples, and 2 * parts - 1 times between
    time = (np.floor(fine * rate + 1e-9) / rate if held else fine) - delay
    drive = np.sin(2 * np.pi * 980.0 * time) + np.sin(2 * np.pi * 1030.0 * time)
    motion = simulate_axis(axis, stated_terms(axis), DriveInput(to_nodes(drive), 1 / (parts * rate)), (0.0, 0.0))
    signal = sense_signal(axis.require_readout(), [motion])[::parts][:count]
    sensed = signal + axis.require_readout().noise_sd * rng.standard_normal(count)
    recorded = np.sin(2 * np.pi * 980.0 * fine[: -1 : 2 * parts]) + np.sin(2 * np.pi * 1030.0 * fine[: -1 : 2 * parts])
    channels = {"drive_x": (recorded, "V", rate, 0.0), "sense_x": (sensed, "V", rate, 0.0)}
    findings = diagnose([Recording.from_arrays(channels, DEVICE)]).findings
    assert {finding.effect for finding in findings} <= {"channel-delay", "drive-lag", "readout-lag"}
    advice = findings[0].advice or ""
    assert ("holds drive_x" in advice) == held
    assert (f"{0.5e6 / rate:.3g} µs" in advice) == held


def test_a_delay_of_one_of_two_channels_is_not_that_of_a_converter() -> None:
    """A late drive delays both."""
    rate, values = 4e4, np.zeros(100)
    delay = ParameterEstimate("delay", 0.5 / rate, (0.4 / rate, 0.6 / rate), "s")
    finding = Finding("x", "timing", "channel-delay", "", (delay,), "", 1.0, (), {}, "sense", "")
    channels = {name: (values, unit, rate, 0.0) for name, unit in (("drive_x", "V"), ("sense_x", "V"))}
    (alone,) = with_held_drives([finding], [Recording.from_arrays(channels, DEVICE)], DEVICE)
    channels["angle_x"] = (values, "rad", rate, 0.0)
    (beside,) = with_held_drives([finding], [Recording.from_arrays(channels, DEVICE)], DEVICE)
    assert "holds drive_x" in (alone.advice or "")
    assert beside.advice is None
