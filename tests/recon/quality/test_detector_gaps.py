"""Times in which the detector was covered are found; blocks whose samples miss beads by chance are none."""

from __future__ import annotations

import numpy as np
import pytest

from recon.imaging.picture import Grid
from recon.quality.detector_gaps import describe_detector_gaps, find_detector_gaps
from scanner.angle_tracks import SampledAngle
from scanner.channel import Channel
from scanner.motion import AxisMotion, Motion

HALF_ANGLE, PIXELS, STRAY_LIGHT = 0.08, 100, 0.02
RATES_HZ = {"x": 2003.0, "y": 837.0}


def bead_scan(
    size: float,
    *,
    sample_rate: float = 1e5,
    duration: float = 0.3,
    photons: float = 300.0,
    detectors: int = 1,
    covered: tuple[float, float] = (0.0, 0.0),
    seed: int = 1,
) -> tuple[Motion, Channel, Grid]:
    """A scan of 13 x 13 beads of standard deviation ``size`` [half fields], covered in a part of the time [s]."""
    time = np.arange(int(duration * sample_rate)) / sample_rate
    ends, angles, axes = time[[0, -1]], {}, {}
    for number, (axis, rate) in enumerate(RATES_HZ.items()):
        angles[axis] = np.sin(2 * np.pi * rate * time + 0.1 * seed * (1 - number) + 0.4 * number)
        slow = (np.zeros(2), np.full(2, HALF_ANGLE), np.full(2, rate), np.full(2, 1e-3))
        axes[axis] = AxisMotion(ends, *slow, SampledAngle(HALF_ANGLE * angles[axis], sample_rate))
    light = np.zeros(time.size)
    for x in np.linspace(-0.9, 0.9, 13):
        near = np.abs(angles["x"] - x) < 5 * size
        for y in np.linspace(-0.9, 0.9, 13):
            square = (angles["x"][near] - x) ** 2 + (angles["y"][near] - y) ** 2
            light[near] += np.exp(-0.5 * square / size**2)
    light[(time >= covered[0]) & (time < covered[1])] = 0.0
    shape = (time.size, detectors)
    counts = np.random.default_rng(seed).poisson(photons * np.broadcast_to(light[:, None] + STRAY_LIGHT, shape))
    values = counts.astype(float) if detectors > 1 else counts[:, 0].astype(float)
    intensity = Channel("intensity", "V", sample_rate, 0.0, values, 0, time.size)
    return Motion(axes, "test"), intensity, Grid(PIXELS, PIXELS, HALF_ANGLE, HALF_ANGLE)


@pytest.mark.parametrize("seed", [1, 4, 3004])
@pytest.mark.parametrize("duration", [0.2, 0.5])
@pytest.mark.parametrize("size", [0.003, 0.005, 0.01, 0.03])
def test_samples_that_miss_beads_by_chance_are_no_gap(size: float, duration: float, seed: int) -> None:
    assert find_detector_gaps(*bead_scan(size, duration=duration, seed=seed), []) == []


@pytest.mark.parametrize(
    ("size", "options"),
    [
        (0.03, {}),
        (0.03, {"photons": 3.0, "sample_rate": 3e5}),
        (0.01, {}),
        (0.01, {"detectors": 3}),
        (0.01, {"sample_rate": 1e6}),
    ],
)
def test_a_covered_detector_is_found(size: float, options: dict[str, float]) -> None:
    scan = bead_scan(size, covered=(0.1, 0.16), **options)  # type: ignore[arg-type]
    gaps = find_detector_gaps(*scan, [])
    rate = scan[1].sample_rate
    assert any(abs(start / rate - 0.1) < 0.004 and abs(stop / rate - 0.16) < 0.004 for start, stop in gaps)
    (line,) = describe_detector_gaps(*scan, [])
    assert "off or covered" in line


def test_a_gap_is_found_at_few_photons() -> None:
    """A photon a sample at the beads' middles."""
    scan = bead_scan(0.06, sample_rate=3e5, photons=1.0, covered=(0.05, 0.2))
    (gap,) = find_detector_gaps(*scan, [])
    assert gap == pytest.approx((0.05 * 3e5, 0.2 * 3e5), abs=1500)
