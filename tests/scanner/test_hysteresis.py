"""Rayleigh hysteresis compared with the sum of play operators."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scanner.terms.hysteresis import prandtl_ishlinskii


def summed(v: np.ndarray, count: int = 2000) -> np.ndarray:
    """Sum of ``count`` play operators, at rest at 0 before the signal, of widths up to the largest amplitude."""
    swing = np.abs(v).max()
    width = (np.arange(count) + 0.5) / count * swing
    state, total = np.zeros(count), np.zeros(v.size)
    for i, value in enumerate(v):
        state = np.clip(state, value - width, value + width)
        total[i] = np.sum(state) * swing / count
    return total


@settings(deadline=None, max_examples=60)
@given(st.lists(st.floats(-5, 5, allow_subnormal=False), min_size=2, max_size=60), st.booleans())
def test_hysteresis_equals_the_sum_of_play_operators(path: list[float], pause: bool) -> None:
    v = np.repeat(path, 2) if pause else np.array(path)
    np.testing.assert_allclose(prandtl_ishlinskii(v), summed(v), atol=1e-5)


def test_closed_loop_has_the_area_of_rayleighs_law() -> None:
    v = 0.7 * np.sin(2 * np.pi * np.arange(3000) / 1000)
    last = slice(2000, 3000)
    area = np.sum(prandtl_ishlinskii(v)[last] * np.gradient(v)[last])
    assert abs(area) == pytest.approx(4 / 3 * 0.7**3 / 2, rel=1e-3)  # 4/3 of the law's coefficient, here 1/2, and A³


@pytest.mark.parametrize("start", [0, 90, 250, 700])
def test_loop_is_symmetric_wherever_the_recording_of_a_symmetric_oscillation_begins(start: int) -> None:
    v = 0.7 * np.sin(2 * np.pi * (start + np.arange(3000)) / 1000)
    last = prandtl_ishlinskii(v)[2000:]
    assert np.max(last) == pytest.approx(-np.min(last), rel=1e-9)


def test_gain_increases_with_the_amplitude() -> None:
    turn = np.sin(2 * np.pi * np.arange(3000) / 1000)
    for amplitude in (0.1, 0.8):
        assert np.ptp(prandtl_ishlinskii(amplitude * turn)[1000:]) == pytest.approx(amplitude**2, rel=1e-4)
