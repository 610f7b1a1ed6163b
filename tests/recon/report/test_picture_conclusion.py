"""The conclusion of a reconstruction: what displaces the samples, what was assumed, and what to do."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from recon.imaging.sample_motion.rigid_motion import SampleMotion
from recon.pipeline import reconstruct
from recon.report.picture_conclusion import conclude_reconstruction
from recon.report.summary import summarise
from recon.steps.reconstruction import Options, Reconstruction
from tests.support.simulated import imaging


@cache
def reconstructed() -> Reconstruction:
    return reconstruct(imaging()[0], Options(pixels=(100, 100)), quiet=True)


def conclude(result: Reconstruction) -> str:
    return conclude_reconstruction(summarise(result))


@pytest.mark.parametrize(("moving", "sd"), [(True, 2.0), (False, 0.5)])
def test_a_motion_of_the_sample_that_is_left_blurs_the_picture(moving: bool, sd: float) -> None:
    """At rest the standard deviation of a single block is no displacement, and ``left`` is."""
    left = np.array([2.0, 0.0])
    shift = np.zeros((2, 2))
    motion = SampleMotion(100, np.array([0.0, 1e4]), shift, np.tile([sd, 0.1], (2, 1)), moving, 50.0, left, ())
    result = replace(reconstructed(), sample_motion=motion)
    summary = summarise(result)
    assert summary["x"]["blur_px"]["sample"] == pytest.approx(2.0)
    assert summary["x"]["blur_px"]["total"] > 2.0
    assert summary["sample_motion"]["within_tolerance"]["x"] == pytest.approx(0.383, abs=0.001)
    text = conclude_reconstruction(summary)
    assert text.startswith("The picture is blurred: a motion of the sample of 2 px in x")
    assert "Run lissajous diagnose" not in text


def test_a_motion_of_the_sample_that_was_removed_leaves_the_picture_sharp() -> None:
    shift, sd = np.array([[5.0, 0.0], [-5.0, 0.0]]), np.full((2, 2), 0.05)
    motion = SampleMotion(100, np.array([0.0, 1e4]), shift, sd, True, 50.0, np.zeros(2), ())
    assert conclude(replace(reconstructed(), sample_motion=motion)).startswith("The picture is sharp")


def test_a_delay_that_was_only_assumed_is_neither_a_blur_nor_the_absence_of_one() -> None:
    """A scene that determines no phase: its readout is not checked, and nothing shows whether it blurs."""
    recording = imaging()[0]
    noise = np.random.default_rng(0).normal(1.0, 0.1, recording["intensity"].size)
    recording = recording.with_channel(replace(recording["intensity"], raw=noise, gain=1.0, offset=0.0))
    summary = summarise(reconstruct(recording, Options(), quiet=True)) | {"limits": []}
    assert summary["x"]["within_bound"] < 0.5 < 0.99 < summary["x"]["readout_as_stated"]["within_bound"]
    text = conclude_reconstruction(summary)
    assert text.startswith("The phase could not be checked to within the bound of")
    assert "a readout delay of 0.5 µs (1 sd)" in text
    assert "diagnose" not in text
    assert "blurred" not in text


def test_noise_of_the_estimator_beyond_the_bound_is_a_blur() -> None:
    result = reconstructed()
    axis = result.motion.axes["x"]
    noisy = replace(axis, phase_sd=np.full_like(axis.phase_sd, 0.1))
    motion = replace(result.motion, axes={**result.motion.axes, "x": noisy})
    result = replace(result, motion=motion, estimator_phase_sd={**result.estimator_phase_sd, "x": noisy.phase_sd})
    assert conclude(result).startswith("The picture is blurred: the phase is known to 5.73° in x")
