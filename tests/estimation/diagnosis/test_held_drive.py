"""A drive that a converter holds between its samples is recognised by its delay."""

from __future__ import annotations

import numpy as np
import pytest

from estimation.diagnosis.diagnose import diagnose
from scanner.active_terms import stated_terms
from scanner.device import Axis, Device
from scanner.forward_model import DriveInput, sense_signal, simulate_axis
from scanner.integrator.nodes import to_nodes
from scanner.recording import Recording
from scanner.stages import Drive, Mechanics, Position

RATE, RESONANCE = 4e4, 2 * np.pi * 1000.0
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


@pytest.mark.parametrize("held", [True, False])
def test_a_delay_of_half_a_sample_of_the_drive_is_that_of_a_converter(held: bool) -> None:
    rng, axis, count, parts = np.random.default_rng(4), DEVICE.axes["x"], 8000, 8
    delay = 0.0 if held else 0.7 / RATE
    fine = np.arange(2 * parts * count + 1) / (2 * parts * RATE)  # the samples, and 2 * parts - 1 times between
    time = (np.floor(fine * RATE + 1e-9) / RATE if held else fine) - delay
    drive = np.sin(2 * np.pi * 980.0 * time) + np.sin(2 * np.pi * 1030.0 * time)
    motion = simulate_axis(axis, stated_terms(axis), DriveInput(to_nodes(drive), 1 / (parts * RATE)), (0.0, 0.0))
    signal = sense_signal(axis.require_readout(), [motion])[::parts][:count]
    sensed = signal + axis.require_readout().noise_sd * rng.standard_normal(count)
    recorded = np.sin(2 * np.pi * 980.0 * fine[: -1 : 2 * parts]) + np.sin(2 * np.pi * 1030.0 * fine[: -1 : 2 * parts])
    channels = {"drive_x": (recorded, "V", RATE, 0.0), "sense_x": (sensed, "V", RATE, 0.0)}
    (finding,) = diagnose([Recording.from_arrays(channels, DEVICE)]).findings
    assert finding.effect in ("channel-delay", "drive-lag", "readout-lag")
    assert ("holds drive_x" in (finding.advice or "")) == held
    assert not held or "12.5 µs" in (finding.advice or "")
