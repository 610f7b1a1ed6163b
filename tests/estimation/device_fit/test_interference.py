"""A tone in the residual is distinguished from the lines of the drive and from a resonance of the amplifier."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from estimation.device_fit.data import prepare_run
from estimation.device_fit.fit import Likelihood, fit_model, linearise_at
from estimation.device_fit.initial import flat_whiteners
from estimation.device_fit.interference import strongest_interfering_line
from estimation.device_fit.model import Model
from scanner.arrays import Array
from scanner.recording import Recording
from tests.support.bench import DEVICE, RESONANCE_HZ, SAMPLE_RATE_HZ, SAMPLES
from tests.support.simulated import shared_electrode

TIME = np.arange(SAMPLES) / SAMPLE_RATE_HZ
NOISE_SD = 2e-3


def strongest_line(drive: Array, disturbance: Array) -> float | None:
    """Interfering line [Hz] of the bench's axis where ``disturbance`` [V] is added to its sense signal."""
    channels = {
        "drive_x": (drive, "V", SAMPLE_RATE_HZ, 0.0),
        "sense_x": (disturbance, "V", SAMPLE_RATE_HZ, 0.0),
    }
    run = prepare_run(Recording.from_arrays(channels, device=DEVICE, name="tone"), DEVICE)
    model = Model([run], DEVICE)
    data = model.outputs(np.zeros(len(model.parameters)))[0][0] + run.outputs[0].data
    disturbed = Model([replace(run, outputs=(replace(run.outputs[0], data=data),))], DEVICE)
    likelihood = Likelihood(disturbed.runs, flat_whiteners(disturbed))
    fit = fit_model(likelihood, disturbed, np.zeros(len(disturbed.parameters)), max_iterations=1)
    return strongest_interfering_line(fit)


def test_a_foreign_tone_among_the_lines_of_a_multisine_is_detected() -> None:
    """A multisine of many lines leaves few bins free, and the tone is one line next to a line of the drive."""
    rng = np.random.default_rng(7)
    lines = 20.0 + 15.0 * np.arange(80)
    drive = 0.3 * np.sin(2 * np.pi * np.multiply.outer(TIME, lines) + rng.uniform(0, 2 * np.pi, 80)).sum(-1)
    noise = rng.normal(0, NOISE_SD, SAMPLES)
    assert strongest_line(drive, noise) is None
    line = strongest_line(drive, noise + 5e-3 * np.cos(2 * np.pi * 336.0 * TIME))
    assert line == pytest.approx(336.0, abs=3.0)


def test_the_stronger_of_a_tone_among_the_lines_of_the_drive_and_one_off_them_is_returned() -> None:
    rng = np.random.default_rng(8)
    lines = 20.0 + 15.0 * np.arange(80)
    drive = 0.3 * np.sin(2 * np.pi * np.multiply.outer(TIME, lines) + rng.uniform(0, 2 * np.pi, 80)).sum(-1)
    weak = rng.normal(0, NOISE_SD, SAMPLES) + 2e-3 * np.cos(2 * np.pi * 4260.0 * TIME)
    assert strongest_line(drive, weak) == pytest.approx(4260.0, abs=5.0)
    line = strongest_line(drive, weak + 3e-2 * np.cos(2 * np.pi * 336.0 * TIME))
    assert line == pytest.approx(336.0, abs=3.0)


@pytest.mark.parametrize("seed", range(6))
def test_a_resonance_of_the_amplifier_is_no_tone_and_hides_none(seed: int) -> None:
    """It is narrower than a band of the noise spectrum, whose median lies far below its peak."""
    rng = np.random.default_rng(seed)
    frequency = np.fft.rfftfreq(SAMPLES, 1 / SAMPLE_RATE_HZ)
    density = 1.0 + 30.0 * np.exp(-0.5 * ((frequency - 4260.0) / 130.0) ** 2)
    noise = np.fft.irfft(np.fft.rfft(rng.normal(0, NOISE_SD, SAMPLES)) * np.sqrt(density), SAMPLES)
    drive = np.sin(2 * np.pi * RESONANCE_HZ * TIME)
    assert strongest_line(drive, noise) is None
    line = strongest_line(drive, noise + 3e-3 * np.cos(2 * np.pi * 4260.0 * TIME))
    assert line == pytest.approx(4260.0, abs=5.0)


@pytest.mark.parametrize(("axis", "multiple", "detected"), [("x", 3, False), ("y", 2, False), ("y", 3.5, True)])
def test_harmonics_of_both_axes_of_a_shared_channel_are_no_tones(axis: str, multiple: float, detected: bool) -> None:
    recording, _ = shared_electrode()
    assert recording.device is not None
    run = prepare_run(recording, recording.device)
    model = Model([run], recording.device, mains=())
    starts = [spec.kind == "start" and spec.name == "angle" for spec in model.parameters]
    x, output, frequency = np.where(starts, 0.7, 0.0), run.outputs[0], multiple * run.scales[axis].rate / (2 * np.pi)
    noise = np.random.default_rng(3).normal(0, 1e-3, output.data.size)
    tone = 5e-3 * np.cos(2 * np.pi * frequency * output.step * np.arange(output.data.size))
    data = model.outputs(x)[0][0] + noise + tone
    disturbed = Model([replace(run, outputs=(replace(output, data=data),))], recording.device, mains=())
    fit = linearise_at(Likelihood(disturbed.runs, flat_whiteners(disturbed)), disturbed, x)
    assert strongest_interfering_line(fit) == (pytest.approx(frequency, rel=1e-3) if detected else None)
