"""Light that flickers is named with its frequency, and the phase is measured without it; a steady light is left."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from recon.imaging.flicker import find_flicker, without_flicker
from recon.imaging.intensity_drift_equations import DriftKind
from recon.imaging.picture import Grid
from recon.pipeline import reconstruct
from recon.steps.reconstruction import Options, Reconstruction
from scanner.channel import Channel
from scanner.recording import Recording
from tests.support.simulated import imaging

OPTIONS = Options(pixels=(100, 100))


@cache
def steady() -> tuple[Recording, Reconstruction]:
    recording, _ = imaging()
    return recording, reconstruct(recording, OPTIONS, quiet=True)


def changed(change: np.ndarray) -> Channel:
    light = steady()[0]["intensity"]
    return replace(light, raw=light.read() * change, gain=1.0, offset=0.0)


def sine(frequency: float, amplitude: float) -> np.ndarray:
    return 1.0 + amplitude * np.sin(2.0 * np.pi * frequency * steady()[0]["intensity"].time() + 0.7)


@pytest.mark.parametrize(("frequency", "amplitude"), [(100.0, 0.3), (240.0, 0.05), (120.0, 0.6)])
def test_flicker_is_named_and_the_phase_is_that_of_a_steady_light(frequency: float, amplitude: float) -> None:
    recording, clean = steady()
    result = reconstruct(recording.with_channel(changed(sine(frequency, amplitude))), OPTIONS, quiet=True)
    (note,) = (note for note in result.notes if "all places vary" in note)
    size, rate = (float(word) for word in (note.split("±")[1].split()[0], note.split(" at ")[1].split()[0]))
    assert size == pytest.approx(100.0 * amplitude, rel=0.1)
    assert rate == pytest.approx(frequency, rel=0.02)
    assert not any("samples of one place" in note for note in result.notes)
    for name, axis in clean.motion.axes.items():
        shift = np.interp(axis.time, result.motion.axes[name].time, result.motion.axes[name].phase) - axis.phase
        assert np.abs(shift).max() < 3.0 * axis.phase_sd.max()


@pytest.mark.parametrize("kind", ["steady", "bleaching", "dark", "large", "missing", "negative", "two detectors"])
@pytest.mark.filterwarnings("error")
def test_other_light_does_not_flicker(kind: str) -> None:
    _, clean = steady()
    n = clean.intensity.size
    light = {
        "steady": changed(np.ones(n)),
        "bleaching": changed(np.exp(-np.arange(n) / n)),
        "dark": changed(np.zeros(n)),
        "large": changed(np.where(np.arange(n) == n // 2, 1e300, 1.0)),
        "missing": changed(np.where(np.arange(n) % 7 < 3, np.nan, 1.0)),
        "negative": changed(-np.ones(n)),
        "two detectors": replace(changed(np.ones(n)), raw=np.random.default_rng(1).poisson(3.0, (n, 2))),
    }[kind]
    assert find_flicker(clean.beam, light, Grid(100, 100, 0.2, 0.2)) == []


def test_the_flicker_of_two_detectors_is_removed_from_both() -> None:
    _, clean = steady()
    one = changed(sine(150.0, 0.2))
    two = replace(one, raw=np.stack([one.read(), 3.0 * one.read()], axis=1))
    flicker = find_flicker(clean.beam, two, clean.picture.grid)
    removed, light = without_flicker(two, flicker).read(100, 5000), clean.intensity.read(100, 5000)
    assert np.abs(removed[:, 0] / light - 1.0).max() < 0.03
    np.testing.assert_allclose(removed[:, 1], 3.0 * removed[:, 0])


@pytest.mark.parametrize("cycles", [1, 3, 3.4])
@pytest.mark.parametrize("kind", ["gain", "offset"])
def test_the_option_for_a_drift_removes_the_lines_of_the_light(kind: DriftKind, cycles: float) -> None:
    """Also lines of a whole number of cycles, whose power is in one bin of the spectrum of the residual."""
    recording, clean = steady()
    light = recording["intensity"]
    line = 0.2 * np.sin(2.0 * np.pi * cycles * np.arange(light.size) / light.size + 0.7)
    values = light.read()
    values = values * (1.0 + line) if kind == "gain" else values + values.mean() * line
    changing = recording.with_channel(replace(light, raw=values, gain=1.0, offset=0.0))
    result = reconstruct(changing, replace(OPTIONS, intensity_drift=kind), quiet=True)
    scale = clean.picture.image / np.nanmean(clean.picture.image)
    error = result.picture.image / np.nanmean(result.picture.image) - scale
    unchanged = reconstruct(changing, OPTIONS, quiet=True).picture.image
    before = unchanged / np.nanmean(unchanged) - scale
    assert np.nanstd(error) < 0.2 * np.nanstd(before)
