"""A curved or clipped characteristic of the readout is found by the lines that it mixes, and removed."""

from __future__ import annotations

import sys
from collections.abc import Callable

import numpy as np
import pytest

from estimation.tracker import track, track_end
from estimation.tracker.readout_curve import ReadoutCurve, straightened_channel
from scanner import devices
from scanner.channel import make_channel
from scanner.motion import Motion
from tests.support.simulated import noisy, with_sense


def amplitude_error(changed: Motion, clean: Motion) -> float:
    """Largest relative difference of the amplitudes of both axes."""
    pairs = [(changed.axes[axis].amplitude, clean.axes[axis].amplitude) for axis in "xy"]
    return max(float(np.max(np.abs(a / b - 1.0))) for a, b in pairs)


def curved(order: int) -> Callable[[np.ndarray], np.ndarray]:
    """Adds a power of the level, 1.5 % of the signal (rms)."""

    def change(sense: np.ndarray) -> np.ndarray:
        bend = ((sense - sense.mean()) / (3.0 * sense.std())) ** order
        return np.asarray(sense + 0.015 * sense.std() * (bend - bend.mean()) / bend.std())

    return change


def clipped_then_coupled(sense: np.ndarray) -> np.ndarray:
    """Clips 3 % of the samples at each rail, and adds a tone, after which no two samples are equal."""
    low, high = np.quantile(sense, [0.03, 0.97])
    tone = np.sin(2.0 * np.pi * 27680.0 / 5e6 * np.arange(sense.size))
    return np.asarray(np.clip(sense, low, high) + 0.005 * sense.std() * tone)


@pytest.mark.parametrize(
    "change", [curved(3), curved(5), curved(7), clipped_then_coupled], ids=["third", "fifth", "seventh", "clipped"]
)
def test_the_amplitude_is_that_of_a_straight_readout(
    change: Callable[[np.ndarray], np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    device, changed = devices.load("imaging"), with_sense(noisy(3), change)
    clean, found = track(noisy(3), device), track(changed, device)
    assert not clean.notes
    assert len(found.notes) == 1
    assert ("clipped below" in found.notes[0]) == (change is clipped_then_coupled)
    monkeypatch.setattr(sys.modules["estimation.tracker.track"], "MAX_CURVE_ROUNDS", 0)
    left_in = track(changed, device)
    assert amplitude_error(found, clean) < 0.3 * amplitude_error(left_in, clean)


def test_a_straightened_channel_undoes_its_curve_and_keeps_missing_samples() -> None:
    straight = np.linspace(-1.0, 1.0, 201)
    curve = ReadoutCurve(straight + 0.02 * straight**3, straight, np.array([-np.inf, 0.8]))
    values = np.array([-1.0, -0.5, 0.0, 0.5, 0.9])
    measured = np.append(values + 0.02 * values**3, np.nan)
    channel = straightened_channel(make_channel("sense", measured, unit="V", sample_rate=1.0), curve)
    np.testing.assert_allclose(channel.read(), [-1.0, -0.5, 0.0, 0.5, 0.8, np.nan], atol=1e-5)
    np.testing.assert_allclose(channel.read(1, 3), [-0.5, 0.0], atol=1e-5)


def test_the_next_segment_of_a_scan_is_straightened_by_the_same_curve() -> None:
    device, recording = devices.load("imaging"), with_sense(noisy(3), curved(5))
    whole, first = track(recording, device), track(recording.slice(0.0, 0.022), device)
    start = track_end(first)
    assert start is not None
    second = track(recording.slice(start, 0.03), device, previous=first)
    assert second.notes == first.notes
    for axis in "xy":
        amplitude, known = second.axes[axis].amplitude, whole.axes[axis]
        np.testing.assert_allclose(amplitude, np.interp(second.axes[axis].time, known.time, known.amplitude), rtol=2e-3)
