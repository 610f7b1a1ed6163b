"""A pause of the recorded drive is used where the motion decays, and left out where the mirror was driven."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from estimation.tracker import track
from phantoms.forward import Plan, simulate
from phantoms.waveforms import Constant, Sequence
from scanner import devices
from scanner.device import Device
from scanner.errors import BadInput
from scanner.recording import Recording
from tests.support.simulated import DRIVES, shared_electrode
from tests.support.tracks import track_errors

DURATION_S, PAUSE_START_S = 0.03, 0.012


def with_drives(change: Callable[[np.ndarray, float], None], names: str = "x") -> Recording:
    """A scan whose drives never paused, with records of them that ``change`` changes, given samples and rate."""
    recording, _ = shared_electrode(DURATION_S, 0.0)
    channels = {k: (c.read().copy(), c.unit, c.sample_rate, c.start) for k, c in recording.channels.items()}
    for name in names:
        values, _, rate, _ = channels[f"drive_{name}"]
        change(values, rate)
    return Recording.from_arrays(channels, recording.device)


def pause(length: float, value: float, noise_V: float = 0.0) -> Callable[[np.ndarray, float], None]:
    """A pause of ``length`` [s] in which ``value`` is recorded."""

    def change(values: np.ndarray, rate: float) -> None:
        part = values[round(PAUSE_START_S * rate) : round((PAUSE_START_S + length) * rate)]
        part[:] = value + noise_V * np.random.default_rng(0).standard_normal(part.size)

    return change


def phase_rms_deg(recording: Recording, name: str) -> float:
    """Phase error of the tracker against the true motion."""
    assert recording.device is not None
    truth = shared_electrode(DURATION_S, 0.0)[1]
    motion = track(recording, recording.device)
    return float(np.degrees(np.sqrt(np.mean(track_errors(motion.axes[name], truth[f"angle_{name}"][0])[0] ** 2))))


@pytest.mark.parametrize("length", [3e-4, 6e-3])
def test_a_drive_continues_through_a_gap_of_its_record(length: float) -> None:
    whole = shared_electrode(DURATION_S, 0.0)[0]
    assert phase_rms_deg(with_drives(pause(length, np.nan)), "x") < 1.1 * phase_rms_deg(whole, "x")


@pytest.mark.parametrize(("length", "value", "noise_V"), [(3e-4, 0.0, 0.0), (6e-3, 0.0, 0.3), (6e-3, 30.0, 0.0)])
def test_a_recorded_pause_in_which_the_mirror_was_driven_is_left_out(
    length: float, value: float, noise_V: float
) -> None:
    recording = with_drives(pause(length, value, noise_V), "xy")
    assert recording.device is not None
    notes = track(recording, recording.device).notes
    assert [note.partition(":")[0] for note in notes] == ["drive_x", "drive_y"]
    assert all("sense shows that" in note and "at 0.01" in note for note in notes)
    whole = shared_electrode(DURATION_S, 0.0)[0]
    for name in "xy":
        assert phase_rms_deg(recording, name) < 1.1 * phase_rms_deg(whole, name)


def decaying(length: float, damping: float = 1.0) -> tuple[Recording, Device]:
    """A scan whose x drive was off for ``length`` [s], and a device with another damping of x."""
    device = devices.load("imaging")
    off = Sequence([(DRIVES["x"], PAUSE_START_S), (Constant(0.0), length), (DRIVES["x"], DURATION_S)])
    recording, _ = simulate(device, Plan({**DRIVES, "x": off}, DURATION_S))
    x = device.axis("x")
    mechanics = replace(x.require_mechanics(), b=damping * x.require_mechanics().b)
    return recording, replace(device, axes={**device.axes, "x": replace(x, mechanics=mechanics)})


@pytest.mark.parametrize(("length", "damping"), [(3e-4, 1.0), (4e-3, 1.0), (4e-3, 1.3), (4e-3, 0.7)])
def test_a_drive_that_was_switched_off_is_used_as_recorded(length: float, damping: float) -> None:
    assert not track(*decaying(length, damping)).notes


def recorded_during(recording: Recording, start: float, end: float, names: str = "xy") -> Recording:
    """The recording with drives that were recorded from ``start`` to ``end`` [s] only."""
    part = recording.slice(start, end)
    for name in names:
        recording = recording.with_channel(part[f"drive_{name}"])
    return recording


@pytest.mark.parametrize(("start", "end"), [(0.01, 0.03), (0.0, 0.018), (0.012, 0.018)])
def test_a_drive_that_was_recorded_in_part_continues_where_the_mirror_was_driven(start: float, end: float) -> None:
    whole = shared_electrode(DURATION_S, 0.0)[0]
    recording = recorded_during(whole, start, end)
    assert recording.device is not None
    notes = track(recording, recording.device).notes
    assert [note.partition(":")[0] for note in notes] == ["drive_x", "drive_y"]
    assert all("driven outside of the record: the drive is assumed to continue" in note for note in notes)
    for name in "xy":
        assert phase_rms_deg(recording, name) < 1.1 * phase_rms_deg(whole, name)


def test_a_drive_that_was_recorded_while_it_was_on_is_off_elsewhere() -> None:
    recording, device = decaying(DURATION_S)
    [note] = track(recorded_during(recording, 0.0, PAUSE_START_S, "x"), device).notes
    assert "the drive is assumed to be off there" in note


def test_a_drive_of_another_time_is_refused() -> None:
    recording = shared_electrode(DURATION_S, 0.0)[0]
    assert recording.device is not None
    with pytest.raises(BadInput, match="drive_x: covers"):
        track(recorded_during(recording, 0.0, 0.002), recording.device)
