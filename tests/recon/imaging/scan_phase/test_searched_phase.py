"""A phase beyond the 15 degrees that the registration reaches is found, and is part of the stated uncertainty."""

from functools import cache

import numpy as np
import pytest

import lissajous
from recon.imaging.scan_phase.searched_phase import search_phase_of
from recon.pipeline import Reconstruction
from recon.report.picture_conclusion import conclude_reconstruction
from recon.report.summary import summarise

RATE, DURATION, HALF_ANGLE, LATE_DEG = 1e6, 0.1, 0.08, 17.0
FREQUENCIES = {"x": 2000.0, "y": 835.0}


@cache
def reconstruct(late_deg: float, photons: float = 30.0, is_blank: bool = False) -> Reconstruction:
    """A recording with angle channels whose sensor of x is early by ``late_deg`` against the intensity."""
    time = np.arange(round(RATE * DURATION)) / RATE
    x, y = (1.06 * np.sin(2 * np.pi * f * time + p) for f, p in zip(FREQUENCIES.values(), (0.0, 1.0), strict=True))
    spots = np.random.default_rng(1).uniform([-0.9, -0.9, 0.04], [0.9, 0.9, 0.12], (40, 3))
    scene = 0.3 + 0.1 * x + sum(np.exp(-((x - a) ** 2 + (y - b) ** 2) / (2 * w * w)) for a, b, w in spots)
    counts = np.random.default_rng(2).poisson(photons * (np.full(x.size, 0.5) if is_blank else scene))
    x = 1.06 * np.sin(2 * np.pi * FREQUENCIES["x"] * time + np.radians(late_deg))
    angles = {f"angle_{name}": (HALF_ANGLE * u, "rad", RATE) for name, u in (("x", x), ("y", y))}
    device = lissajous.Device.from_toml(
        "[x.mechanics]\nJ = 1e-10\nb = 1e-8\nk = 0.0158\n[y.mechanics]\nJ = 1e-10\nb = 1e-8\nk = 0.00275\n"
        f"[scan]\nhalf_angle_x = {HALF_ANGLE}\nhalf_angle_y = {HALF_ANGLE}\n"
    )
    recording = lissajous.Recording.from_arrays({**angles, "intensity": (counts, "counts", RATE)}, device)
    return lissajous.reconstruct(recording, pixels=(200, 200))


def test_the_phase_sd_contains_a_phase_beyond_the_reach_of_the_registration() -> None:
    result = reconstruct(LATE_DEG)
    assert np.degrees(np.sqrt(np.mean(result.motion.axes["x"].phase_sd ** 2))) == pytest.approx(LATE_DEG, abs=1.0)
    assert "No blur was found" not in conclude_reconstruction(summarise(result))


def test_the_search_finds_the_phase_in_each_slice_and_leaves_a_right_axis() -> None:
    result = reconstruct(LATE_DEG)
    found = search_phase_of(result.beam, result.intensity)
    assert set(found.refuted) == {"x"}
    assert [each.x.value for each in found.errors] == pytest.approx(np.full(7, -np.radians(LATE_DEG)), abs=0.02)
    assert [each.y.value for each in found.errors] == pytest.approx(np.zeros(7), abs=0.03)


def test_a_blank_field_shows_no_phase() -> None:
    result = reconstruct(0.0, is_blank=True)
    found = search_phase_of(result.beam, result.intensity)
    assert not found.refuted
    assert all(np.isnan(each.x.value) and np.isnan(each.y.value) for each in found.errors)
