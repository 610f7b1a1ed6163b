"""Edges of a sync signal that was sampled with the other channels."""

from math import nan
from pathlib import Path

import numpy as np
import pytest

from recon.io.convert import convert
from recon.io.sampled_edges import find_edges
from scanner.errors import BadInput

RATE_HZ = 1e7
PERIOD = 2000


@pytest.mark.parametrize("noise", [0.0, 0.05])
@pytest.mark.parametrize("width", [1, 2, 20, 1000])
def test_each_pulse_has_two_edges_however_short_it_is(width: int, noise: float) -> None:
    values = 5.0 * (np.arange(100 * PERIOD) % PERIOD >= PERIOD - width)
    values += noise * np.random.default_rng(1).standard_normal(values.size)
    rising = find_edges(values, RATE_HZ, 0.5, "zero-crossing-up")
    assert rising.size == 100
    expected = 0.5 + (PERIOD * np.arange(1, 101) - width - 0.5) / RATE_HZ
    np.testing.assert_allclose(rising, expected, rtol=0.0, atol=0.05 / RATE_HZ)
    assert find_edges(values, RATE_HZ, 0.5, "both-edges").size == 199  # the last pulse ends after the last sample


def test_single_spikes_do_not_hide_the_levels() -> None:
    values = 5.0 * (np.arange(100 * PERIOD) % PERIOD >= PERIOD // 2)
    edges = find_edges(values, RATE_HZ, 0.0, "both-edges")
    values[PERIOD // 2 + 100] = 50.0  # during the first pulse
    np.testing.assert_allclose(find_edges(values, RATE_HZ, 0.0, "both-edges"), edges, rtol=0.0, atol=1e-12)


def test_a_signal_at_one_level_is_refused(tmp_path: Path) -> None:
    lines = ["Time (s),Sync", *(f"{k * 1e-6:.6f},0.2" for k in range(100))]
    (tmp_path / "scope.csv").write_text("\n".join(lines), encoding="utf-8")
    mapping = {"channels": {"sync_x": {"variable": "Sync", "unit": "V", "event": "both-edges"}}}
    with pytest.raises(BadInput, match="'Sync' has no edge: it stays at one level"):
        convert(tmp_path / "scope.csv", mapping)


def test_the_clock_of_a_sampled_signal_is_stated_as_that_of_a_channel(tmp_path: Path) -> None:
    times = 0.5 + np.arange(500) / 1e6
    np.savez(tmp_path / "a.npz", sync=5.0 * (np.arange(500) // 50 % 2), t=times, edges=times[::50])
    spec = {"variable": "sync", "unit": "V", "event": "both-edges"}

    def edges(**statements: object) -> np.ndarray:
        return convert(tmp_path / "a.npz", {"channels": {"sync_x": spec | statements}}).edges["sync_x"].times

    expected = 0.5 + (np.arange(50, 500, 50) - 0.5) / 1e6
    np.testing.assert_allclose(edges(time="t"), expected, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(edges(sample_rate=1e6, start=0.5), expected, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(edges(time="t", start=0.0), expected - 0.5, rtol=0.0, atol=1e-12)
    for statements, line in (
        ({}, "no sample_rate is stated for variable 'sync'"),
        ({"time": "t", "sample_rate": 1e6}, "says time and sample_rate"),
        ({"sample_rate": -1e6}, "must be a number above 0"),
        ({"sample_rate": "1e6"}, "must be a number above 0"),
        ({"sample_rate": 1e6, "start": nan}, "must be a number above 0, start a number"),
        ({"variable": "edges", "unit": "s", "sample_rate": 1e6}, "states sample_rate, but 'edges' in s is a list"),
    ):
        with pytest.raises(BadInput, match=line):
            edges(**statements)
