"""Free decays without a reference angle: resonance and damping from the readout's signal, also from eight cycles."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from estimation.identification.calibrate import identify
from estimation.identification.decay_without_angle import fit_decay_without_angle
from phantoms.forward import InitialState, Plan, simulate
from phantoms.waveforms import Constant, Sweep
from recon.cli import main
from scanner import devices
from scanner.device import Axis, Device
from scanner.errors import BadInput
from scanner.lowpass import apply_lowpass
from scanner.recording import Recording
from scanner.stages import Acceleration, Amdm, Drive, Mechanics, MotionSensor, Position, Velocity

W, QUALITY = 2 * np.pi * 5000.0, 80.0
SENSORS = [Position(10.0, 0.01), Velocity(10.0 / W, 0.01), Acceleration(10.0 / W**2, 0.01)]


def decay(readout: MotionSensor, cycles: float, seed: int) -> tuple[Recording, Device]:
    """A decay from 0.1 rad, and a nominal device that is 1 % off in resonance and a third in Q."""
    axis = Axis(Mechanics(1e-10, 1e-10 * W / QUALITY, 1e-10 * W**2), readout=readout, name="x")
    nominal = replace(axis, mechanics=Mechanics(1e-10, 1e-10 * W / 60.0, 1.02e-10 * W**2))
    plan = Plan({"x": Constant(0.0)}, cycles / 5000.0, 2e5)
    recording, _ = simulate(Device("d", {"x": axis}), plan, start={"x": InitialState(0.1, 0.0)}, seed=seed)
    channels = {"sense_x": (recording["sense_x"].read(), "V", 2e5)}
    return Recording.from_arrays(channels), Device("d", {"x": nominal})


@pytest.mark.parametrize("cycles", [8.3, 100.0])
@pytest.mark.parametrize("readout", SENSORS, ids=lambda readout: readout.kind)
def test_sensors_of_the_motion_determine_the_ratios(readout: MotionSensor, cycles: float) -> None:
    recording, device = decay(readout, cycles, 5)
    found = identify([recording], device)
    for key, true in (("k_over_J", W**2), ("b_over_J", W / QUALITY)):
        value = found.values["x"][key]
        assert value.value == pytest.approx(true, abs=4.5 * value.sd)
        assert value.sd < 0.05 * true
    assert found.device.axes["x"].resonance == pytest.approx(5000.0, rel=2e-3)
    assert found.device.axes["x"].quality == pytest.approx(QUALITY, rel=0.1)
    assert any("without a reference angle" in note and "J, and the gain" in note for note in found.notes)


def test_a_capacitive_decay_determines_the_ratios_and_names_the_rest(tmp_path: Path) -> None:
    device = devices.load("chen2020")
    plan = Plan({"x": Constant(0.0)}, 0.006, 1e6)
    recording, _ = simulate(device, plan, start={"x": InitialState(0.15, 0.0)}, seed=2)
    channels = {"sense_x": (recording["sense_x"].read(), "V", 1e6)}
    found = identify([Recording.from_arrays(channels)], device)
    mechanics = device.axes["x"].mechanics
    assert mechanics is not None
    for key, true in (("k_over_J", mechanics.k / mechanics.J), ("b_over_J", mechanics.b / mechanics.J)):
        value = found.values["x"][key]
        assert value.value == pytest.approx(true, abs=4.5 * value.sd)
        assert value.sd < 0.03 * true
    assert any("J, theta0, C0, the gain of the readout, and the sign of the angle" in note for note in found.notes)
    Recording.from_arrays(channels, device).write(tmp_path / "decay.h5")
    assert main(["identify", str(tmp_path / "decay.h5"), "-o", str(tmp_path / "out")]) == 0
    assert "amplitude_over_theta0" in (tmp_path / "out/summary.json").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("quality", "cycles", "amplitude", "noise"),
    [(20.0, 15, 0.8, 0.01), (200.0, 80, 0.5, 0.02), (200.0, 80, 0.05, 0.05)],
)
def test_a_capacitive_decay_does_not_end_at_an_amplitude_of_zero(
    quality: float, cycles: int, amplitude: float, noise: float
) -> None:
    """In the first cycles noise can outweigh what shows the amplitude; from one start, up to half of the fits stayed
    at an amplitude of nearly 0, or ended with a singular matrix. An amplitude that the signal does not show is left
    out."""
    axis = devices.load("chen2020").axis("x")
    readout, f, finer = axis.require_readout(), axis.resonance, 40
    assert isinstance(readout, Amdm)
    time = np.arange(cycles * 40 * finer) / (f * 40 * finer)
    signal = np.exp(-((amplitude * np.exp(-np.pi * f / quality * time) * np.sin(2 * np.pi * f * time + 0.3)) ** 2))
    for cutoff in readout.lpf_hz:
        signal = apply_lowpass(signal, cutoff, time[1])
    signal = signal[::finer]
    truth = {"b_over_J": 2 * np.pi * f / quality} | ({"amplitude_over_theta0": amplitude} if amplitude > 0.1 else {})
    inside = []
    for seed in range(20):
        rng = np.random.default_rng(73000 + seed)
        values = signal + noise * np.ptp(signal) * rng.standard_normal(signal.size)
        recording = Recording.from_arrays({"sense_x": (values, "V", f * 40)})
        found = fit_decay_without_angle(axis, recording["sense_x"])
        assert ("amplitude_over_theta0" in found) == (amplitude > 0.1)
        inside.append([abs(found[key].value - value) < 1.96 * found[key].sd for key, value in truth.items()])
    assert np.mean(inside, axis=0).min() >= 0.8


def test_seven_cycles_are_refused_and_so_is_another_motion() -> None:
    recording, device = decay(SENSORS[0], 7.5, 1)
    with pytest.raises(BadInput, match=r"holds 7\.\d+ cycles of a free decay; record 8 cycles or more"):
        fit_decay_without_angle(device.axes["x"], recording["sense_x"])
    time = np.arange(20_000) / 2e5
    wrong = Recording.from_arrays({"sense_x": (np.sin(2 * np.pi * 5000 * time + 4.0 * np.sin(60 * time)), "V", 2e5)})
    with pytest.raises(BadInput, match="does not follow a free decay"):
        fit_decay_without_angle(device.axes["x"], wrong["sense_x"])


@pytest.mark.parametrize("channel", ["sense_x", "angle_x"])
def test_noise_alone_is_no_reason_to_refuse_a_decay(channel: str) -> None:
    """The noise is a fourth of the amplitude at the start. The record is three times as long as the decay time."""
    time = np.arange(3000) / 2e5
    device = decay(SENSORS[0], 10.0, 0)[1]
    unit, gain = ("V", 10.0) if channel == "sense_x" else ("rad", 1.0)
    for seed in range(4):
        noise = 0.025 * np.random.default_rng(seed).standard_normal(time.size)
        angle = 0.1 * np.exp(-0.5 * W / QUALITY * time) * np.cos(W * time) + noise
        values = identify([Recording.from_arrays({channel: (gain * angle, unit, 2e5)})], device).values["x"]
        for key, true in (("k_over_J", W**2), ("b_over_J", W / QUALITY)):
            assert values[key].value == pytest.approx(true, abs=4.0 * values[key].sd)
            assert values[key].sd < 0.1 * true


def test_no_note_asks_for_the_driven_motion_that_was_recorded() -> None:
    recording, device = decay(SENSORS[0], 100.0, 5)
    axis = replace(device.axes["x"], drive=Drive("linear", torque_per_volt=1e-4))
    plan = Plan({"x": Sweep(4900.0, 5100.0, 0.1, 1.0)}, 0.1, 2e5)
    driven, _ = simulate(Device("d", {"x": axis}), plan, seed=1)
    found = identify([recording, driven], Device("d", {"x": axis}))
    assert "J" in found.values["x"]
    assert not any("driven motion for J" in note for note in found.notes)


@pytest.mark.parametrize("volt", [0.0, 10.0])
def test_the_interval_contains_the_stiffness_of_a_bias(volt: float) -> None:
    """Of chen2019: 0.7 % of k for small motions, 500 times the interval by the noise."""
    device = devices.load("chen2019")
    recording, _ = simulate(device, Plan({"x": Constant(volt)}, 0.1, 2e5), start={"x": InitialState(0.12, 0.0)}, seed=1)
    channels = {"sense_x": (recording["sense_x"].read(), "V", 2e5), "bias_x": (np.full(20_000, volt), "V", 2e5)}
    found = identify([Recording.from_arrays(channels)], device)
    mechanics, ratio = device.axes["x"].require_mechanics(), found.values["x"]["k_over_J"]
    assert ratio.ci95[0] < mechanics.k / mechanics.J < ratio.ci95[1]
    assert (ratio.sd > 1e-4 * ratio.value) == (volt > 0.0)
    assert any("bias of 10 V" in note for note in found.notes) == (volt > 0.0)
