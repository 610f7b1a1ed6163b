"""A mirror at rest and a dead position sensor give the same signal; the intensity tells them apart."""

from __future__ import annotations

import numpy as np
import pytest

import lissajous
from recon.report.summary import summarise

RATE, DURATION, HALF_ANGLE, PIXELS, NOISE = 1e6, 0.08, 0.08, 128, 2e-4
BEGIN, LOST = 0.02, 0.064


def scene(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Spots on a slope, at places in half widths of the field."""
    spots = np.random.default_rng(1).uniform([-0.9, -0.9, 0.04], [0.9, 0.9, 0.12], (40, 3))
    return 0.3 + 0.1 * x + sum(np.exp(-((x - a) ** 2 + (y - b) ** 2) / (2 * w * w)) for a, b, w in spots)


def reconstruct(resting: str, lost: str, first: int = 0) -> lissajous.Reconstruction:
    """A scan of two position sensors; axes that start late, and axes whose signal is lost at the end.

    The intensity is recorded from sample ``first`` on.
    """
    time, random = np.arange(round(RATE * DURATION)) / RATE, np.random.default_rng(2)
    swing = {name: np.sin(2 * np.pi * f * time) for name, f in (("x", 2011.0), ("y", 837.0))}
    for name in resting:
        swing[name] = swing[name] * np.clip((time - BEGIN) / 0.004, 0.0, 1.0)
    counts = random.poisson(200.0 * scene(swing["x"], swing["y"]))
    channels = {"intensity": (counts[first:], "counts", RATE, first / RATE)}
    for name, angle in swing.items():
        shown = np.where(time > LOST, 0.0, angle) if name in lost else angle
        channels[f"angle_{name}"] = (HALF_ANGLE * shown + NOISE * random.normal(size=time.size), "rad", RATE, 0.0)
    device = lissajous.Device.from_toml(
        "[x.mechanics]\nJ = 1e-10\nb = 1e-8\nk = 0.0158\n[y.mechanics]\nJ = 1e-10\nb = 1e-8\nk = 0.00275\n"
        f"[scan]\nhalf_angle_x = {HALF_ANGLE}\nhalf_angle_y = {HALF_ANGLE}\n"
    )
    return lissajous.reconstruct(lissajous.Recording.from_arrays(channels, device), pixels=(PIXELS, PIXELS))


def test_a_rest_before_the_start_is_no_blur() -> None:
    result = reconstruct(resting="xy", lost="")
    summary = summarise(result)
    assert result.unlocated_samples == 0
    for name, frequency in (("x", 2011.0), ("y", 837.0)):
        assert summary[name]["within_bound"] > 0.99
        assert summary[name]["phase_sd_deg"] < 0.1
        assert summary[name]["amplitude_rad"] == pytest.approx(HALF_ANGLE, rel=0.03)
        assert summary[name]["frequency_hz"] == pytest.approx(frequency, rel=1e-3)


def test_a_rest_before_the_intensity_is_recorded_is_no_lost_signal() -> None:
    result = reconstruct(resting="xy", lost="x", first=round(1.5 * BEGIN * RATE))
    assert result.unlocated_samples == pytest.approx((DURATION - LOST) * RATE, rel=0.1)


@pytest.mark.parametrize("lost", ["x", "xy"])
def test_a_signal_that_is_lost_is_left_out(lost: str) -> None:
    result = reconstruct(resting="", lost=lost)
    assert result.unlocated_samples == pytest.approx((DURATION - LOST) * RATE, rel=0.1)
    assert {each.channel for each in result.defects} == {f"angle_{name}" for name in lost}
    assert any("no motion, while the light shows one" in note for note in result.notes)
