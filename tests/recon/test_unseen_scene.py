"""Recordings whose detector did not see the scene: off for a part of the scan, or saturated."""

from __future__ import annotations

import numpy as np
import pytest

from recon.pipeline import reconstruct
from recon.sequences.frames import frames
from recon.steps.reconstruction import Options, Reconstruction
from scanner.arrays import Array
from scanner.recording import Recording
from tests.support.simulated import imaging


def picture_of(values: Array, kind: str = "mean") -> Reconstruction:
    """The reconstruction of a scan of 20 ms with other samples of the intensity."""
    recording, _ = imaging()
    channels = {
        name: (each.read(), each.unit, each.sample_rate, each.start) for name, each in recording.channels.items()
    }
    channels["intensity"] = (values, *channels["intensity"][1:])
    options = Options(pixels=(128, 128), picture=kind, sense_only=True)
    return reconstruct(Recording.from_arrays(channels, recording.device), options, quiet=True)


def light() -> Array:
    return imaging()[0]["intensity"].read()


@pytest.mark.parametrize("kind", ["mean", "kernel", "posterior"])
def test_a_detector_that_is_off_for_half_of_the_scan_is_stated(kind: str) -> None:
    values = light()
    values[values.size // 2 :] = 0.0
    (limit,) = picture_of(values, kind).limits
    assert "from 0.01" in limit
    assert "do not show the scene that the rest shows" in limit


def test_a_covered_detector_that_still_has_noise_is_stated() -> None:
    values = light()
    part = slice(int(0.3 * values.size), int(0.6 * values.size))
    values[part] = np.random.default_rng(1).normal(0.0, 0.002, values[part].size)
    (limit,) = picture_of(values).limits
    assert "at least 28% of the scan, from 0.006" in limit or "at least 27% of the scan, from 0.006" in limit


def test_a_scene_that_is_dark_in_most_places_is_no_detector_that_is_off() -> None:
    values = light()
    beads = 5.0 * (values > np.quantile(values, 0.98)) + np.random.default_rng(2).normal(0.0, 0.01, values.size)
    assert picture_of(beads).limits == []
    assert picture_of(values * np.linspace(1.0, 0.4, values.size)).limits == []  # bleaching


@pytest.mark.parametrize("kind", ["mean", "kernel", "posterior"])
def test_no_standard_deviation_is_stated_for_saturated_pixels(kind: str) -> None:
    values = light()
    level = float(np.quantile(values, 0.7))
    result, clear = picture_of(np.minimum(values, level), kind), picture_of(values, kind)
    visited = result.picture.coverage > 0
    bright = visited & (clear.picture.image > 1.05 * level)
    dark = visited & (clear.picture.image < 0.8 * level)
    assert np.isnan(result.picture_sd[bright]).mean() > 0.97
    assert np.isfinite(result.picture_sd[dark]).mean() > 0.97
    (frame,) = frames(result, 1).estimates()
    assert np.isnan(frame.sd[bright]).mean() > 0.97
