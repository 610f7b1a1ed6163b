"""The tracker's demodulation: comparison with least squares; missing and clipped samples; sweeps."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation.tracker.demodulation import (
    harmonic_basis,
    least_squares_coefficients,
    project_blocks,
    residual_variance,
)
from scanner.channel import MIN_CLIPPED_RUN_SAMPLES, Channel
from scanner.lock_in import block_products

RATE = 5e6


def channel(values: np.ndarray) -> Channel:
    return Channel("sense", "V", RATE, 0.0, values, 0, values.size)


@settings(max_examples=30, deadline=None)
@given(
    length=st.integers(300, 900),
    orders=st.lists(st.sampled_from([(0, 2), (0, 4), (1, 1), (1, 2), (1, 3)]), min_size=1, max_size=5, unique=True),
    frequencies=st.tuples(st.floats(9e3, 3e4), st.floats(3e3, 8e3)),
    seed=st.integers(0, 1000),
)
def test_demodulation_agrees_with_least_squares(length, orders, frequencies, seed):  # type: ignore[no-untyped-def]
    rng = np.random.default_rng(seed)
    lines, tuned = np.array(orders), 2 * np.pi * np.array(frequencies)
    starts = np.arange(4) * length
    values = rng.normal(size=4 * length + 7)
    projections = project_blocks(channel(values), starts, length, lines, np.tile(tuned, (4, 1)))
    B = harmonic_basis(length, RATE, lines, tuned)
    for k in range(4):
        y = values[starts[k] : starts[k] + length]
        assert np.allclose(projections.sums[k], B @ y, atol=1e-10)
        assert projections.squares[k] == pytest.approx(y @ y)
        if np.linalg.cond(B) < 1e4:
            fit = np.linalg.lstsq(B.T, y, rcond=None)[0]
            assert np.allclose(least_squares_coefficients(projections)[k], fit, atol=1e-6 * max(1.0, np.abs(fit).max()))


@settings(max_examples=30, deadline=None)
@given(
    length=st.integers(4, 1200),
    blocks=st.integers(1, 7),
    evens=st.integers(1, 4),
    odds=st.integers(0, 3),
    dtype=st.sampled_from(["<i2", "<f4", "<f8", ">i2", ">f4", "<u2"]),
    squared=st.booleans(),
    seed=st.integers(0, 1000),
)
def test_block_products_agree_with_products_of_the_samples(length, blocks, evens, odds, dtype, squared, seed):  # type: ignore[no-untyped-def]
    rng = np.random.default_rng(seed)
    table = rng.normal(size=(evens + odds, length))
    table[:evens] += table[:evens, ::-1]
    table[evens:] -= table[evens:, ::-1]
    values = rng.integers(0, 4000, 3 * blocks * length).astype(dtype)
    starts = rng.integers(0, values.size - length + 1, blocks)
    rows = np.array([1e-3 * values[s : s + length].astype(float) - 1.5 for s in starts]) ** (2 if squared else 1)
    products, squares = block_products(values, starts, table, evens, 1e-3, -1.5, squared)
    assert np.allclose(products, rows @ table.T, atol=1e-9)
    assert np.allclose(squares, np.einsum("ij,ij->i", rows, rows))


@settings(max_examples=30, deadline=None)
@given(
    at=st.integers(0, 1000 - MIN_CLIPPED_RUN_SAMPLES),
    run=st.integers(1, 3 * MIN_CLIPPED_RUN_SAMPLES),
    low=st.booleans(),
    edge=st.booleans(),
    seed=st.integers(0, 1000),
)
def test_run_of_equal_extreme_samples_is_clipped(at, run, low, edge, seed):  # type: ignore[no-untyped-def]
    values = np.random.default_rng(seed).normal(size=1000)
    run = min(run, 1000 - at)
    values[at : at + run] = (9.0 if edge else 0.5) * (-1.0 if low else 1.0)
    projections = project_blocks(
        channel(values), np.array([0]), 1000, np.array([(0, 2)]), np.full((1, 1), 2 * np.pi * 13840.0)
    )
    assert projections.clipped_counts[0] == (run if edge and run >= MIN_CLIPPED_RUN_SAMPLES else 0)


def test_demodulation_omits_missing_samples_and_counts_clipped_ones() -> None:
    rng = np.random.default_rng(1)
    lines, tuned = np.array([(0, 2), (0, 4)]), np.array([2 * np.pi * 13840.0])
    length = 1000
    turn = tuned[0] * np.arange(2 * length) / RATE
    values = 1.0 + np.sin(2 * turn) + rng.normal(0.0, 0.01, turn.size)
    values[300:500] = np.nan
    values[length:] = np.minimum(values[length:], 1.7)
    projections = project_blocks(channel(values), np.array([0, length]), length, lines, np.tile(tuned, (2, 1)))
    clipped = int(np.sum(values[length:] == 1.7))
    assert projections.counts[0] == 800
    assert (projections.counts[1], projections.clipped_counts[1]) == (1000, clipped)
    assert np.allclose(projections.rails[1], [-np.inf, 1.7], atol=2e-3)
    assert np.hypot(*least_squares_coefficients(projections)[0, 1:3]) == pytest.approx(1.0, abs=0.005)
    assert residual_variance(projections)[0] == pytest.approx(1e-4, rel=0.2)


def test_demodulation_of_a_sweep_uses_several_tables() -> None:
    lines, length, blocks = np.array([(0, 2)]), 1500, 60
    f = 13840.0 + 1e3 * (np.arange(blocks) + 0.5) / blocks
    turn = 2 * np.pi * np.cumsum(np.repeat(f, length)) / RATE
    projections = project_blocks(
        channel(np.sin(2 * turn)), np.arange(blocks) * length, length, lines, 2 * np.pi * f[:, None]
    )
    assert 5 < len(projections.grams) < blocks
    assert np.allclose(np.hypot(*least_squares_coefficients(projections)[:, 1:3].T), 1.0, atol=0.01)


def test_flat_peaks_of_a_drive_are_used() -> None:
    lines, length = np.array([(0, 1)]), 1000
    tuned = np.array([2 * np.pi * RATE / 100])
    square = np.sign(np.sin(tuned[0] * (np.arange(3 * length) + 0.5) / RATE))
    starts = np.arange(3) * length
    projections = project_blocks(channel(square), starts, length, lines, np.tile(tuned, (3, 1)), may_clip=False)
    assert (projections.counts == length).all()
    assert np.allclose(np.hypot(*least_squares_coefficients(projections)[:, 1:3].T), 4 / np.pi, rtol=2e-3)
