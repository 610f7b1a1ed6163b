"""A channel in another unit or with the wrong sign is refused; a device that is wrong is not."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import chirp, lsim

from estimation.device_fit.data import prepare_run
from estimation.diagnosis.unit_check import _resonance_in_widths, check_units_and_signs
from scanner.arrays import Array
from scanner.device import Axis, Device
from scanner.errors import BadInput
from scanner.recording import Recording
from scanner.stages import Drive, Mechanics, Position

RATE, RESONANCE = 1e4, 2 * np.pi * 100.0
TIME = np.arange(5000) / RATE
SWEEP = chirp(TIME, 40.0, TIME[-1], 240.0)


def device(resonance: float = RESONANCE) -> Device:
    mechanics, drive = Mechanics(1.0, resonance / 50.0, resonance**2), Drive("linear", RESONANCE**2)
    return Device("d", {"x": Axis(mechanics, drive=drive, readout=Position(10.0, 0.01), name="x")})


def check(drive: Array, factor: float, nominal: Device) -> None:
    """Check a recording of the device at its resonance, its signal times a factor, against a nominal one."""
    motion = lsim(([RESONANCE**2], [1.0, RESONANCE / 50.0, RESONANCE**2]), drive, TIME)[1]
    noise = 0.01 * np.random.default_rng(1).normal(size=TIME.size)
    channels = {"sense_x": (factor * (10.0 * motion + noise), "V", RATE), "drive_x": (drive, "V", RATE)}
    recording = Recording.from_arrays(channels, nominal)
    check_units_and_signs([recording], [prepare_run(recording, nominal)], nominal)


@pytest.mark.parametrize("factor", [1000.0, 1e-3, 180.0 / np.pi])
def test_another_unit_is_refused(factor: float) -> None:
    with pytest.raises(BadInput, match=r"sense_x: has the waveform that the device gives, times .*; check the unit"):
        check(SWEEP, factor, device())


def test_the_wrong_sign_is_refused() -> None:
    with pytest.raises(BadInput, match=r"sense_x: .*, times -.*; check the sign of this channel"):
        check(SWEEP, -1.0, device())


@pytest.mark.parametrize("factor", [1.0, 0.5])
def test_a_gain_within_reason_is_accepted(factor: float) -> None:
    check(SWEEP, factor, device())


def test_a_steady_tone_shows_no_sign() -> None:
    """The resonance of the nominal device lies below the tone, that of the true one above."""
    check(np.sin(2 * np.pi * 95.0 * TIME), 1.0, device(0.9 * RESONANCE))


def test_a_device_with_another_resonance_is_accepted() -> None:
    check(SWEEP, 1000.0, device(0.9 * RESONANCE))


def test_the_size_of_the_response_to_a_tone_is_as_uncertain_as_the_resonance() -> None:
    """At Q = 10 000, a stiffness 2 % off, its tolerance, changes the response to a tone at the resonance 200 times."""
    nominal = Axis(Mechanics(1.0, RESONANCE / 1e4, RESONANCE**2), Drive("linear", 1.0), Position(1.0, 1.0), name="x")
    assert _resonance_in_widths(Device("d", {"x": nominal}), "x") == pytest.approx(200.0)
    assert _resonance_in_widths(device(), "x") == 1.0
