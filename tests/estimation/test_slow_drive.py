"""A stage with linear drive that moves far below its resonance: its reference is the slow line of the drive."""

from __future__ import annotations

import numpy as np
import pytest

from estimation.filters.baselines import estimate_from_sensor
from estimation.reference import has_slow_oscillation
from estimation.signals import phase_reference
from estimation.tracker.track import track
from scanner.device import Device
from scanner.device_templates import KnownAxis, new_device
from scanner.errors import BadInput
from scanner.recording import Recording

RATE = 7200.0
TIME = np.arange(round(4 * RATE)) / RATE
SLOW_HZ, RESONANCE_HZ, NOISE_RAD = 20.0, 500.0, 0.005


def stage() -> Device:
    known = {axis: KnownAxis(resonance=RESONANCE_HZ) for axis in "xy"}
    return Device.from_toml(new_device("afm", known))


def recording(drive: np.ndarray, angle: np.ndarray, noise: float = NOISE_RAD) -> Recording:
    device = stage()
    sense = device.axis("x").readout.gain * (angle + np.random.default_rng(3).normal(0.0, noise, angle.size))
    channels = {}
    for axis in "xy":
        channels[f"drive_{axis}"] = (drive, "V", RATE)
        channels[f"sense_{axis}"] = (sense, "V", RATE)
    return Recording.from_arrays(channels, device=device)


def test_the_phase_of_a_stage_far_below_its_resonance_follows_its_drive() -> None:
    turn = 2 * np.pi * SLOW_HZ * TIME
    motion = estimate_from_sensor(recording(10.0 * np.sin(turn), 5.0 * np.sin(turn - 0.01)), stage()).axes["x"]
    assert motion.frequency == pytest.approx(SLOW_HZ, rel=1e-3)
    np.testing.assert_allclose(np.sin(motion.phase + 0.01), 0.0, atol=5e-3)  # modulo 2 pi
    np.testing.assert_allclose(motion.amplitude, 5.0, rtol=0.02)


@pytest.mark.parametrize("offset", [0.0, 3.0])
def test_a_resonant_drive_that_is_switched_on_keeps_its_own_line(offset: float) -> None:
    drive = np.where(TIME > 1.0, offset + 10.0 * np.sin(2 * np.pi * RESONANCE_HZ * TIME), 0.0)
    reference = phase_reference(recording(drive, drive), stage(), "x")
    assert reference.frequency == pytest.approx(RESONANCE_HZ, rel=1e-3)


def test_a_slow_drive_on_which_the_axis_resonates_is_no_slow_motion() -> None:
    slow, fast = np.sin(2 * np.pi * SLOW_HZ * TIME), np.sin(2 * np.pi * RESONANCE_HZ * TIME)
    shaken = recording(10.0 * slow + 3.0 * fast, 5.0 * slow + 20.0 * fast)
    reference = phase_reference(shaken, stage(), "x", shaken["sense_x"])
    assert reference.frequency == pytest.approx(RESONANCE_HZ, rel=1e-3)


def test_a_resonant_drive_sampled_too_slowly_is_refused() -> None:
    """Its line in the recording is another one."""
    resonance = stage().axis("x").resonance
    rate = 1.6 * resonance
    turn = 2 * np.pi * resonance * np.arange(2000) / rate
    sampled = Recording.from_arrays({"drive_x": (np.sin(turn), "V", rate)})
    with pytest.raises(BadInput, match="too slowly for a drive of the resonance at"):
        phase_reference(sampled, stage(), "x")


def test_a_sawtooth_without_a_drive_is_no_motion_at_the_resonance() -> None:
    """One of its harmonics lies near the resonance."""
    sawtooth = 5.0 * (2.0 * (SLOW_HZ * TIME % 1.0) - 1.0)
    sense = {f"sense_{axis}": recording(TIME, sawtooth)[f"sense_{axis}"].read() for axis in "xy"}
    undriven = Recording.from_arrays({name: (values, "V", RATE) for name, values in sense.items()}, device=stage())
    motion = estimate_from_sensor(undriven, stage()).axes["x"]
    assert motion.frequency == pytest.approx(SLOW_HZ, rel=1e-3)
    np.testing.assert_allclose(motion.amplitude, 5.0 * 2.0 / np.pi, rtol=0.02)  # of the fundamental


def test_a_step_of_the_drive_is_no_oscillation() -> None:
    step = recording(np.where(TIME > 2.0, 10.0, 0.0), 0.0 * TIME)
    assert not has_slow_oscillation(step["drive_x"], RESONANCE_HZ)


def test_the_tracker_says_that_a_motion_is_far_below_the_resonance() -> None:
    turn = 2 * np.pi * SLOW_HZ * TIME
    with pytest.raises(BadInput, match=r"far below its resonance of 500 Hz.*--estimator sensor"):
        track(recording(10.0 * np.sin(turn), 5.0 * np.sin(turn)), stage())
