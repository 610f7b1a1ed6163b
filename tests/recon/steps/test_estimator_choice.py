"""The estimator of a recording with position sensors follows from their noise and from the model of the motion."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from phantoms.experiment import Experiment, simulate_experiment
from phantoms.waveforms import Sine
from recon.pipeline import reconstruct
from recon.report.picture_conclusion import conclude_reconstruction
from recon.report.summary import summarise
from recon.steps import estimator_choice
from recon.steps.estimator_choice import choose_estimator
from recon.steps.preparation import prepare
from recon.steps.reconstruction import Options, Reconstruction
from scanner.device import Axis, Device
from scanner.recording import Recording
from scanner.stages import Drive, Mechanics, Position, Scan

HALF_ANGLE, GAIN, PIXELS = 0.088, 20.0, (200, 200)
NOISE_PX = 1.5


def mirror(noise_px: float) -> Device:
    """Resonances of 2.0 kHz and 835 Hz, Q 100, with position detectors."""
    readout = Position(GAIN, noise_px * GAIN * HALF_ANGLE / (PIXELS[0] / 2))
    mechanics = {"x": Mechanics(1e-10, 1.25e-8, 1.579e-2), "y": Mechanics(4e-10, 2.1e-8, 1.1e-2)}
    axes = {
        name: Axis(each, drive=Drive("linear", 1e-6), readout=readout, name=name) for name, each in mechanics.items()
    }
    return Device("mirror", axes, scan=Scan(HALF_ANGLE, HALF_ANGLE))


@cache
def scan(noise_px: float) -> Recording:
    drives = {"x": Sine(2000.0, 13.5), "y": Sine(835.0, 9.5)}
    device = mirror(noise_px)
    experiment = Experiment(device=device, drives=drives, duration=0.05, sample_rate=2e5, drift={})
    recording, _ = simulate_experiment(experiment, seed=2)
    return replace(recording, device_toml=device.to_toml())


@cache
def reconstructed(estimator: str | None) -> Reconstruction:
    return reconstruct(scan(NOISE_PX), Options(pixels=PIXELS, estimator=estimator), quiet=True)


@pytest.mark.parametrize(("noise_px", "expected"), [(0.2, "sensor"), (NOISE_PX, "tracker")])
def test_noise_beyond_the_tolerance_is_left_to_the_tracker(noise_px: float, expected: str) -> None:
    assert choose_estimator(prepare(scan(noise_px)), Options(pixels=PIXELS))[0] == expected


@pytest.mark.parametrize("tried", [0.03, 0.02])
@pytest.mark.parametrize(("noise_px", "expected"), [(0.2, "sensor"), (NOISE_PX, "tracker")])
def test_the_beginning_of_a_scan_decides_or_all_of_it_where_that_is_too_short(
    monkeypatch: pytest.MonkeyPatch, tried: float, noise_px: float, expected: str
) -> None:
    monkeypatch.setattr(estimator_choice, "TRIED_S", tried)
    lengths, estimate = [], estimator_choice.estimate
    monkeypatch.setattr(
        estimator_choice, "estimate", lambda part, *rest: (lengths.append(part.duration), estimate(part, *rest))[1]
    )
    recording = scan(noise_px)
    assert choose_estimator(prepare(recording), Options(pixels=PIXELS))[0] == expected
    assert lengths[-1] == pytest.approx(tried if tried == 0.03 else recording.duration, rel=1e-3)


def test_a_model_that_is_worse_than_the_noise_is_not_used() -> None:
    """A sensor of y that shows a staircase: no resonant motion follows it."""
    recording = scan(NOISE_PX)
    sense = recording["sense_y"]
    time = sense.time()
    steps = GAIN * 0.07 * (np.floor(time / 0.005) % 2.0 - 0.5) * 2.0
    noise = np.random.default_rng(3).normal(0.0, 0.024, time.size)
    stepped = recording.with_channel(replace(sense, raw=steps + noise, gain=1.0, offset=0.0))
    assert choose_estimator(prepare(stepped), Options(pixels=PIXELS))[0] == "sensor"


def test_the_noise_of_single_samples_counts_where_the_sensor_is_asked_for() -> None:
    summary = summarise(reconstructed("sensor"))
    assert summary["x"]["blur_px"]["sensor"] == pytest.approx(NOISE_PX, rel=0.01)
    assert summary["within_bound"]["x"] == pytest.approx(0.495, abs=0.02)  # of a normal value within 1/1.5 sd
    text = conclude_reconstruction(summary)
    assert text.startswith("The picture is blurred: the noise of the position signals moves single samples by 1.5 px")
    assert "Use --estimator tracker" in text


def test_the_chosen_tracker_is_stated_and_gives_a_sharp_picture() -> None:
    result = reconstructed(None)
    assert result.motion.estimator == "tracker"
    assert result.notes[0].startswith("the noise of the position signals moves single samples by 1.5 pixels in x")
    assert summarise(result)["within_bound"]["x"] > 0.99


def test_the_amplitude_that_a_note_states_is_without_the_noise() -> None:
    """The field is a little too small, so that the note appears."""
    device = replace(mirror(NOISE_PX), scan=Scan(0.084, 0.084))
    result = reconstruct(scan(NOISE_PX), Options(device=device, pixels=PIXELS, estimator="sensor"), quiet=True)
    (note,) = (note for note in result.notes if "outside the field" in note)
    amplitude = summarise(result)["x"]["amplitude_rad"]
    assert float(note.split("x up to ")[1].split(" of")[0]) == pytest.approx(amplitude, rel=0.005)
