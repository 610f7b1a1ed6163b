"""A delay between angle and drive is fitted with the mechanics of a sweep."""

from __future__ import annotations

import re

import numpy as np
import pytest
from scipy.signal import lsim

from estimation.identification.calibrate import Identification, identify
from scanner.device import Axis, Device
from scanner.recording import Recording
from scanner.stages import Drive, Mechanics

W, QUALITY, INERTIA, RATE, FINER = 2 * np.pi * 1000.0, 50.0, 1e-10, 5e4, 10
DEVICE = Device(
    "mirror",
    {"x": Axis(Mechanics(INERTIA, INERTIA * W / QUALITY, INERTIA * W**2), drive=Drive("linear", 1e-7), name="x")},
)


def swept(delay: float) -> Identification:
    """A sweep whose angle is late by a delay [s], or early by a negative one."""
    time = np.arange(round(0.4 * RATE * FINER)) / (RATE * FINER)
    drive = 10.0 * np.sin(2 * np.pi * (950.0 * time + 0.5 * 250.0 * time**2))
    angle = lsim(([1e-7 / INERTIA], [1.0, W / QUALITY, W**2]), drive, time)[1]
    samples = round(delay * RATE * FINER)
    angle, drive = (np.roll(each, max(by, 0))[2000::FINER] for each, by in ((angle, samples), (drive, -samples)))
    noise = 1e-5 * np.random.default_rng(2).standard_normal(angle.size)
    channels = {"angle_x": (angle + noise, "rad", RATE), "drive_x": (drive, "V", RATE)}
    return identify([Recording.from_arrays(channels)], DEVICE)


@pytest.mark.parametrize("delay", [20e-6, -4e-6, 0.0])
def test_a_delay_is_stated_and_changes_no_constant(delay: float) -> None:
    """With 20 µs, k/J was 22 standard deviations off, without a note."""
    found = swept(delay)
    notes = [note for note in found.notes if "against the drive" in note]
    assert len(notes) == (delay != 0.0)
    for note in notes:
        assert float(re.findall(r"by ([\d.]+) µs", note)[0]) == pytest.approx(1e6 * abs(delay), abs=0.5)
        assert ("late" in note) == (delay > 0.0)
    for key, true in (("k_over_J", W**2), ("b_over_J", W / QUALITY)):
        value = found.values["x"][key]
        assert value.value == pytest.approx(true, abs=4.0 * value.sd)
        assert value.sd < 0.01 * true
