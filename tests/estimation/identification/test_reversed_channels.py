"""Driven motion whose angle has the wrong sign, or whose times fall."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lsim

from estimation.identification.calibrate import identify
from scanner.device import Axis, Device
from scanner.errors import BadInput
from scanner.recording import Recording
from scanner.stages import Drive, Mechanics

W, QUALITY, INERTIA, RATE = 2 * np.pi * 1000.0, 50.0, 1e-10, 5e4
DEVICE = Device(
    "mirror",
    {"x": Axis(Mechanics(INERTIA, INERTIA * W / QUALITY, INERTIA * W**2), drive=Drive("linear", 1e-7), name="x")},
)


def driven(frequency: tuple[float, float], seconds: float = 0.4) -> tuple[np.ndarray, np.ndarray]:
    """Angle [rad] and drive [V] under a sine whose frequency [Hz] changes steadily, from 0.1 s on."""
    time = np.arange(round((0.1 + seconds) * RATE)) / RATE
    first, last = frequency
    drive = 10.0 * np.sin(2 * np.pi * (first * time + 0.5 * (last - first) / time[-1] * time**2))
    angle = lsim(([1e-7 / INERTIA], [1.0, W / QUALITY, W**2]), drive, time)[1]
    angle += 1e-5 * np.random.default_rng(3).standard_normal(time.size)
    return angle[round(0.1 * RATE) :], drive[round(0.1 * RATE) :]


def recorded(angle: np.ndarray, drive: np.ndarray) -> Recording:
    return Recording.from_arrays({"angle_x": (angle, "rad", RATE), "drive_x": (drive, "V", RATE)})


MOTIONS = {"sweep": [(950.0, 1050.0)], "tones": [(990.0, 990.0), (1000.0, 1000.0), (1010.0, 1010.0)]}


@pytest.mark.parametrize("motion", MOTIONS)
def test_an_angle_of_the_wrong_sign_is_named(motion: str) -> None:
    """The hint was to record a sweep, or a constant of the device was below 0."""
    recordings = [recorded(-angle, drive) for angle, drive in map(driven, MOTIONS[motion])]
    with pytest.raises(
        BadInput, match=r"^angle_x: moves against the torque of its drive; the sign of angle_x, drive_x"
    ):
        identify(recordings, DEVICE)


@pytest.mark.parametrize("motion", MOTIONS)
def test_times_that_fall_are_named(motion: str) -> None:
    """The message was that a constant of the device is below 0."""
    recordings = [recorded(angle[::-1], drive[::-1]) for angle, drive in map(driven, MOTIONS[motion])]
    with pytest.raises(BadInput, match=r"^angle_x: gains energy while it is driven: b/J is -"):
        identify(recordings, DEVICE)
