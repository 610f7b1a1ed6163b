"""Single samples far from all others are counted, and are neither saturation nor a detector that was off."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from recon.imaging.picture import Grid
from recon.imaging.saturation import detector_rails
from recon.imaging.wild_samples import find_repeated, find_wild_samples, wild_limits, without_wild_samples
from recon.pipeline import reconstruct
from recon.steps.intensity_notes import describe_wild_samples
from recon.steps.reconstruction import Options
from scanner.channel import Channel
from tests.support.simulated import imaging

RNG_SEED, WILD = 4, 60


def spoiled(values: np.ndarray, level: float) -> np.ndarray:
    out = values.copy()
    out[np.random.default_rng(RNG_SEED).choice(values.size // 3, WILD, replace=False) * 3] = level
    return out


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_wild_samples_are_counted_and_are_no_rail(sign: float) -> None:
    light = np.random.default_rng(1).gamma(2.0, 1.0, 50_000)
    channel = Channel("intensity", "V", 1e6, 0.0, spoiled(light, sign * 1e5), 0, light.size)
    (note,) = describe_wild_samples(channel)
    assert 0.9 * WILD < int(note.split()[1]) <= WILD  # few lie beside the brightest samples
    assert "single samples (0.12%) far from all others" in note
    assert detector_rails(channel) == [None]
    assert describe_wild_samples(replace(channel, raw=light)) == []


def test_a_bright_point_that_is_crossed_in_several_samples_is_not_wild() -> None:
    light = np.random.default_rng(1).poisson(2.0, 50_000).astype(float)
    for first in range(100, 50_000, 5_000):
        light[first : first + 4] = (40.0, 300.0, 280.0, 30.0)
    assert not find_wild_samples(light, wild_limits(light)).any()


def test_points_smaller_than_the_step_of_the_beam_are_no_pulses() -> None:
    """Points are far in single samples of several passes; pulses among them meet at one place only by chance."""
    rng, side = np.random.default_rng(3), 100
    pixel = rng.integers(0, side * side, 40_000).astype(np.int32)
    corner = rng.choice(side * (side - 3), 12, replace=False)[:, None]
    points = np.isin(pixel, corner + np.array([0, 1, 2, side, side + 1, side + 2]))
    pulses = rng.choice(pixel.size, WILD, replace=False)
    light = rng.gamma(2.0, 1.0, pixel.size)
    light[points] = 1e3
    light[pulses] = 1e3
    limits = wild_limits(light)
    wild = find_wild_samples(light, limits)[:, 0]
    repeated = find_repeated(light, limits, pixel, (side, side))[:, 0]
    assert wild[points].mean() > 0.9
    assert repeated[points].mean() > 0.95
    assert repeated[pulses].mean() < 0.1
    outside = find_repeated(light, limits, np.full_like(pixel, -1), (side, side))
    assert not outside.any()


@pytest.mark.parametrize("mean", [0.002, 0.05, 1.0])
def test_few_photons_are_not_wild(mean: float) -> None:
    light = np.random.default_rng(1).poisson(mean, 200_000).astype(float)
    assert not find_wild_samples(light, wild_limits(light)).any()


def test_wild_samples_are_not_taken_for_a_detector_that_was_off() -> None:
    """They fall in a third of the scan, so that the rest scatters much less."""
    recording, _ = imaging()
    light = recording["intensity"].read()
    light[: light.size // 2] = spoiled(light[: light.size // 2], 1e3 * float(light.max()))
    changed = recording.with_channel(replace(recording["intensity"], raw=light, gain=1.0, offset=0.0))
    result = reconstruct(changed, Options(pixels=(100, 100)), quiet=True)
    assert result.limits == reconstruct(recording, Options(pixels=(100, 100)), quiet=True).limits
    (note,) = (note for note in result.notes if "single samples" in note)
    assert 0.9 * WILD < int(note.split()[1]) <= WILD  # few lie beside the brightest places of the scene


@pytest.mark.parametrize(("level", "number"), [(1e3, 5), (1e5, 30), (-1e4, 30)])
def test_the_phase_and_the_structure_are_measured_without_electric_pulses(level: float, number: int) -> None:
    recording, _ = imaging()
    light = recording["intensity"].read()
    at = np.random.default_rng(RNG_SEED).choice(light.size, number, replace=False)
    light[at] = level * float(light.max())
    changed = recording.with_channel(replace(recording["intensity"], raw=light, gain=1.0, offset=0.0))
    clean, result = (reconstruct(each, Options(pixels=(100, 100)), quiet=True) for each in (recording, changed))
    assert result.limits == clean.limits
    for name, axis in clean.motion.axes.items():
        np.testing.assert_allclose(result.motion.axes[name].phase_sd, axis.phase_sd, rtol=0.1)


def test_what_is_left_out_of_comparisons_is_no_point_of_the_scene() -> None:
    recording, _ = imaging()
    beam, grid = reconstruct(recording, Options(pixels=(100, 100)), quiet=True).beam, Grid(100, 100, 0.2, 0.2)
    light = recording["intensity"].read()
    at = np.random.default_rng(RNG_SEED).choice(light.size, WILD, replace=False)
    light[at] = 1e3 * float(light.max())
    two = np.stack([light, recording["intensity"].read()], axis=1)
    channel = replace(recording["intensity"], raw=two, gain=1.0, offset=0.0)
    left = without_wild_samples(channel, beam, grid).read()
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(left[:, 0])), np.sort(at))
    np.testing.assert_array_equal(left[:, 1], two[:, 1])
    assert without_wild_samples(recording["intensity"], beam, grid) is recording["intensity"]
