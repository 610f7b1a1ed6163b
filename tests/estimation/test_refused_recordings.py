"""Recordings that cannot serve: one clear message that says what to do."""

from __future__ import annotations

import numpy as np
import pytest

from estimation.complete_diagnosis import diagnose_with_optics
from estimation.device_fit.undriven import steady_without_drive
from estimation.estimate import estimate
from estimation.identification.calibrate import identify
from scanner.channel import make_channel
from scanner.device import Axis, Device
from scanner.errors import BadInput
from scanner.forward_model import DriveInput, simulate_axis
from scanner.recording import Recording
from scanner.stages import Drive, Mechanics, Position
from tests.support.simulated import imaging, shared_electrode, with_sense

TIME = np.arange(5000) / 1e4
NOISE = 1e-4 * np.random.default_rng(3).normal(size=TIME.size)
DECAY = np.exp(-3.0 * TIME) * np.cos(2 * np.pi * 100.0 * TIME) + 0.01 * np.random.default_rng(1).normal(size=TIME.size)


def device(resonance: float, driven: bool = False) -> Device:
    w = 2 * np.pi * resonance
    drive = Drive("linear", w**2) if driven else None
    return Device("d", {"x": Axis(Mechanics(1.0, w / 50, w**2), drive=drive, readout=Position(10.0, 0.01), name="x")})


def recording(resonance: float, driven: bool = False, samples: int = 5000) -> Recording:
    channels = {"sense_x": (DECAY[:samples], "V", 1e4)}
    if driven:
        channels["drive_x"] = (np.sin(2 * np.pi * 100.0 * TIME[:samples]), "V", 1e4)
    return Recording.from_arrays(channels, device(resonance, driven))


@pytest.mark.parametrize("driven", [False, True])
@pytest.mark.parametrize("resonance", [2e4, 1e9])
def test_a_rate_that_cannot_show_the_resonance_is_refused(resonance: float, driven: bool) -> None:
    with pytest.raises(BadInput, match=r"too slowly for a resonance at .*record at"):
        diagnose_with_optics([recording(resonance, driven)])


def test_identify_refuses_it_too() -> None:
    with pytest.raises(BadInput, match=r"too slowly for a resonance at .*record at"):
        identify([recording(2e4)], device(2e4))
    with pytest.raises(BadInput, match=r"holds 0.08 cycles of a free decay; record 8 cycles or more"):
        identify([recording(100.0, samples=8)], device(100.0))


@pytest.mark.parametrize(("driven", "message"), [(False, "fewer than 8 periods"), (True, "covers 0.5 periods")])
def test_too_few_turns_are_refused(driven: bool, message: str) -> None:
    with pytest.raises(BadInput, match=message):
        diagnose_with_optics([recording(1.0, driven)])


def test_a_device_without_a_spring_is_refused_with_what_to_do() -> None:
    with pytest.raises(BadInput, match=r"must be a number greater than 0; a device without a spring"):
        Mechanics(1.0, 1.0, 0.0)


@pytest.mark.parametrize(
    ("shape", "message"),
    [
        (np.ones(TIME.size), "sense_x moves steadily without drive_x"),
        (np.exp(-0.5 * TIME), None),  # decays, though six times more slowly than the device file says
        (np.zeros(TIME.size), None),
    ],
)
def test_a_motion_that_persists_without_a_recorded_drive_is_refused(shape: np.ndarray, message: str | None) -> None:
    sense = shape * np.cos(2 * np.pi * 100.0 * TIME) + 0.01 * np.random.default_rng(2).normal(size=TIME.size)
    without_drive = Recording.from_arrays({"sense_x": (sense, "V", 1e4)}, device(100.0))
    assert steady_without_drive(without_drive, device(100.0)) == message
    if message is not None:
        with pytest.raises(BadInput, match="record the drive"):
            diagnose_with_optics([without_drive])


def test_noise_that_moves_the_axis_is_its_drive() -> None:
    """A drive of white noise gives a motion near the resonance, of which the amplitude may end as it began."""
    of = device(100.0, driven=True)
    voltage = np.random.default_rng(4).normal(size=TIME.size)
    inputs = DriveInput(np.repeat(voltage[:, None], 3, axis=1), 1e-4)
    motion = simulate_axis(of.axes["x"], (), inputs, (0.0, 0.0)).angle[:-1]
    sense = 10.0 * (motion + 2.0 * np.abs(motion).max() * np.cos(2 * np.pi * 100.0 * TIME))
    made = Recording.from_arrays({"sense_x": (sense, "V", 1e4), "drive_x": (voltage, "V", 1e4)}, of)
    assert steady_without_drive(made, of) is None


@pytest.mark.parametrize(
    ("voltage", "shape", "message"),
    [
        (np.zeros(TIME.size), np.exp(-(((TIME - 0.25) / 0.05) ** 2)) + 0.1, "under a constant drive_x"),
        (np.full(TIME.size, 2.0), np.ones(TIME.size), "under a constant drive_x"),
        (np.full(TIME.size, 2.0), np.exp(-0.5 * TIME), None),
        (NOISE, np.ones(TIME.size), "under noise alone in drive_x"),
        (np.where(TIME < 0.1, np.nan, 0.0), np.ones(TIME.size), None),
        (np.sin(2 * np.pi * 100.0 * TIME), np.ones(TIME.size), None),
    ],
    ids=[
        "swept, recorded as zero",
        "steady, recorded as constant",
        "slow decay",
        "noise of a drive that is off",
        "not finite",
        "driven",
    ],
)
def test_a_motion_that_a_constant_drive_cannot_keep_up_is_refused(
    voltage: np.ndarray, shape: np.ndarray, message: str | None
) -> None:
    sense = shape * np.cos(2 * np.pi * 100.0 * TIME) + 0.01 * np.random.default_rng(2).normal(size=TIME.size)
    of = device(100.0, driven=True)
    made = Recording.from_arrays({"sense_x": (sense, "V", 1e4), "drive_x": (voltage, "V", 1e4)}, of)
    found = steady_without_drive(made, of)
    assert found is None if message is None else found == f"sense_x moves steadily or grows {message}"


def test_a_drive_that_starts_later_is_refused_by_filters_with_the_time_to_cut_out() -> None:
    recording, _ = imaging()
    drive = recording["drive_x"]
    late = round(0.003 * drive.sample_rate)
    channel = make_channel(
        "drive_x", drive.read(late), unit="V", sample_rate=drive.sample_rate, start=drive.time(late, late + 1)[0]
    )
    with pytest.raises(BadInput, match=r"drive_x: covers 0\.003 to .* use the estimator tracker.*slice\(0\.003, "):
        estimate(recording.with_channel(channel), method="ukf")


def test_an_axis_with_a_drive_and_no_sensor_names_the_estimator_picture() -> None:
    channels = {"drive_x": (np.sin(2 * np.pi * 100.0 * TIME), "V", 1e4), "intensity": (DECAY, "V", 1e4)}
    with pytest.raises(BadInput, match="neither is sense_x; record it, or use --estimator picture"):
        estimate(Recording.from_arrays(channels, device(100.0, driven=True)), method="sensor")


def test_a_sense_signal_that_is_too_slow_for_its_main_line_names_the_rate_that_serves() -> None:
    whole, _ = shared_electrode()
    channels = {n: (c.read()[::83], c.unit, c.sample_rate / 83) for n, c in whole.channels.items()}  # 60.24 kHz
    with pytest.raises(BadInput, match=r"^sense: .* line at 27680 Hz by which axis x .*; record at 6151\d Hz or more$"):
        estimate(Recording.from_arrays(channels, whole.device))


def test_a_sense_signal_with_too_few_samples_in_every_block_is_refused() -> None:
    rare = with_sense(shared_electrode()[0], lambda y: np.where(np.arange(y.size) % 1000 == 0, y, np.nan))
    with pytest.raises(BadInput, match=r"^sense: holds too few samples that can be used: no block of .* as its lines"):
        estimate(rare)
