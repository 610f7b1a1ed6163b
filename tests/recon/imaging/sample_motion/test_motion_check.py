"""A sample that moves is reported although nobody asked for its motion, and one at rest is not."""

import numpy as np
import pytest

import lissajous
from recon.imaging.sample_motion.residual_noise import fit_residual_noise
from recon.pipeline import Reconstruction

RATE, DURATION, HALF_ANGLE, PIXELS = 1e6, 0.08, 0.08, 128


def scene(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Spots on a slope, at places in half widths of the field."""
    spots = np.random.default_rng(1).uniform([-0.9, -0.9, 0.04], [0.9, 0.9, 0.12], (40, 3))
    return 0.3 + 0.1 * x + sum(np.exp(-((x - a) ** 2 + (y - b) ** 2) / (2 * w * w)) for a, b, w in spots)


def reconstruct(
    x_px: float, y_px: float, pixels: tuple[int, int] = (PIXELS, PIXELS), **options: bool
) -> Reconstruction:
    """A recording with angle channels of a sample that drifts by so many pixels during the scan."""
    time = np.arange(round(RATE * DURATION)) / RATE
    x, y = (np.sin(2 * np.pi * f * time) for f in (2011.0, 837.0))
    drift = (time / DURATION - 0.5) * 2.0 / PIXELS
    counts = np.random.default_rng(2).poisson(100.0 * scene(x + x_px * drift, y + y_px * drift))
    angles = {f"angle_{name}": (HALF_ANGLE * u, "rad", RATE) for name, u in (("x", x), ("y", y))}
    device = lissajous.Device.from_toml(
        "[x.mechanics]\nJ = 1e-10\nb = 1e-8\nk = 0.0158\n[y.mechanics]\nJ = 1e-10\nb = 1e-8\nk = 0.00275\n"
        f"[scan]\nhalf_angle_x = {HALF_ANGLE}\nhalf_angle_y = {HALF_ANGLE}\n"
    )
    recording = lissajous.Recording.from_arrays({**angles, "intensity": (counts, "counts", RATE)}, device)
    return lissajous.reconstruct(recording, pixels=pixels, **options)


@pytest.mark.parametrize(("x_px", "y_px"), [(6.0, -3.0), (0.0, 0.0), (0.0, 0.3)])
def test_a_motion_beyond_the_tolerance_is_a_limit_of_the_picture(x_px: float, y_px: float) -> None:
    limits = reconstruct(x_px, y_px).limits
    if not x_px:
        assert limits == []
        return
    [limit] = limits
    stated = limit.partition("moves by ")[2].split()
    assert float(stated[0]) == pytest.approx(abs(x_px), abs=0.8)
    assert float(stated[2]) == pytest.approx(abs(y_px), abs=0.8)
    assert "--sample-motion" in limit


def test_a_motion_that_is_removed_is_no_limit() -> None:
    assert reconstruct(6.0, -3.0, sample_motion=True).limits == []


@pytest.mark.parametrize("pixels", [(128, 1), (500, 5), (2, 128), (1, 1), (3, 3), (8, 8)])
def test_a_picture_of_few_rows_or_columns_shows_no_motion(pixels: tuple[int, int]) -> None:
    assert not any("the sample moves" in limit for limit in reconstruct(6.0, -3.0, pixels).limits)
    result = reconstruct(6.0, -3.0, pixels, sample_motion=True)
    assert result.sample_motion is None
    assert any("too few rows or columns" in note for note in result.notes)


def test_residuals_without_noise_have_a_variance() -> None:
    """Rounding alone is left of a scene that is the same at every visit."""
    random = np.random.default_rng(3)
    noise = fit_residual_noise(random.uniform(size=100), random.uniform(size=100), 1e-170 * random.normal(size=100))
    assert noise.floor > 0.0
