"""Decays diagnosed by their amplitude: simulated laws, measured membranes, long waveforms; lock-in channels."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from estimation.complete_diagnosis import diagnose_with_optics
from estimation.diagnosis.diagnose import Diagnosis
from estimation.estimate import default_estimator, estimate
from estimation.lock_in_channels import lock_in_values
from estimation.slow.decay import LAWS, solve_decay
from estimation.slow.diagnose import SlowDecay, slow_decays
from estimation.slow.selection import Decays, compress, fit_law, held_out, prediction_errors
from phantoms.forward import InitialState, Plan, simulate
from phantoms.waveforms import Constant
from recon.cli import main
from scanner.arrays import Array
from scanner.channel import DBM_LEVEL_V
from scanner.device import Axis, Device
from scanner.errors import BadInput, UnitUnknown
from scanner.recording import Recording
from scanner.stages import Mechanics, Position

W = 2 * np.pi * 5000.0
DEVICE = Device(
    "beam", {"x": Axis(Mechanics(1e-10, 1e-10 * W / 2e4, 1e-10 * W**2), readout=Position(10.0, 1e-3), name="x")}
)


def envelope(coefficient: float, power: float, seed: int = 1, unit: str = "rad", first: float = 0.1) -> Recording:
    """A decay over 8 s; ``coefficient``: rate that a law adds at 0.1 rad [1/s], ``first``: first amplitude [rad]."""
    rng, time = np.random.default_rng(seed), np.arange(0.0, 8.0, 0.01)
    rate = 8.0 * W / 2e4 / 2.0
    solved = solve_decay(np.log(first / 0.1), rate, 8.0 * coefficient, power, 0.0, 1.0, 2000)
    log_a = np.interp(time / 8.0, np.linspace(0, 1, 2001), solved)
    amplitude = 0.1 * np.exp(log_a) * (1.0 + 1e-4 * rng.normal(size=time.size))
    values = amplitude if unit == "rad" else 10.0 * amplitude if unit == "V" else 20.0 * np.log10(10.0 * amplitude)
    extra = {"reference": 5000.0} | ({"level": 1.0} if unit == "dB" else {})
    return Recording.from_arrays({"amplitude_x": (values, unit, 100.0, 0.0, extra)}, DEVICE)


def diagnosed(coefficient: float, power: float, seed: int = 1, unit: str = "rad") -> Diagnosis:
    """The diagnosis of one decay, see ``envelope``."""
    return diagnose_with_optics([envelope(coefficient, power, seed, unit)])


@pytest.mark.parametrize("unit", ["rad", "V", "dB"])
def test_cubic_damping_is_named_with_its_size_in_every_unit(unit: str) -> None:
    found = diagnosed(0.5, 2.0, unit=unit)
    (finding,) = found.findings
    assert finding.effect == "cubic-damping"
    assert finding.share is not None
    assert finding.share > 0.99
    true = 8.0 * 1e-10 * 0.5 / 0.1**2  # b3 = 8 J c / A0²
    (b3,) = finding.parameters
    assert b3.value == pytest.approx(true, rel=0.1)
    assert found.device.axes["x"].terms["cubic-damping"]["b3"] == b3.value
    assert {"gain-drift", "damping-drift"} <= {rival.effect for rival in finding.rivals}
    assert "record another amplitude" in str(finding.advice)


@pytest.mark.parametrize(("effect", "power"), [("quadratic-drag", 1.0), ("coulomb-friction", -1.0)])
def test_other_laws_are_named(effect: str, power: float) -> None:
    assert [finding.effect for finding in diagnosed(0.2, power).findings] == [effect]


@pytest.mark.parametrize("unit", ["rad", "V"])
def test_the_interval_of_a_law_contains_the_tolerances_of_inertia_and_gain(unit: str) -> None:
    """The motion determines the law over the inertia alone: with J 3 % off, b3 was 3 % off, its interval 2.6 % wide."""
    recording = envelope(0.5, 2.0, unit=unit)
    axis = DEVICE.axes["x"]
    assert axis.mechanics is not None
    scale = 1.0 if unit == "V" else 1.03
    mechanics = Mechanics(*(scale * value for value in (axis.mechanics.J, axis.mechanics.b, axis.mechanics.k)))
    readout = Position(10.0 * (0.97 if unit == "V" else 1.0), 1e-3)
    axes = {"x": replace(axis, mechanics=mechanics, readout=readout)}
    (finding,) = diagnose_with_optics([recording], replace(DEVICE, axes=axes)).findings
    (b3,) = finding.parameters
    assert finding.effect == "cubic-damping"
    assert b3.ci95[0] < 8.0 * 1e-10 * 0.5 / 0.1**2 < b3.ci95[1]
    assert b3.ci95[1] - b3.ci95[0] < 0.25 * b3.value


def test_constant_damping_is_consistent_and_takes_its_value() -> None:
    found = diagnosed(0.0, 1.0)
    assert (found.verdict, found.findings) == ("consistent", ())
    mechanics = found.device.axes["x"].mechanics
    assert mechanics is not None
    assert mechanics.b == pytest.approx(1e-10 * W / 2e4, rel=0.01)


def test_decays_from_two_amplitudes_have_one_law_and_exclude_a_drift_of_the_gain() -> None:
    found = diagnose_with_optics([envelope(0.5, 2.0), envelope(0.5, 2.0, seed=2, first=0.04)])
    (finding,) = found.findings
    assert finding.effect == "cubic-damping"
    assert finding.parameters[0].value == pytest.approx(8.0 * 1e-10 * 0.5 / 0.1**2, rel=0.1)
    assert "gain-drift" not in [rival.effect for rival in finding.rivals]
    assert finding.advice is None


def test_errors_are_those_of_samples_that_were_not_fitted() -> None:
    recording = envelope(0.5, 2.0)
    time, amplitude = recording["amplitude_x"].time(), recording["amplitude_x"].read()
    part = compress(time, amplitude)
    fitted = np.interp(
        np.arange(part.time.size), np.flatnonzero(held_out(part) < 0), part.log_amplitude[held_out(part) < 0]
    )
    hidden = part._replace(log_amplitude=np.where(held_out(part) < 0, part.log_amplitude, fitted + 1.0))
    laws = [fit_law(Decays.of([each]), LAWS[0]) for each in (part, hidden)]
    assert np.array_equal(laws[0].shared, laws[1].shared)
    errors = [
        prediction_errors(Decays.of([each]), law.predicted)[0] for each, law in zip((part, hidden), laws, strict=True)
    ]
    assert errors[0].error < 0.01 * errors[0].deviation
    assert errors[1].error > 0.1 * errors[1].deviation


def test_the_open_loop_errors_of_a_decay_are_in_the_unit_of_the_channel() -> None:
    in_rad, in_volt = (diagnosed(0.5, 2.0, unit=unit).open_loop["amplitude_x"] for unit in ("rad", "V"))
    for key in ("nominal", "improved"):
        assert in_volt[key]["rmse"] == pytest.approx(10.0 * in_rad[key]["rmse"], rel=1e-3)
        assert in_volt[key]["fraction"] == pytest.approx(in_rad[key]["fraction"], rel=1e-3)
    assert in_rad["improved"]["fraction"] < 0.1 * in_rad["nominal"]["fraction"]


def test_an_error_of_the_detector_is_no_law() -> None:
    recording = envelope(0.0, 1.0)
    amplitude = recording["amplitude_x"].read()
    curved = amplitude * (1.0 + 0.006 * np.sin(3.0 * np.log(amplitude)))
    channels = {"amplitude_x": (curved, "rad", 100.0, 0.0, {"reference": 5000.0})}
    assert diagnose_with_optics([Recording.from_arrays(channels, DEVICE)]).verdict == "consistent"


@pytest.mark.slow
def test_the_improved_device_decays_as_the_recording() -> None:
    device = Device.from_toml(DEVICE.with_terms({"x": {"cubic-damping": {"b3": 8e-8}}}).to_toml())
    plan = Plan({"x": Constant(0.0)}, 1.5, 1e5)
    recording, _ = simulate(device, plan, start={"x": InitialState(0.1, 0.0)}, nominal=DEVICE, seed=3)
    channels = {"sense_x": (recording["sense_x"].read(), "V", 1e5)}
    found = diagnose_with_optics([Recording.from_arrays(channels, DEVICE)])  # 7500 turns, by their amplitude
    (finding,) = found.findings
    assert finding.effect == "cubic-damping"
    assert finding.parameters[0].value == pytest.approx(8e-8, rel=0.1)


@pytest.mark.parametrize("off", [0.02, -0.05])
def test_a_waveform_beside_the_nominal_resonance_has_its_amplitude(off: float) -> None:
    """Blocks at the nominal frequency were 10 % low where the resonance is 2 % off, 46 % where it is 5 % off."""
    time = np.arange(250_000) / 5e4
    amplitude = 0.1 * np.exp(-0.5 * W / 2e4 * time)
    channels = {"angle_x": (amplitude * np.sin((1.0 + off) * W * time), "rad", 5e4)}
    (found,) = slow_decays(Recording.from_arrays(channels), DEVICE)
    assert found.amplitude == pytest.approx(np.interp(found.time, time, amplitude), rel=1e-3)


def test_a_missing_sample_of_a_long_waveform_takes_one_block() -> None:
    """The mean of the waveform was NaN, and with it every amplitude, which ended with a traceback."""
    time, rng = np.arange(250_000) / 5e4, np.random.default_rng(0)
    waveform = np.exp(-0.5 * W / 2e4 * time) * np.sin(W * time) + 1e-3 * rng.standard_normal(time.size)

    def decays(values: np.ndarray) -> SlowDecay:
        return slow_decays(Recording.from_arrays({"sense_x": (values, "V", 5e4)}), DEVICE)[0]

    whole, missing = decays(waveform), decays(np.where(time == time[1234], np.nan, waveform))
    assert np.flatnonzero(np.isnan(missing.amplitude)).tolist() == [1234 // 200]
    assert np.nanmax(np.abs(missing.amplitude - whole.amplitude)) < 1e-9
    with pytest.raises(BadInput, match="sense_x: holds no sample that can be used"):
        decays(np.full(time.size, np.nan))
    everywhere = {"sense_x": (np.where(np.arange(time.size) % 100, waveform, np.nan), "V", 5e4)}
    with pytest.raises(BadInput, match="sense_x: gives no amplitude above 0"):
        diagnose_with_optics([Recording.from_arrays(everywhere, DEVICE)])


@pytest.mark.parametrize(
    ("number", "effects"), [(3716, ["cubic-damping"]), (1448, ["cubic-damping"]), (505, []), (1721, [])]
)
def test_measured_membranes(measured_data: Path, number: int, effects: list[str]) -> None:
    (file,) = (measured_data / "membranes").glob(f"measID_{number}_*.txt")
    time, power = np.loadtxt(file, comments="%", delimiter=",").T
    channels = {"amplitude_x": (power, "dBm", 1.0 / (time[1] - time[0]), time[0], {"reference": 1.4e6})}
    found = diagnose_with_optics([Recording.from_arrays(channels, DEVICE)])
    assert [finding.effect for finding in found.findings] == effects
    assert all(finding.share is not None and finding.share > 0.9 for finding in found.findings)


def test_the_command_diagnoses_an_envelope(tmp_path: Path) -> None:
    time = np.arange(0.0, 8.0, 0.01)
    channels = {"amplitude_x": (-10.0 - 8.0 * time, "dBm", 100.0, 0.0, {"reference": 5000.0})}
    Recording.from_arrays(channels, DEVICE).write(tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5") as file:
        assert file["channels/amplitude_x"].attrs["reference"] == 5000.0
    with Recording.open(tmp_path / "a.h5") as made:
        assert made["amplitude_x"].read()[0] == pytest.approx(DBM_LEVEL_V * 10**-0.5)
    assert main(["diagnose", str(tmp_path / "a.h5"), "-o", str(tmp_path / "out")]) == 0
    assert (tmp_path / "out/report.html").is_file()


def test_amplitudes_without_level_or_with_another_unit_are_refused() -> None:
    with pytest.raises(BadInput, match="level is missing for an amplitude in dB"):
        Recording.from_arrays({"amplitude_x": (np.ones(9), "dB", 1.0)})
    with pytest.raises(UnitUnknown, match="unit 'm' is unknown"):
        Recording.from_arrays({"amplitude_x": (np.ones(9), "m", 1.0)})
    with pytest.raises(BadInput, match="reference is -1"):
        Recording.from_arrays({"phase_x": (np.ones(9), "rad", 1.0, 0.0, {"reference": -1})})
    with pytest.raises(BadInput, match="shows no free decay"):
        diagnose_with_optics([Recording.from_arrays({"amplitude_x": (np.arange(1.0, 99), "V", 1.0)}, DEVICE)])


@pytest.mark.parametrize("reference", [700.0, "frequency"])
def test_lock_in_channels_are_a_sensor(reference: float | str) -> None:
    slow, time = np.arange(0.0, 0.2, 1e-3), np.arange(20_000) / 1e5
    extra = {"reference": reference}
    channels = {
        "intensity": (time, "V", 1e5),
        "amplitude_x": (0.1 - 0.1 * slow, "rad", 1e3, 0.0, extra),
        "phase_x": (np.angle(np.exp(1j * 20.0 * slow)), "rad", 1e3, 0.0, extra),
        "frequency": (np.full(slow.size, 700.0), "Hz", 1e3),
    }
    recording = Recording.from_arrays(channels, Device.from_toml("[x]\n"))
    assert default_estimator(recording, recording.device) == "sensor"
    axis = estimate(recording).axes["x"]
    true = (0.1 - 0.1 * time) * np.sin(2 * np.pi * 700.0 * time + 20.0 * time)
    assert np.abs(axis.angle.read() - true)[: 199 * 100].max() < 1e-6
    assert axis.sign == "known: phase_x"


def decaying_lock_in_channels() -> tuple[Array, Array, dict[str, tuple[Any, ...]]]:
    """Times [s] of the lock-in amplifier and of the intensity, and channels of a motion that decays and is swept."""
    slow, time = np.arange(0.0, 0.2, 1e-3), np.arange(20_000) / 1e5
    extra = {"reference": "frequency"}
    channels = {
        "intensity": (time, "V", 1e5),
        "amplitude_x": (0.1 - 0.1 * slow, "rad", 1e3, 0.0, extra),
        "phase_x": (np.angle(np.exp(1j * 20.0 * slow)), "rad", 1e3, 0.0, extra),
        "frequency": (700.0 + 50.0 * slow, "Hz", 1e3),
    }
    return slow, time, channels


@pytest.mark.parametrize("channel", ["amplitude_x", "phase_x", "frequency"])
def test_a_missing_value_of_a_lock_in_amplifier_affects_the_samples_beside_it_only(channel: str) -> None:
    """A phase or a frequency of NaN made every later sample NaN; the estimator then ended with "diverges"."""
    slow, time, channels = decaying_lock_in_channels()
    channels[channel] = (np.where(slow == slow[5], np.nan, channels[channel][0]), *channels[channel][1:])
    recording = Recording.from_arrays(channels, Device.from_toml("[x]\n"))
    motion = estimate(recording)
    angle = motion.axes["x"].angle.read()[: 199 * 100]
    true = (0.1 - 0.1 * time) * np.sin(2 * np.pi * (700.0 + 25.0 * time) * time + 20.0 * time)
    assert np.flatnonzero(np.isnan(angle)).tolist() == list(range(401, 600))
    assert np.nanmax(np.abs(angle - true[: angle.size])) < 1e-5
    assert [note for note in motion.notes if "left out 199 samples of the intensity" in note]
    used, values = lock_in_values(recording, recording.device.axes["x"])
    assert used == pytest.approx(np.delete(slow, 5))
    assert np.angle(values) == pytest.approx(np.angle(np.exp(20j * used)))


@pytest.mark.parametrize("channel", ["amplitude_x", "phase_x", "frequency"])
def test_lock_in_channels_of_differing_length_are_used_in_their_common_time(channel: str) -> None:
    """The last phase was held after its end: angles there were wrong by up to the amplitude, without a line."""
    slow, _, channels = decaying_lock_in_channels()
    channels[channel] = (channels[channel][0][50:150], *channels[channel][1:3], slow[50], *channels[channel][4:])
    recording = Recording.from_arrays(channels, Device.from_toml("[x]\n"))
    motion = estimate(recording)
    known = np.flatnonzero(np.isfinite(motion.axes["x"].angle.read()))
    assert (known[0], known[-1]) == (5_000, 14_999)
    assert [note for note in motion.notes if "left out 10000 samples of the intensity" in note]
    used, _ = lock_in_values(recording, recording.device.axes["x"])
    assert used == pytest.approx(slow[50:150])


def test_a_lock_in_phase_without_a_finite_sample_is_refused() -> None:
    slow = np.arange(0.0, 0.2, 1e-3)
    channels = {
        "intensity": (np.arange(20_000.0), "V", 1e5),
        "amplitude_x": (0.1 - 0.1 * slow, "rad", 1e3, 0.0, {"reference": 700.0}),
        "phase_x": (np.full(slow.size, np.nan), "rad", 1e3, 0.0, {"reference": 700.0}),
    }
    with pytest.raises(BadInput, match="phase_x: holds no sample that can be used"):
        estimate(Recording.from_arrays(channels, Device.from_toml("[x]\n")))
