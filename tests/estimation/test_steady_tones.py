"""Frequency responses as lists of steady tones: simulated effects, the measured fibre scanner, wrong input."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from estimation.complete_diagnosis import diagnose_with_optics
from estimation.diagnosis.diagnose import Diagnosis
from estimation.identification.calibrate import identify
from estimation.slow.response import Response, fit_response
from estimation.slow.steady_tones import frequency_responses
from recon.io.convert import convert
from scanner.active_terms import stated_terms
from scanner.arrays import Array
from scanner.device import Axis, Device
from scanner.errors import BadInput
from scanner.forward_model import DriveInput, sense_signal, simulate_axis
from scanner.integrator.nodes import to_nodes
from scanner.recording import Recording
from scanner.stages import Acceleration, Drive, Mechanics, MotionSensor, Position, Velocity

F0, Q = 800.0, 300.0
W0 = 2 * np.pi * F0
AXIS = Axis(Mechanics(2.0, 2.0 * W0 / Q, 2.0 * W0**2), readout=Position(10.0, 1e-4), name="x")
FREQUENCY = np.linspace(795.0, 805.0, 25)


def recording(angle: Array, frequency: Array = FREQUENCY, f0: float = F0) -> Recording:
    w = 2 * np.pi * f0
    axis = Axis(Mechanics(2.0, 2.0 * w / Q, 2.0 * w**2), readout=Position(10.0, 1e-4), name="x")
    rng = np.random.default_rng(1)
    angle = angle + 5e-5 * (rng.normal(size=angle.size) + 1j * rng.normal(size=angle.size))
    extra = {"reference": "frequency"}
    channels = {
        "frequency": (frequency, "Hz", 1.0),
        "amplitude_x": (np.abs(angle), "rad", 1.0, 0.0, extra),
        "phase_x": (np.angle(angle), "rad", 1.0, 0.0, extra),
    }
    return Recording.from_arrays(channels, Device("lever", {"x": axis}))


def mode(f0: float, quality: float, height: float, detuning: Array | float = 0.0) -> Array:
    r = FREQUENCY / f0
    return np.asarray(height / quality / (1 - r**2 + 1j * r / quality + detuning))


def names(diagnosis: Diagnosis) -> list[str]:
    return [finding.effect for finding in diagnosis.findings]


def test_a_linear_response_is_consistent_and_corrects_resonance_and_damping() -> None:
    found = diagnose_with_optics([recording(mode(F0, Q, 0.1), f0=800.5)])
    assert (found.verdict, names(found)) == ("consistent", [])
    assert found.device.axes["x"].resonance == pytest.approx(F0, abs=0.01)
    loop = found.open_loop["amplitude_x"]
    assert loop["improved"]["fraction"] < 0.1 * loop["nominal"]["fraction"]


@pytest.mark.parametrize("delay", [2e-3, 0.02])
def test_a_delay_of_the_readout_is_named_and_measured(delay: float) -> None:
    late = np.exp(-2j * np.pi * FREQUENCY * delay)
    found = diagnose_with_optics([recording(mode(F0, Q, 0.1) * late)])
    (finding,) = found.findings
    (parameter,) = finding.parameters
    assert (finding.effect, finding.stage, parameter.name, parameter.unit) == ("channel-delay", "timing", "delay", "s")
    assert finding.probability > 0.9
    assert parameter.ci95[0] < delay < parameter.ci95[1]
    assert found.device.axes["x"].resonance == pytest.approx(F0, abs=0.01)


@pytest.mark.parametrize(("inertia", "gain"), [(1.03, 1.0), (1.0, 0.97)])
def test_the_interval_of_a_law_contains_the_tolerances_of_inertia_and_gain(inertia: float, gain: float) -> None:
    """With an inertia 2 % off, that of k3 was five times narrower than its error."""
    drive = FREQUENCY / F0
    angle = mode(F0, Q, 0.1)
    for _ in range(200):  # harmonic balance; the detuning is 3 k3 |angle|^2 / (4 k)
        angle = 0.5 * (angle + 0.1 / Q / (1.0 - drive**2 + 1j * drive / Q + 0.15 * np.abs(angle) ** 2))
    made = recording(angle)
    axis = Axis(AXIS.require_mechanics(), readout=Position(10.0 * gain, 1e-4), name="x")
    mechanics = Mechanics(*(inertia * value for value in (2.0, 2.0 * W0 / Q, 2.0 * W0**2)))
    axis = replace(axis, mechanics=mechanics)
    size = made["amplitude_x"]
    channels = {**made.channels, "amplitude_x": replace(size, raw=10.0 * size.read(), unit="V")}
    found = diagnose_with_optics([replace(made, channels=channels)], Device("lever", {"x": axis}))
    (finding,) = found.findings
    (k3,) = finding.parameters
    assert finding.effect == "cubic-stiffness"
    assert k3.ci95[0] < 0.2 * 2.0 * W0**2 < k3.ci95[1]


def test_a_phase_of_the_wrong_sign_is_refused() -> None:
    """It gave a resonance at 1200 Hz, and feedthrough with cubic damping."""
    made = recording(mode(F0, Q, 0.1).conj())
    with pytest.raises(BadInput, match=r"^phase_x: rises with the frequency .* state gain = -1"):
        diagnose_with_optics([made])
    with pytest.raises(BadInput, match=r"^phase_x: rises with the frequency"):
        identify([made], made.device)


@pytest.mark.parametrize("quality", [1e5, 5e6])
def test_a_very_high_quality_factor_is_found(quality: float) -> None:
    """Above 1e6 it ended with a traceback, as the start of the fit was beyond its limits."""
    frequency = F0 * (1.0 + np.linspace(-2.0, 2.0, 41) / quality)
    ratio = frequency / F0
    made = recording(0.1 / quality / (1.0 - ratio**2 + 1j * ratio / quality), frequency)
    found = diagnose_with_optics([made])
    assert (found.verdict, names(found)) == ("consistent", [])
    assert found.device.axes["x"].quality == pytest.approx(quality, rel=5e-3)


def test_tones_repeated_beside_one_glitch_have_a_width() -> None:
    """Half of the power was reached at the repetitions themselves: a width of 0 ended with a traceback."""
    angle, frequency = np.repeat(mode(F0, Q, 0.1), 3), np.repeat(FREQUENCY, 3)
    angle[np.argmax(np.abs(angle)) + 1] *= 1.6
    (response,) = frequency_responses(recording(angle, frequency), Device("lever", {"x": AXIS}))
    assert fit_response(response, ()).modes[0] == pytest.approx([F0, Q], rel=0.3)


@pytest.mark.parametrize("missing", ["frequency", "amplitude_x", "phase_x"])
def test_a_tone_that_is_not_finite_is_left_out(missing: str) -> None:
    """With an amplitude of NaN the error of the prediction was NaN, which no JSON holds; a frequency of NaN counted as
    a tone."""
    made = recording(mode(F0, Q, 0.1))
    values = made[missing].read()
    values[3] = np.nan
    channels = {**made.channels, missing: replace(made[missing], raw=values)}
    (response,) = frequency_responses(replace(made, channels=channels), made.device)
    assert response.frequency.tolist() == np.delete(FREQUENCY, 3).tolist()
    assert np.isfinite(response.values).all()
    assert response.scale == pytest.approx(1.0)


def test_two_modes_are_found_with_their_frequencies() -> None:
    found = diagnose_with_optics([recording(mode(F0, Q, 0.1) + mode(801.5, 400.0, 0.03j))])
    assert names(found) == ["second-mode"]
    values = {each.name: each for each in found.findings[0].parameters}
    assert values["f2"].value == pytest.approx(801.5, abs=0.05)
    assert values["f2"].ci95[0] < 801.5 < values["f2"].ci95[1]
    assert "drive each axis alone" in str(found.findings[0].advice)


def played(device: Device, tone: float) -> complex:
    """Steady response of a device's sense signal to a tone of 1 V."""
    rate, duration = 64.0 * F0, 1.5
    time = np.arange(int(rate * duration)) / rate
    halves = np.cos(2 * np.pi * tone * np.arange(2 * time.size - 1) / (2 * rate))
    axis = device.axes["x"]
    motion = simulate_axis(axis, stated_terms(axis), DriveInput(to_nodes(halves), 1 / rate), (0.0, 0.0))
    assert axis.readout is not None
    late = time > 1.0
    window = np.hanning(int(late.sum()))
    tone_wave = np.exp(-2j * np.pi * tone * time)
    return complex(2 * np.sum(window * tone_wave[late] * sense_signal(axis.readout, [motion])[late]) / window.sum())


def test_a_device_with_a_linear_drive_takes_the_second_mode_relative_to_the_first() -> None:
    response = mode(F0, Q, 0.1) + mode(801.5, 400.0, 0.03j)
    made = recording(response * np.exp(0.7j))
    driven = {"x": replace(AXIS, drive=Drive("linear", 5e3))}
    found = diagnose_with_optics([made], Device("lever", driven))
    terms = found.device.axes["x"].terms["driven-modes"]
    assert terms["frequency"] == [pytest.approx(801.5, abs=0.05)]
    assert Device.from_toml(found.device.to_toml()).axes["x"].terms == found.device.axes["x"].terms
    tones = [4, 12, 15, 18]
    ratio = np.array([played(found.device, FREQUENCY[i]) for i in tones]) / response[tones]
    assert ratio / ratio[0] == pytest.approx(np.ones(4), abs=0.03)
    loop = found.open_loop["amplitude_x"]
    assert loop["improved"]["fraction"] < 0.02 < 0.1 < loop["nominal"]["fraction"]


@pytest.mark.parametrize("readout", [Velocity(0.01, 1e-4), Acceleration(-1e-6, 1e-4)], ids=["velocity", "acceleration"])
def test_a_linear_response_in_volts_is_that_of_the_angle(readout: MotionSensor) -> None:
    """Converted at the resonance, tones beside it differed by a constant: that was a finding of feedthrough."""
    frequency = np.linspace(720.0, 880.0, 41)
    ratio = frequency / F0
    angle = 0.1 / 30.0 / (1.0 - ratio**2 + 1j * ratio / 30.0)
    made = recording(angle * (2j * np.pi * frequency) ** readout.order * readout.gain, frequency)
    volts = {"amplitude_x": replace(made["amplitude_x"], unit="V")}
    sensed = Device("lever", {"x": replace(AXIS, readout=readout)})
    found = diagnose_with_optics([replace(made, channels={**made.channels, **volts})], sensed)
    assert (found.verdict, names(found)) == ("consistent", [])
    assert found.device.axes["x"].resonance == pytest.approx(F0, abs=0.05)


@pytest.mark.parametrize("k3", [1e7, -1e7])
def test_a_cubic_spring_is_found_with_its_size(k3: float) -> None:
    amplitude = np.full(FREQUENCY.size, 1e-3)
    for _ in range(400):  # harmonic balance, by a damped fixed point
        shift = 0.75 * k3 * amplitude**2 / (2.0 * W0**2)
        amplitude = 0.9 * amplitude + 0.1 * np.abs(mode(F0, Q, 0.1, shift))
    found = diagnose_with_optics([recording(mode(F0, Q, 0.1, 0.75 * k3 * amplitude**2 / (2.0 * W0**2)))])
    assert names(found) == ["cubic-stiffness"]
    assert found.findings[0].parameters[0].value == pytest.approx(k3, rel=0.05)
    assert found.device.axes["x"].terms["cubic-stiffness"]["k3"] == pytest.approx(k3, rel=0.05)


@pytest.mark.parametrize("more_modes", [False, True])
def test_identification_states_a_response_that_its_modes_miss(more_modes: bool) -> None:
    """Nothing said that the resonance and the quality factor were those of modes that miss the response by a third."""
    angle = mode(F0, Q, 0.1) + mode(798.0, 2000.0, 0.05) + mode(802.5, 2000.0, 0.05j)
    found = identify([recording(angle if more_modes else mode(F0, Q, 0.1))], Device("lever", {"x": AXIS}))
    assert any("the fitted modes miss the response" in note for note in found.notes) == more_modes


def test_feedthrough_is_found() -> None:
    assert names(diagnose_with_optics([recording(mode(F0, Q, 0.1) + 0.01j)])) == ["feedthrough"]


def test_the_interval_of_feedthrough_has_the_width_of_its_error() -> None:
    """Over the peak alone the height of the mode has nearly the same shape: the interval was 2.6 times too narrow."""
    frequency, scores = F0 * (1.0 + np.linspace(-0.7, 0.7, 25) / Q), []
    ratio = frequency / F0
    clean = 0.1 / Q / (1.0 - ratio**2 + 1j * ratio / Q) * np.exp(0.3j) + 0.008
    for seed in range(12):
        rng = np.random.default_rng(seed)
        response = Response("x", frequency, clean + 5e-4 * (rng.normal(size=25) + 1j * rng.normal(size=25)), True, 1.0)
        found = fit_response(response, ("feedthrough",))
        scores.append((abs(found.feedthrough) - 0.008) / found.feedthrough_sd)
    assert 0.6 < np.sqrt(np.mean(np.square(scores))) < 1.6


def test_a_quadratic_drag_in_volts_has_its_size_at_the_largest_amplitude() -> None:
    """Steady amplitudes of theta'' + b theta' + c |theta'| theta' + w0^2 theta, with c = 0.05; 0.7 V at the largest."""
    w, drag, amplitude = 2.0 * np.pi * FREQUENCY, 0.05, np.full(FREQUENCY.size, 0.1)
    for _ in range(200):
        linear = W0**2 - w**2 + 1j * w * W0 / Q
        angle = 0.12 * W0**2 / Q / (linear + drag * 8.0j / (3.0 * np.pi) * w**2 * amplitude)
        amplitude = 0.5 * (amplitude + np.abs(angle))
    largest = float(amplitude.max())
    made = recording(angle)
    volts = {"amplitude_x": replace(made["amplitude_x"], unit="V", gain=0.7 / largest)}
    without_gain = Device("lever", {"x": replace(AXIS, readout=None)})
    found = diagnose_with_optics([replace(made, channels={**made.channels, **volts})], without_gain)
    assert names(found) == ["quadratic-drag"]
    (size,) = found.findings[0].parameters
    assert (size.name, size.unit) == ("at_largest_amplitude", "1")
    assert size.ci95[0] < drag * largest < size.ci95[1]
    assert size.value == pytest.approx(drag * largest, rel=0.1)


def test_identify_takes_steady_tones() -> None:
    made = recording(mode(801.0, 250.0, 0.1))
    assert made.device is not None
    found = identify([made], made.device)
    assert found.values["x"]["k_over_J"].value == pytest.approx((2 * np.pi * 801.0) ** 2, rel=1e-5)
    assert found.values["x"]["b_over_J"].value == pytest.approx(2 * np.pi * 801.0 / 250.0, rel=0.02)


def test_too_few_tones_are_refused() -> None:
    few = slice(0, 5)
    with pytest.raises(BadInput, match="holds 5 steady tones, 10 are needed"):
        diagnose_with_optics([recording(mode(F0, Q, 0.1)[few], FREQUENCY[few])])


def test_the_fibre_scanner_has_two_modes(measured_data: Path) -> None:
    source = measured_data / "fibre_scanner/lockin_sweep.txt"
    lock_in = {"sample_rate": 1.0, "reference": "frequency"}
    channels: dict[str, object] = {"frequency": {"variable": "FreqR_Hz", "unit": "Hz", "sample_rate": 1.0}}
    for axis in "xy":
        parts = [f"L{axis}i_mm", f"L{axis}q_mm"]
        channels[f"amplitude_{axis}"] = {"variable": parts, "unit": "V", **lock_in}
        channels[f"phase_{axis}"] = {"variable": parts, "unit": "rad", **lock_in}
    w = 2 * np.pi * 805.0
    axis_table = {
        "mechanics": {"J": 1.0, "b": w / 300.0, "k": w**2},
        "drive": {"kind": "linear", "torque_per_volt": 4e5},
    }
    with convert(source, {"channels": channels, "device": {"x": axis_table, "y": axis_table}}) as made:
        assert made["amplitude_x"].read()[0] == pytest.approx(np.hypot(0.12990, 0.06241))
        found = diagnose_with_optics([made])
    seconds = [finding for finding in found.findings if finding.effect == "second-mode"]
    assert [finding.axis for finding in seconds] == ["x", "y"]
    for finding in seconds:
        values = {each.name: each.value for each in finding.parameters}
        assert 0.7 < abs(values["f1"] - values["f2"]) < 2.2
        assert finding.rivals[0].effect == "cross-axis-coupling"
        stated = found.device.axes[finding.axis].terms["driven-modes"]
        assert stated["frequency"] == [values["f2"]]
        loop = found.open_loop[f"amplitude_{finding.axis}"]
        assert loop["improved"]["rmse"] < 0.5 * loop["nominal"]["rmse"]
