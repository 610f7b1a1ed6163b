"""Signals of the motion that are swapped, doubled or at a wrong rate are named before a picture is made of them."""

from __future__ import annotations

import numpy as np
import pytest

from recon.preparation import prepare
from scanner.device import Device
from scanner.device_templates import KnownAxis, new_device
from scanner.errors import BadInput
from scanner.recording import Recording

RATE = 1e5
TIME = np.arange(20_000) / RATE
DEVICE = Device.from_toml(new_device("electromagnetic", {"x": KnownAxis(2000.0), "y": KnownAxis(835.0)}))


def scan(frequency_x: float, frequency_y: float, rate: float = RATE, light: int = TIME.size) -> Recording:
    rng = np.random.default_rng(2)
    channels = {
        f"sense_{axis}": (np.sin(2 * np.pi * frequency * TIME) + rng.normal(0, 1e-3, TIME.size), "V", rate)
        for axis, frequency in (("x", frequency_x), ("y", frequency_y))
    }
    return Recording.from_arrays({**channels, "intensity": (rng.poisson(20, light).astype(float), "", rate)}, DEVICE)


def test_swapped_sensors_without_a_drive_are_named() -> None:
    with pytest.raises(BadInput, match=r"sense_x: and sense_y are swapped: they show x at 83"):
        prepare(scan(835.0, 2000.0))


def test_a_time_column_in_the_wrong_unit_is_named() -> None:
    with pytest.raises(BadInput, match=r"as if the sample rate were 0\.001 times the true one"):
        prepare(scan(2000.0, 835.0, 1e-3 * RATE))


def test_one_column_for_both_axes_is_named() -> None:
    recording = scan(2000.0, 835.0)
    same = {name: (recording["sense_x"].read(), "V", RATE) for name in ("sense_x", "sense_y")}
    light = {"intensity": (recording["intensity"].read(), "", RATE)}
    with pytest.raises(BadInput, match="sense_y hold the same samples; check the mapping"):
        prepare(Recording.from_arrays(same | light, DEVICE))


def test_an_intensity_that_covers_half_the_recording_is_noted() -> None:
    assert not prepare(scan(2000.0, 835.0)).unknown_entries
    (note,) = prepare(scan(2000.0, 835.0, light=TIME.size // 2)).unknown_entries
    assert "intensity: covers 50% of the recording" in note
