"""Velocity, acceleration, lock-in output and a readout of the motion as references, and swept drives."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.identify_references import LOCK_INS, SWEEP, recorded
from estimation.identification.calibrate import identify
from phantoms.forward import InitialState, Plan, simulate
from phantoms.waveforms import Constant, Sweep, Waveform
from scanner.device import Axis, Device
from scanner.drift import Drift, exponential
from scanner.errors import BadInput
from scanner.recording import Recording
from scanner.stages import Acceleration, Drive, Mechanics, MotionSensor, Position, Velocity

RATE, RESONANCE_HZ, QUALITY, INERTIA = 5e4, 1000.0, 50.0, 1e-10
W = 2 * np.pi * RESONANCE_HZ
TRUE = {"J": INERTIA, "b": INERTIA * W / QUALITY, "k": INERTIA * W**2}
SENSORS = {
    "angle": Position(10.0, 0.01),
    "velocity": Velocity(10.0 / W, 0.01),
    "acceleration": Acceleration(10.0 / W**2, 0.01),
}


def measure(readout: MotionSensor, drive: Waveform, seconds: float, start: InitialState, seed: int = 4) -> Recording:
    axis = Axis(Mechanics(**TRUE), drive=Drive("linear", 1e-7), readout=readout, name="x")
    recording, _ = simulate(
        Device("true", {"x": axis}), Plan({"x": drive}, seconds, RATE), start={"x": start}, seed=seed
    )
    return recording


def nominal(readout: MotionSensor | None = None) -> Device:
    """Resonance 1 % off, Q 30 instead of 50, inertia 20 % off."""
    mechanics = Mechanics(1.2 * INERTIA, 1.2 * INERTIA * W / 30.0, 1.224 * INERTIA * W**2)
    axis = Axis(mechanics, drive=Drive("linear", 1e-7), readout=readout or Position(1.0, 0.0), name="x")
    return Device("nominal", {"x": axis})


def as_reference(recording: Recording, kind: str) -> Recording:
    values = recording["sense_x"].read() / SENSORS[kind].gain
    channels = {f"{kind}_x": (values, {"angle": "rad", "velocity": "rad/s", "acceleration": "rad/s2"}[kind], RATE)}
    if np.ptp(recording["drive_x"].read()):
        channels["drive_x"] = (recording["drive_x"].read(), "V", RATE)
    return Recording.from_arrays(channels)


def lock_in(recording: Recording, seconds: float) -> Recording:
    """Amplitude and phase against 1 kHz, at 500 Hz."""
    time = recording["sense_x"].time()
    mixed = 2j * recording["sense_x"].read() / SENSORS["angle"].gain * np.exp(-1j * W * time)
    length = round(RATE / 500.0)
    phasor = mixed[: mixed.size // length * length].reshape(-1, length).mean(axis=1)
    about = {"reference": RESONANCE_HZ}
    first = 0.5 * (length - 1) / RATE
    return Recording.from_arrays(
        {
            "amplitude_x": (np.abs(phasor), "rad", 500.0, first, about),
            "phase_x": (np.angle(phasor), "rad", 500.0, first, about),
        }
    )


def assert_within(values: dict, names: list[str], relative_sd: float = 0.05) -> None:
    true = TRUE | {"k_over_J": W**2, "b_over_J": W / QUALITY}
    for key in names:
        assert values[key].value == pytest.approx(true[key], abs=4.5 * values[key].sd + 1e-3 * true[key])
        assert values[key].sd < relative_sd * true[key]


@pytest.mark.parametrize("kind", SENSORS)
def test_a_fast_sweep_determines_the_mechanics(kind: str) -> None:
    sweep = Sweep(950.0, 1050.0, 0.4, 10.0)
    found = identify([as_reference(measure(SENSORS[kind], sweep, 0.4, InitialState(0.0, 0.0)), kind)], nominal())
    assert_within(found.values["x"], ["k_over_J", "b_over_J"])
    values = found.values["x"]
    assert values["J"].value == pytest.approx(INERTIA, rel=5e-3)
    assert 0.019 < values["J"].sd / values["J"].value < 0.022  # the tolerance of the torque
    assert found.device.axis("x").tolerance["J"] < 0.005  # at the nominal torque
    assert sum("this factor changes no motion" in note for note in found.notes) == 1


def test_intervals_of_a_sweep_have_the_size_of_the_errors() -> None:
    """The rms error over the stated standard deviation has itself a standard deviation of 9 % in 60 sweeps."""
    sweep = Sweep(950.0, 1050.0, 0.4, 10.0)
    pulls = []
    for seed in range(91700, 91760):
        recording = as_reference(measure(SENSORS["angle"], sweep, 0.4, InitialState(0.0, 0.0), seed), "angle")
        values = identify([recording], nominal()).values["x"]
        pulls.append([(values[k].value - t) / values[k].sd for k, t in (("k_over_J", W**2), ("b_over_J", W / QUALITY))])
    assert np.sqrt(np.mean(np.square(pulls), axis=0)) == pytest.approx([1.0, 1.0], abs=0.28)


@pytest.mark.parametrize("kind", LOCK_INS)
def test_a_sweep_behind_a_lock_in_amplifier_determines_the_mechanics_and_its_filter(kind: str) -> None:
    """A delay of 2 ms that is taken for damping would make Q 40 % wrong."""
    found = identify([recorded(kind, SWEEP, 91800)], nominal())
    assert_within(found.values["x"], ["k_over_J", "b_over_J"], relative_sd=0.01)
    (note,) = [each for each in found.notes if "filter of the lock-in" in each]
    delay, width = (float(number) for number in re.findall(r"([-+.\de]+) ms", note))
    assert delay == pytest.approx(0.0 if kind == "lock-in" else 2.0, abs=0.1)
    assert width == pytest.approx(2.0 / np.sqrt(12.0) if kind == "lock-in" else 1.0, abs=0.5)


@pytest.mark.slow
def test_intervals_of_a_sweep_behind_a_lock_in_amplifier_have_the_size_of_the_errors() -> None:
    """The rms error over the stated standard deviation has itself a standard deviation of 9 % in 60 sweeps."""
    pulls = []
    for seed in range(91820, 91880):
        values = identify([recorded("lock-in", SWEEP, seed)], nominal()).values["x"]
        pulls.append([(values[k].value - t) / values[k].sd for k, t in (("k_over_J", W**2), ("b_over_J", W / QUALITY))])
    assert np.sqrt(np.mean(np.square(pulls), axis=0)) == pytest.approx([1.0, 1.0], abs=0.28)


def test_the_stated_gain_of_a_readout_scales_the_inertia() -> None:
    sweep = Sweep(950.0, 1050.0, 0.4, 10.0)
    recording = measure(SENSORS["velocity"], sweep, 0.4, InitialState(0.0, 0.0))
    found = identify([recording], nominal(SENSORS["velocity"]))
    assert found.used["x"] == [f"{recording.name}: driven motion without a reference angle, from sense_x"]
    assert found.values["x"]["J"].sd / INERTIA == pytest.approx(np.hypot(0.02, 0.02), rel=0.05)


@pytest.mark.parametrize("kind", ["velocity", "acceleration"])
def test_a_decay_of_velocity_or_acceleration_determines_the_ratios(kind: str) -> None:
    decay = measure(SENSORS[kind], Constant(0.0), 0.1, InitialState(0.1, 0.0))
    found = identify([as_reference(decay, kind)], nominal())
    assert_within(found.values["x"], ["k_over_J", "b_over_J"])
    assert any("J stays as stated" in note for note in found.notes)


def test_a_decay_behind_a_lock_in_amplifier_determines_the_ratios() -> None:
    recording = measure(SENSORS["angle"], Constant(0.0), 0.1, InitialState(0.1, 0.0))
    found = identify([lock_in(recording, 0.1)], nominal())
    assert_within(found.values["x"], ["k_over_J", "b_over_J"])
    assert found.used["x"] == ["recording: free decay, from amplitude_x and phase_x"]


@pytest.mark.parametrize("at", [0, 10, 40])
def test_a_missing_phase_takes_one_value_of_a_decay(at: int) -> None:
    """All later values were left out: intervals were 700 times as wide, or no decay was found."""
    recording = lock_in(measure(SENSORS["angle"], Constant(0.0), 0.1, InitialState(0.1, 0.0)), 0.1)
    found = []
    for name in ("amplitude_x", "phase_x"):
        channel = recording[name]
        values = np.where(np.arange(channel.size) == at, np.nan, channel.read())
        damaged = replace(recording, channels={**recording.channels, name: replace(channel, raw=values)})
        found.append(identify([damaged], nominal()).values["x"])
    assert found[0] == found[1]
    assert_within(found[1], ["k_over_J", "b_over_J"])


@pytest.mark.parametrize("name", ["amplitude_x", "phase_x"])
def test_a_missing_lock_in_value_beside_a_drive_takes_one_value(name: str) -> None:
    recording = recorded("lock-in", SWEEP, 91800)
    channel = recording[name]
    values = np.where(np.arange(channel.size) == 5, np.nan, channel.read())
    damaged = replace(recording, channels={**recording.channels, name: replace(channel, raw=values)})
    whole, found = (identify([each], nominal()).values["x"] for each in (recording, damaged))
    for key in ("k_over_J", "b_over_J", "J"):
        assert found[key].value == pytest.approx(whole[key].value, abs=0.5 * whole[key].sd)
        assert found[key].sd == pytest.approx(whole[key].sd, rel=0.2)


def test_a_steady_motion_without_its_drive_is_no_decay() -> None:
    tone = measure(SENSORS["angle"], Sweep(1003.0, 1003.0, 0.4, 10.0), 0.4, InitialState(0.0, 0.0))
    settled = Recording.from_arrays({"sense_x": (tone["sense_x"].read()[10_000:], "V", RATE)})
    with pytest.raises(BadInput, match="does not decay"):
        identify([settled], nominal(SENSORS["angle"]))


def test_a_steady_tone_leaves_the_inertia_open() -> None:
    tone = Sweep(1003.0, 1003.0, 0.4, 10.0)
    steady = as_reference(measure(SENSORS["velocity"], tone, 0.4, InitialState(0.0, 0.0)), "velocity")
    settled = Recording.from_arrays(
        {name: (steady[name].read()[10_000:], steady[name].unit, RATE) for name in ("velocity_x", "drive_x")}
    )
    with pytest.raises(BadInput, match="does not determine J; record two or more drive frequencies, or a sweep"):
        identify([settled], nominal())


def test_a_drift_under_one_drive_frequency_is_no_inertia() -> None:
    """J was 1.28 times too large, by 7.8 standard deviations: a drift of the resonance changed the amplitude."""
    axis = Axis(Mechanics(**TRUE), drive=Drive("linear", 1e-7), readout=SENSORS["angle"], name="x")
    drift = {"x": Drift(stiffness=exponential(-0.002, 0.6))}
    plan = Plan({"x": Sweep(1003.0, 1003.0, 2.0, 10.0)}, 2.0, RATE, drift=drift)
    recording, _ = simulate(Device("true", {"x": axis}), plan, start={"x": InitialState(0.0, 0.0)}, seed=8)
    values = identify([as_reference(recording, "angle")], nominal()).values["x"]
    for key in ("J", "b", "b_over_J"):
        true = (TRUE | {"b_over_J": W / QUALITY})[key]
        assert abs(values[key].value - true) < 3.0 * values[key].sd < 0.1 * true
    assert 0.998 < values["k_over_J"].value / W**2 < 0.9995  # the average of its drift


def test_intervals_of_a_tone_from_rest_have_the_size_of_the_errors() -> None:
    """The rms error over the stated standard deviation has itself a standard deviation of 13 % in 30 tones."""
    pulls = []
    for seed in range(91800, 91830):
        measured = measure(SENSORS["angle"], Sweep(1003.0, 1003.0, 0.2, 10.0), 0.2, InitialState(0.0, 0.0), seed)
        values = identify([as_reference(measured, "angle")], nominal()).values["x"]
        pulls.append([(values[k].value - t) / values[k].sd for k, t in (("k_over_J", W**2), ("b_over_J", W / QUALITY))])
    assert np.sqrt(np.mean(np.square(pulls), axis=0)) == pytest.approx([1.0, 1.0], abs=0.4)


def test_noise_alone_is_no_motion() -> None:
    noise = np.random.default_rng(772012).normal(0.0, 0.01, 40_000)
    rest = identify([Recording.from_arrays({"sense_x": (noise, "V", RATE)})], nominal(SENSORS["angle"]))
    assert any("no recording shows a motion" in note for note in rest.notes)
    drive = np.sin(W * np.arange(noise.size) / RATE)
    driven = Recording.from_arrays({"sense_x": (noise, "V", RATE), "drive_x": (drive, "V", RATE)})
    with pytest.raises(BadInput, match="shows no motion above white noise in sense_x"):
        identify([driven], nominal(SENSORS["angle"]))


@pytest.mark.parametrize("rate", [6e3, 12e3])
def test_a_sweep_of_few_samples_a_period_has_no_bias(rate: float) -> None:
    w, quality, duration = 2 * np.pi * 2000.0, 100.0, 0.2
    axis = Axis(Mechanics(1e-9, 1e-9 * w / quality, 1e-9 * w**2), drive=Drive("linear", 1e-4), name="x")
    device = Device("d", {"x": axis})
    plan = Plan({"x": Sweep(1960.0, 2040.0, duration, 1.0)}, duration, 10 * rate, references=("angle",))
    recording, _ = simulate(device, plan, start={"x": InitialState(0.0, 0.0)}, seed=1)
    angle, drive = (recording[name].read()[::10] for name in ("angle_x", "drive_x"))
    noisy = angle + 2e-3 * np.abs(angle).max() * np.random.default_rng(0).standard_normal(angle.size)
    channels = {"angle_x": (noisy, "rad", rate), "drive_x": (drive, "V", rate)}
    found = identify([Recording.from_arrays(channels)], device).values["x"]
    assert found["k_over_J"].value == pytest.approx(w**2, abs=4.0 * found["k_over_J"].sd)
    assert found["b_over_J"].value == pytest.approx(w / quality, abs=4.0 * found["b_over_J"].sd)
