"""Ranges that are late against the mirror: named where forward and backward half-periods of the scan disagree."""

import numpy as np
import pytest

from recon.point_cloud import PointCloud, make_point_cloud
from recon.report.conclusions import conclude_point_cloud
from recon.steps.reconstruction import Options
from scanner.device import Device
from scanner.recording import Recording
from tests.support.two_axis_scan import FIELD, RATE_HZ, READOUTS, SAMPLES, light, sensors

SEED = 776_310


def cloud(late_s: float, with_light: bool, relief_m: float = 0.3, every: int = 1) -> PointCloud:
    """Points of a scene with relief, whose ranges are stored ``late_s`` after the mirror's angles."""
    relief = light(SEED)
    index = np.maximum(np.arange(SAMPLES) - round(late_s * RATE_HZ), 0)
    ranges = 4.0 + relief_m * relief[index] + np.random.default_rng(SEED).normal(0.0, 0.01, SAMPLES)
    ranges[::13] = np.nan
    channels = {**sensors(SEED), "range": (ranges[::every], "m", RATE_HZ / every)}
    if with_light:
        channels["intensity"] = (light(SEED), "V", RATE_HZ)
    recording = Recording.from_arrays(channels, Device.from_toml(READOUTS + FIELD))
    return make_point_cloud(recording, Options(), quiet=True)


@pytest.mark.parametrize("with_light", [True, False])
@pytest.mark.parametrize("every", [1, 4])
def test_late_ranges_are_stated_with_the_start_that_explains_them(with_light: bool, every: int) -> None:
    late = cloud(200e-6, with_light, every=every)
    (limit,) = late.limits
    assert limit.startswith("range: a start of -0.000")
    assert float(limit.split()[4]) == pytest.approx(-200e-6, abs=12e-6)
    conclusion = conclude_point_cloud(late.summary(), "points.pcd")
    assert conclusion.startswith("range: a start of")
    assert "Use points.pcd" not in conclusion


def test_ranges_on_the_clock_of_the_mirror_are_not_doubted() -> None:
    assert cloud(0.0, True).limits == []
    assert cloud(0.0, False, every=4).limits == []


def test_a_wall_square_to_the_beam_determines_no_delay() -> None:
    assert cloud(200e-6, False, relief_m=0.0).limits == []
