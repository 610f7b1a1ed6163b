"""The diagnosis of the readout with the picture as the reference for the phase; the effects are simulated here."""

from __future__ import annotations

import json
from collections.abc import Callable

import numpy as np
import pytest

from estimation.complete_diagnosis import diagnose_with_optics
from estimation.estimate import estimate
from estimation.optics.readout_selection import demands_an_effect, diagnose_readout
from phantoms.optics import Detector, detect, sample_scene
from phantoms.targets import make_target
from recon.evaluation import evaluate_axis, truth_from_simulation
from recon.reference_phase import measure_reference_phase
from scanner.device import Device
from scanner.recording import Recording
from tests.support.simulated import imaging, with_sense

SAMPLE_RATE_HZ = 5e6


def filtered(response: Callable[[np.ndarray], np.ndarray]) -> Recording:
    """The imaging scan with its sense signal behind a filter, given as a function of the frequency [Hz]."""

    def change(sense: np.ndarray) -> np.ndarray:
        mirrored = np.fft.rfft(np.concatenate([sense, sense[::-1]]))
        gain = response(np.fft.rfftfreq(2 * sense.size, 1.0 / SAMPLE_RATE_HZ))
        return np.fft.irfft(mirrored * gain)[: sense.size]

    return with_sense(imaging()[0], change)


def improved(recording: Recording) -> tuple[list[str], Device]:
    """Effects that the picture shows, and the improved device."""
    assert recording.device is not None
    reference = measure_reference_phase(recording, recording.device)
    assert reference is not None
    findings, device = diagnose_readout(reference)
    return [finding.effect for finding in findings], device


def phase_rms_deg(recording: Recording, device: Device) -> float:
    """Phase error of x against the truth, from the sense signal alone [deg]."""
    truth = truth_from_simulation(imaging()[1])
    return float(np.degrees(evaluate_axis(estimate(recording, device).axes["x"], *truth.angles["x"]).phase_rmse))


@pytest.mark.parametrize(("delay_s", "demanded"), [(0.0, False), (1e-6, True)])
def test_a_delay_that_the_recording_lacks_leaves_phase_errors(delay_s: float, demanded: bool) -> None:
    recording = imaging()[0]
    assert recording.device is not None
    device = recording.device.with_terms({"x": {"channel-delay": {"delay": delay_s}}} if delay_s else {})
    reference = measure_reference_phase(recording, device)
    assert reference is not None
    assert demands_an_effect(reference) is demanded


@pytest.mark.parametrize(
    "response",
    [lambda f: np.exp(-2j * np.pi * f * 0.5e-6), lambda f: 1.0 / (1.0 + 1j * f / 300e3)],
    ids=["delay", "pole"],
)
def test_a_late_sense_signal_is_named_and_the_improved_device_corrects_it(
    response: Callable[[np.ndarray], np.ndarray],
) -> None:
    recording = filtered(response)
    reference = measure_reference_phase(recording, recording.device)
    assert reference is not None
    (finding,), device = diagnose_readout(reference)
    names = {finding.effect, *(rival.effect for rival in finding.rivals)}
    assert {"channel-delay", "readout-lag"} <= names  # alike at frequencies far below the corner
    assert finding.effect in ("channel-delay", "readout-lag")
    assert finding.probability > 0.4
    assert finding.heldout["after"] < 0.01 * finding.heldout["before"]
    assert finding.share == pytest.approx(1.0, abs=0.1)
    (parameter,) = finding.parameters
    assert parameter.ci95[0] < parameter.value < parameter.ci95[1]
    assert phase_rms_deg(recording, recording.device) > 2.0
    assert phase_rms_deg(recording, Device.from_toml(device.to_toml())) < 0.05


def test_feedthrough_is_named_or_listed_and_the_improved_device_corrects_it() -> None:
    drive = imaging()[0]["drive_x"].read()
    quadrature = np.gradient(drive) * SAMPLE_RATE_HZ / (2.0 * np.pi * 27680.0)
    recording = with_sense(imaging()[0], lambda sense: sense + 4e-4 * quadrature)
    (effect,), device = improved(recording)
    assert effect == "feedthrough"
    assert device.axes["x"].terms["feedthrough"]["h"] == pytest.approx(4e-4, rel=0.5)
    assert phase_rms_deg(recording, recording.device) > 0.5
    assert phase_rms_deg(recording, device) < 0.05


def test_a_readout_as_stated_shows_nothing() -> None:
    recording = imaging()[0]
    assert improved(recording) == ([], recording.device)


def test_corner_frequencies_within_their_tolerance_are_calibration() -> None:
    def corners_lower(f: np.ndarray) -> np.ndarray:
        response = 1.0 + 0.0j * f
        for corner in (40800.0, 41100.0):
            response = response * (1.0 + 1j * f / corner) / (1.0 + 1j * f / (0.99 * corner))
        return response

    recording = filtered(corners_lower)
    assert improved(recording) == ([], recording.device)


def test_a_late_intensity_is_not_a_late_readout() -> None:
    recording = imaging()[0]
    channels = {k: (c.read(), c.unit, c.sample_rate, c.start) for k, c in recording.channels.items()}
    light, *rest = channels["intensity"]
    channels["intensity"] = (np.roll(light, 3), *rest)
    late = Recording.from_arrays(channels, recording.device)
    assert improved(late) == ([], late.device)


def test_a_position_detector_that_is_late_is_named_in_the_complete_diagnosis() -> None:
    rate, duration = 2e6, 0.012
    readout = '[{0}.readout]\nkind = "position"\ngain = 20.0\nnoise_sd = 1e-3\n'
    device = Device.from_toml(
        readout.format("x") + readout.format("y") + "[scan]\nhalf_angle_x = 0.1\nhalf_angle_y = 0.1\n"
    )
    rng, time = np.random.default_rng(3), np.arange(round(rate * duration)) / rate

    def angle(axis: str, at: np.ndarray) -> np.ndarray:
        return 0.1 * np.sin(2.0 * np.pi * {"x": 9000.0, "y": 2130.0}[axis] * at + 0.3)

    light = sample_scene(make_target("immunohistochemistry"), angle("x", time), angle("y", time), 0.1, 0.1)
    channels = {
        f"sense_{axis}": (20.0 * angle(axis, time - 1e-6) + 1e-3 * rng.normal(size=time.size), "V", rate, 0.0)
        for axis in "xy"
    }
    channels["intensity"] = (detect(light, rate, Detector(photons_per_sample=1000.0), rng), "V", rate, 0.0)
    diagnosis = diagnose_with_optics(
        [Recording.from_arrays(channels, device)], measure_reference=measure_reference_phase
    )
    assert {finding.effect for finding in diagnosis.findings} <= {"channel-delay", "readout-lag"}
    assert {finding.axis for finding in diagnosis.findings} == {"x", "y"}
    content = json.loads(json.dumps(diagnosis.to_json()))
    assert content["verdict"] == "mismatch"
    assert all(finding["heldout"]["after"] < 0.1 * finding["heldout"]["before"] for finding in content["findings"])
