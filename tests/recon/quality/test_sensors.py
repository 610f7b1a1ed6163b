"""Sensors that hold noise only are refused, weak ones pass; signs are confirmed, contradicted or noted."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from estimation.estimate import estimate
from estimation.estimators import estimators
from phantoms.forward import Plan, simulate
from phantoms.waveforms import Sine
from recon.cli import main
from recon.evaluation import evaluate_axis, truth_from_simulation
from recon.pipeline import reconstruct
from recon.point_cloud import make_point_cloud
from recon.quality import line_search
from recon.quality.line_search import search_lines
from recon.quality.sensor_noise import POSITION_ESTIMATORS, SENSE_ESTIMATORS, check_sensor_noise
from recon.quality.sensor_sign import describe_inverted_sensors, describe_unconfirmed_signs
from recon.steps.preparation import prepare
from recon.steps.reconstruction import Options
from scanner.channel import make_channel
from scanner.device import Device
from scanner.device_templates import KnownAxis, new_device
from scanner.errors import BadInput
from scanner.recording import Recording
from scanner.stages import Drive, Position
from tests.support.simulated import imaging, separate_electrodes

RATE = 1e5
FREQUENCY = {"x": 2000.0, "y": 835.0}
DEVICE = Device.from_toml(new_device("electromagnetic", {axis: KnownAxis(f) for axis, f in FREQUENCY.items()}))
BANDS = ((1600.0, 2500.0),)
OPTIONS = Options(pixels=(40, 40), sense_only=True)


@cache
def bench() -> Recording:
    """A driven scan with position readouts and a range of 1 m: 0.1 s at 100 kHz."""
    plan = Plan({axis: Sine(f, 10.0) for axis, f in FREQUENCY.items()}, 0.1, RATE, references=("angle",), settle=0.1)
    recording, _ = simulate(DEVICE, plan, seed=3)
    samples = recording["sense_x"].size
    light = np.random.default_rng(3).poisson(20, samples).astype(float)
    return with_channels(recording, intensity=(light, "", RATE), range=(np.ones(samples), "m", RATE))


def with_channels(recording: Recording, device: Device | None = None, **changed: object) -> Recording:
    """The recording with channels changed (samples, or samples, unit and rate) or left out (None)."""
    channels: dict = {k: (c.read(), c.unit, c.sample_rate, c.start) for k, c in recording.channels.items()}
    for name, change in changed.items():
        if change is None:
            channels.pop(name)
        else:
            channels[name] = change if isinstance(change, tuple) else (change, *channels[name][1:])
    return Recording.from_arrays(channels, device or recording.device)


def scan(device: Device | None = None, **changed: object) -> Recording:
    return with_channels(bench(), device, **({"angle_x": None, "angle_y": None} | changed))


def noise(seed: int = 0, samples: int = 10_000) -> np.ndarray:
    return np.random.default_rng(seed).normal(0.0, 0.01, samples)


def refusal(recording: Recording, estimator: str | None = None) -> str:
    with pytest.raises(BadInput) as caught:
        check_sensor_noise(recording, recording.device, estimator)
    return str(caught.value)


def coloured(seed: int, samples: int) -> np.ndarray:
    spectrum = np.fft.rfft(noise(seed, samples))
    return np.fft.irfft(spectrum / np.sqrt(np.arange(1, spectrum.size + 1)), samples)


@pytest.mark.parametrize("make", [noise, coloured])
def test_noise_passes_as_often_as_stated(make, monkeypatch: pytest.MonkeyPatch) -> None:  # type: ignore[no-untyped-def]
    monkeypatch.setattr(line_search, "FALSE_ALARM_PROBABILITY", 0.05)
    found = [
        search_lines(make_channel("sense_x", make(seed, 10_000), unit="V", sample_rate=RATE), BANDS, (2000.0,))
        for seed in range(200)
    ]
    assert all(result is not None for result in found)
    assert sum(result.found for result in found) <= 20  # 10 expected at most of white noise


@pytest.mark.parametrize("estimator", [None, "sensor", "sine-ukf", "tracker"])
def test_a_position_sensor_of_noise_is_refused_with_its_power(estimator: str | None) -> None:
    line = refusal(scan(sense_x=noise()), estimator)
    number = r"\d+(\.\d+)?"
    powers = (
        f"the power over the noise around is {number} at 1999.98 Hz, where the drive moves it, and at most {number}"
    )
    assert re.match(
        f"sense_x: shows no motion, only noise: {powers} from 1600 to 2500 Hz, as by chance; a steady", line
    )
    assert "check the sensor, its cable and amplifier" in line
    assert "\n" not in line


def test_the_other_sensor_is_named() -> None:
    recording = with_channels(bench(), sense_x=noise())
    assert "--estimator sensor uses angle_x" in refusal(recording, "tracker")
    assert check_sensor_noise(recording, DEVICE, None) == []  # the angle channel is used
    assert "without angle_x the estimator uses sense_x" in refusal(with_channels(bench(), angle_x=noise()))


def test_a_shared_electrode_of_noise_is_refused_by_the_command(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    recording = imaging()[0]
    path, out = tmp_path / "dead.h5", tmp_path / "out"
    with_channels(recording, sense=noise(1, recording["sense"].size)).write(path)
    assert main(["reconstruct", str(path), "-o", str(out)]) == 2
    (line,) = (each for each in capsys.readouterr().err.splitlines() if "sense" in each)
    assert f"{path}: sense: shows no motion, only noise" in line
    assert not out.exists()


def test_one_live_axis_of_a_shared_electrode_is_no_noise() -> None:
    """The estimator names the axis that does not move."""
    recording = imaging()[0]
    time = recording["sense"].time()
    one = noise(2, time.size) + 0.05 * np.cos(2 * np.pi * 6540.0 * time)
    assert check_sensor_noise(with_channels(recording, sense=one), recording.device, None) == []


def test_hum_without_a_motion_is_refused_or_noted_with_its_frequency() -> None:
    hum = noise() + 0.5 * np.sin(2 * np.pi * 50.0 * np.arange(10_000) / RATE)
    recording = scan(sense_x=hum)
    line = refusal(recording, "tracker")
    assert "shows no motion where it is expected" in line
    assert "its strongest line is at 50 Hz" in line
    (note,) = check_sensor_noise(recording, DEVICE, "sensor")  # a position sensor may show any waveform
    assert note.startswith("sense_x: shows no motion where it is expected")


def mains_hum(frequency: float, samples: int, rate: float = RATE) -> np.ndarray:
    """Hum of a rectifier: harmonics that fall with their number."""
    phase = 2 * np.pi * frequency / rate * np.arange(samples)
    return sum(0.3 / order * np.sin(order * phase + order) for order in range(1, 6))


@pytest.mark.parametrize("frequency", [50.0, 49.9, 60.05])
@pytest.mark.parametrize("seconds", [0.1, 2.0])
def test_hum_in_a_position_sensor_without_a_drive_is_noted(frequency: float, seconds: float) -> None:
    samples = round(seconds * RATE)
    recording = scan(drive_x=None, sense_x=(mains_hum(frequency, samples) + noise(1, samples), "V", RATE))
    (note,) = check_sensor_noise(recording, DEVICE, "sensor")
    assert note.startswith(
        f"sense_x: shows nothing but the frequency of the mains, {round(frequency, -1):g} Hz, and its harmonics: it is"
    )
    assert "if the mirror is driven at it, state frequency in [x.drive]" in note


@pytest.mark.parametrize("beside", [25.0, 470.0, 2000.0])
def test_a_motion_beside_hum_is_no_hum(beside: float) -> None:
    time = np.arange(20_000) / RATE
    moved = mains_hum(50.0, 20_000) + 0.02 * np.sin(2 * np.pi * beside * time) + noise(2, 20_000)
    assert check_sensor_noise(scan(drive_x=None, sense_x=(moved, "V", RATE)), DEVICE, "sensor") == []


@pytest.mark.parametrize("shape", ["ramp", "step", "raster"])
def test_any_waveform_of_a_position_sensor_without_a_drive_passes(shape: str) -> None:
    time = np.arange(10_000) / RATE
    wave = {"ramp": time, "step": 0.1 * (time > 0.05), "raster": 0.1 * np.abs((20.0 * time) % 2.0 - 1.0)}[shape]
    recording = scan(drive_x=None, sense_x=wave + noise())
    assert check_sensor_noise(recording, DEVICE, "sensor") == []


@pytest.mark.parametrize("part", [slice(8000, None), slice(0, 1000), slice(4000, 4500)])
def test_a_motion_that_lasts_a_part_of_the_recording_passes(part: slice) -> None:
    moved = noise()
    moved[part] += 0.02 * np.sin(2 * np.pi * 2050.0 * np.arange(10_000) / RATE)[part]  # 6 dB, not at the drive's
    assert check_sensor_noise(scan(sense_x=moved), DEVICE, "tracker") == []


def test_gaps_and_constants_are_left_to_their_own_messages() -> None:
    gap = bench()["sense_x"].read()
    gap[2000:5000] = np.nan
    for samples in (gap, np.full(10_000, np.nan), np.zeros(10_000), gap[:20]):
        assert check_sensor_noise(scan(sense_x=(samples, "V", RATE)), DEVICE, "tracker") == []


@pytest.mark.parametrize("snr_db", [-20.0, -27.0, -30.0])
def test_what_the_tracker_can_follow_passes(snr_db: float) -> None:
    """12 ms of two electrodes: at -30 dB the tracker finds the motion in half of the recordings."""
    recording, truth = separate_electrodes()
    worked = 0
    for seed in range(3):
        rng, changed = np.random.default_rng(seed), {}
        for name in ("sense_x", "sense_y"):
            signal = recording[name].read()
            changed[name] = signal + rng.normal(0.0, np.std(signal) * 10 ** (-snr_db / 20), signal.size)
        noisy = with_channels(recording, **changed)
        try:
            motion = estimate(noisy, noisy.device, "tracker")
        except BadInput:
            continue
        errors = [evaluate_axis(motion.axes[a], *truth_from_simulation(truth).angles[a]).phase_rmse for a in "xy"]
        if np.degrees(max(errors)) < 10.0:
            worked += 1
            assert check_sensor_noise(noisy, noisy.device, "tracker") == []
    assert worked > 0


def test_every_estimator_states_what_it_follows() -> None:
    own = {name for name, each in estimators().items() if each.run.__module__.startswith("estimation.estimators")}
    assert {*POSITION_ESTIMATORS, *SENSE_ESTIMATORS, "picture"} == own


def test_the_point_cloud_refuses_noise_and_notes_signs() -> None:
    with pytest.raises(BadInput, match="sense_x: shows no motion, only noise"):
        make_point_cloud(scan(sense_x=noise()), OPTIONS, quiet=True)
    notes = make_point_cloud(scan(sense_x=-scan()["sense_x"].read(), drive_y=None), OPTIONS, quiet=True).notes
    assert sum("the motion leads drive_x" in note for note in notes) == 1
    assert sum(note.startswith("the sign of sense_y is taken from the device file") for note in notes) == 1


def unconfirmed(recording: Recording, estimator: str = "sensor", **flips: bool) -> list[str]:
    motion = estimate(recording, recording.device, estimator, flips)
    return list(describe_unconfirmed_signs(recording, recording.device, motion))


@pytest.mark.parametrize("estimator", ["sensor", "tracker"])
def test_a_linear_drive_confirms_the_sign(estimator: str) -> None:
    assert unconfirmed(scan(), estimator) == []
    assert prepare(scan()).unknown_entries == ()


def test_without_a_drive_the_sign_is_noted_once_with_its_gain() -> None:
    recording = scan(drive_x=None)
    (note,) = unconfirmed(recording)
    gain = DEVICE.axis("x").readout.gain
    assert note.startswith(
        f"the sign of sense_x is taken from the device file (gain {gain:+.4g} V/rad); nothing in the"
    )
    assert "--flip-x turns it" in note
    assert "a recorded drive_x would confirm it" in note
    assert unconfirmed(recording, x=True) == []
    assert sum("nothing in the recording confirms it" in each for each in reconstruct(recording, OPTIONS).notes) == 1


@pytest.mark.parametrize(("start", "sample"), [(-1e3, 0.0), (0.0, np.inf)])
def test_a_drive_at_another_time_or_with_an_infinite_sample_has_a_gap(start: float, sample: float) -> None:
    drive = bench()["drive_x"].read()
    drive[100] = sample
    recording = scan(drive_x=(drive, "V", RATE, start))
    assert list(describe_inverted_sensors(recording, DEVICE)) == []
    assert any(note.startswith(("drive_x: gap", "drive_x: missing")) for note in reconstruct(recording, OPTIONS).notes)


def test_combs_do_not_confirm_the_sign() -> None:
    x = replace(DEVICE.axis("x"), drive=Drive("electrostatic"))
    device = replace(DEVICE, axes={**DEVICE.axes, "x": x})
    drive = (np.sin(2 * np.pi * 4000.0 * np.arange(10_000) / RATE), "V", RATE)
    (note,) = unconfirmed(scan(device, drive_x=drive))
    assert "sense_x" in note
    assert "would confirm" not in note


def test_an_angle_channel_confirms_or_contradicts_the_sign() -> None:
    recording = with_channels(bench(), drive_x=None, angle_y=None)
    assert unconfirmed(recording, "tracker") == []
    inverted = with_channels(recording, sense_x=-recording["sense_x"].read())
    (note,) = prepare(inverted).unknown_entries
    assert note.startswith("sense_x: moves opposite to angle_x")


def test_a_negative_torque_by_volt_is_taken_into_account() -> None:
    x = DEVICE.axis("x")
    readout = x.readout
    assert isinstance(readout, Position)
    assert x.drive is not None
    assert x.drive.torque_per_volt is not None
    turned = replace(
        x,
        readout=replace(readout, gain=-readout.gain),
        drive=replace(x.drive, torque_per_volt=-x.drive.torque_per_volt),
    )
    device = replace(DEVICE, axes={**DEVICE.axes, "x": turned})
    assert prepare(scan(device)).unknown_entries == ()


@pytest.mark.parametrize(("ratio", "sign"), [(0.3, 1.0), (0.3, -1.0), (2.5, 1.0), (2.5, -1.0)])
def test_far_from_the_resonance_the_device_predicts_the_sign(ratio: float, sign: float) -> None:
    time = np.arange(10_000) / RATE
    drive = np.sin(2 * np.pi * ratio * 2000.0 * time)
    response = sign * (drive if ratio < 1.0 else -drive)
    recording = scan(drive_x=(drive, "V", RATE), sense_x=response + 0.1 * noise())
    notes = prepare(recording).unknown_entries
    assert len(notes) == (sign < 0.0)
    assert unconfirmed(recording) == []


@pytest.mark.parametrize("cycles", [2, 3, 5])
def test_a_slow_drive_of_few_cycles_is_not_refused(cycles: int) -> None:
    """A stage at 0.5 Hz: the band of its motion holds fewer frequencies than a noise level needs."""
    rate, frequency = 1000.0, 0.5
    time = np.arange(round(cycles / frequency * rate)) / rate
    drive = (10.0 * np.sin(2 * np.pi * frequency * time), "V", rate)
    moved = (0.05 * np.sin(2 * np.pi * frequency * time) + noise(6, time.size) * 1e-2, "V", rate)
    recording = scan(drive_x=drive, sense_x=moved)
    assert check_sensor_noise(recording, DEVICE, "sensor") == []
    assert check_sensor_noise(recording, DEVICE, "ukf") == []


@pytest.mark.parametrize("seconds", [0.005, 0.008])
def test_a_motion_that_decays_after_a_jump_of_its_drive_is_not_called_inverted(seconds: float) -> None:
    frequency, quality = FREQUENCY["x"], 100.0
    time = np.arange(round(seconds * RATE)) / RATE
    drive = 10.0 * np.cos(2 * np.pi * frequency * time)
    size = 1.0 - 2.0 * np.exp(-np.pi * frequency / quality * time)
    moved = scan(drive_x=(drive, "V", RATE), sense_x=(size * np.sin(2 * np.pi * frequency * time), "V", RATE))
    assert list(describe_inverted_sensors(moved, DEVICE)) == []
    steady = scan(drive_x=(drive, "V", RATE), sense_x=(-np.sin(2 * np.pi * frequency * time), "V", RATE))
    (line,) = describe_inverted_sensors(steady, DEVICE)
    assert "sense_x: the motion leads drive_x" in line
