"""The conclusion of a reconstruction: what displaces the samples, what was assumed, and what to do."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from recon.imaging.sample_motion.rigid_motion import SampleMotion
from recon.pipeline import reconstruct
from recon.reconstruction import Options, Reconstruction
from recon.report.picture_conclusion import conclude_reconstruction
from recon.report.summary import summarise
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
