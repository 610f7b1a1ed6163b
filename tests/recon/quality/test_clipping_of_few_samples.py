"""A clipped signal of few samples a period, whose runs at the rail are short, counts as clipped."""

import numpy as np
import pytest

from recon.quality.defects import find_defects
from scanner.device import Device
from scanner.recording import Recording

RATE_HZ, FREQUENCY_HZ = 5e4, 2010.0
TIME = np.arange(20_000) / RATE_HZ


@pytest.mark.parametrize("step_v", [0.0, 0.01, 0.1])
@pytest.mark.parametrize(("rail_v", "expected"), [(1.4, True), (2.0, False)])
@pytest.mark.parametrize("frequency_hz", [FREQUENCY_HZ, 2000.0])
def test_short_runs_at_the_rail_are_clipped(step_v: float, rail_v: float, expected: bool, frequency_hz: float) -> None:
    noise = np.random.default_rng(0).normal(0.0, 1e-3, TIME.size)
    volts = np.clip(1.56 * np.sin(2 * np.pi * frequency_hz * TIME + 0.3) + noise, -rail_v, rail_v)
    volts = np.round(volts / step_v) * step_v if step_v else volts
    channels = {"sense_x": (volts, "V", RATE_HZ), "intensity": (np.ones(TIME.size), "V", RATE_HZ)}
    readout = '[x.readout]\nkind = "position"\ngain = 20.0\nnoise_sd = 1e-3\n'
    device = Device.from_toml(readout)
    defects = find_defects(Recording.from_arrays(channels, device), device)
    assert any(each.kind == "clipped" for each in defects) == expected


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("rail_v", [1.0, -1.0])
def test_a_sample_that_is_not_finite_hides_no_rail(value: float, rail_v: float) -> None:
    volts = np.sin(2 * np.pi * FREQUENCY_HZ * TIME + 0.3)
    volts = np.minimum(volts, 0.9) if rail_v > 0 else np.maximum(volts, -0.9)
    volts[5000] = value
    channels = {"sense_x": (volts, "V", RATE_HZ), "intensity": (np.ones(TIME.size), "V", RATE_HZ)}
    device = Device.from_toml('[x.readout]\nkind = "position"\ngain = 20.0\nnoise_sd = 1e-3\n')
    assert {each.kind for each in find_defects(Recording.from_arrays(channels, device), device)} == {"gap", "clipped"}
