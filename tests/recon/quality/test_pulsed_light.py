"""Samples between the pulses of a light source are dark; they are named, and left out where they are NaN."""

from __future__ import annotations

import numpy as np
import pytest

from tests.support.two_axis_scan import FIELD, HALF_RAD, RATE_HZ, READOUTS, angles, light, reconstruct, sensors

LINE = "the light is pulsed"


def limits(lit: np.ndarray, between: float | np.ndarray) -> list[str]:
    values = np.where(lit, light(1), between)
    result = reconstruct({**sensors(1), "intensity": (values, "V", RATE_HZ)}, READOUTS + FIELD)
    return [limit for limit in result.limits if LINE in limit]


@pytest.mark.parametrize(("period", "lit"), [(10, (3,)), (2, (0,)), (3, (0, 1))])
def test_dark_samples_between_pulses_are_named(period: int, lit: tuple[int, ...]) -> None:
    is_lit = np.isin(np.arange(light(1).size) % period, lit)
    (line,) = limits(is_lit, 0.0)
    assert line.startswith(f"intensity: {period - len(lit)} of every {period} samples ")


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e5])
def test_a_missing_sample_or_an_electric_pulse_hides_no_pulsed_light(value: float) -> None:
    is_lit = np.arange(light(1).size) % 4 < 2
    (line,) = limits(is_lit, np.where(np.arange(is_lit.size) == 102, value, 0.0))
    assert line.startswith("intensity: 2 of every 4 samples ")


@pytest.mark.parametrize("seed", range(6))
def test_few_bright_places_and_sparks_are_no_pulses(seed: int) -> None:
    """A sample of 64 seldom meets one of three beads, and a spark is in one sample of the period only."""
    rng = np.random.default_rng(seed)
    x, y = (angles()[name] / np.abs(angles()[name]).max() for name in "xy")
    values = rng.poisson(0.05, x.size).astype(float)
    for place in rng.uniform(-0.8, 0.8, (3, 2)):
        values += rng.poisson(50.0 * (np.hypot(x - place[0], y - place[1]) < 0.03))
    values[rng.integers(0, x.size, 5)] = 1e4
    result = reconstruct({**sensors(1), "intensity": (values, "V", RATE_HZ)}, READOUTS + FIELD)
    assert not any(LINE in limit for limit in result.limits)


def test_steady_light_and_samples_that_are_left_out_are_no_error() -> None:
    index = np.arange(light(1).size)
    assert not limits(index >= 0, 0.0)
    assert not limits(index % 5 == 0, np.nan)


@pytest.mark.parametrize("samples_per_cycle", [36, 40, 50, 100])
def test_a_scene_with_a_dark_border_is_no_pulse_where_the_clock_follows_the_scanner(samples_per_cycle: int) -> None:
    """A sample of some periods shows few places of x, which are dark at any time where they lie at the border."""
    rate = 2000.0 * samples_per_cycle
    time = np.arange(40_000) / rate
    x, y = np.sin(2 * np.pi * 2000.0 * time + 0.1), np.sin(2 * np.pi * 833.1 * time)
    scene = (np.hypot(x, y) < 0.6) * (1.0 + 0.8 * np.sin(20.0 * x + 1.0) * np.sin(17.0 * y + 2.0))
    values = np.random.default_rng(1).poisson(300.0 * scene).astype(float)
    noise = np.random.default_rng(2).normal(0.0, 2e-3, (2, time.size))
    senses = {f"sense_{a}": (20.0 * HALF_RAD * v + n, "V", rate) for a, v, n in zip("xy", (x, y), noise, strict=True)}
    result = reconstruct({**senses, "intensity": (values, "V", rate)}, READOUTS + FIELD)
    assert not any(LINE in limit for limit in result.limits)
