"""Tracks of several sections agree with those of one section."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimation.tracker import PhaseMeasurement, block_tracking, track
from estimation.tracker.track import section_ranges
from phantoms.forward import Plan, simulate
from phantoms.waveforms import Constant, Sequence
from scanner import devices
from scanner.errors import BadInput
from scanner.motion import Motion
from tests.support.simulated import DRIVES, noisy, own_electrodes, quiet, with_sense
from tests.support.tracks import track_errors

IMAGING = devices.load("imaging")
MODULE = sys.modules["estimation.tracker.track"]


@pytest.fixture(autouse=True)
def short_sections(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sections of 16 blocks; the scan of 30 ms has 49."""
    monkeypatch.setattr(MODULE, "SECTION_BLOCKS", 16)
    monkeypatch.setattr(MODULE, "LOOKAHEAD_BLOCKS", 12)
    monkeypatch.setattr(block_tracking, "LOOKAHEAD_BLOCKS", 12)


def track_in_one_section(recording, device=IMAGING, **options) -> Motion:  # type: ignore[no-untyped-def]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(MODULE, "SECTION_BLOCKS", 1000)
        return track(recording, device, **options)


@given(st.lists(st.booleans(), max_size=80))
def test_sections_are_consecutive_and_end_at_no_switch(switched: list[bool]) -> None:
    share = np.array([[0.3 if here else 0.5] for here in switched[:-1]] + [[0.5]])
    ranges = list(section_ranges(share))
    assert [first for first, _ in ranges] == [0, *(stop for _, stop in ranges[:-1])]
    assert ranges[-1][1] == len(share)
    assert all(share[stop - 1, 0] == 0.5 for _, stop in ranges)


@pytest.mark.parametrize("causal", [False, True])
def test_motion_of_several_sections_agrees_with_that_of_one(causal: bool) -> None:
    parts, whole = track(noisy(3), IMAGING, causal), track_in_one_section(noisy(3), causal=causal)
    for name, axis in parts.axes.items():
        expected = whole.axes[name]
        assert np.array_equal(axis.time, expected.time)
        deviation = (axis.phase - expected.phase) / expected.phase_sd
        assert np.sqrt(np.mean(deviation**2)) < 0.5  # each section has a different process noise
        assert np.median(axis.phase_sd / expected.phase_sd) == pytest.approx(1.0, abs=0.2)
        miss = np.abs(axis.angle.read() - expected.angle.read())
        assert miss.max() < 4 * np.median(expected.phase_sd) * expected.amplitude.mean()
    info, expected_info = parts.info["sense"], whole.info["sense"]
    assert info["noise_sd"] == pytest.approx(expected_info["noise_sd"], rel=0.01)  # type: ignore[index]
    assert info["used"] == pytest.approx(expected_info["used"], abs=2e-3)  # type: ignore[index]


def test_gap_longer_than_a_section_is_tracked() -> None:
    def gap(y: np.ndarray) -> np.ndarray:
        y[45_000:105_000] = np.nan  # blocks 15 to 34
        return y

    recording = with_sense(noisy(5), gap)
    parts, whole = track(recording, IMAGING), track_in_one_section(recording)
    for name, axis in parts.axes.items():
        phase, _ = track_errors(axis, quiet()[1][f"angle_{name}"][0])
        assert np.mean(np.abs(phase) < 3 * axis.phase_sd) > 0.95
        assert axis.phase_sd.max() > 0.5 * whole.axes[name].phase_sd.max()
        behind = axis.time > 0.0225
        assert np.rad2deg(np.abs(phase[behind]).max()) < 0.15


def test_clipped_samples_and_external_phases_apply_to_their_section() -> None:
    recording = with_sense(noisy(6), lambda y: np.clip(y, *np.quantile(y, [0.15, 0.85])))
    parts = track(recording, IMAGING)
    time = np.linspace(0.001, 0.029, 29)
    measurements = {
        n: PhaseMeasurement(time, np.interp(time, a.time, a.phase) + 0.002, np.full(29, 1e-5))
        for n, a in parts.axes.items()
    }
    combined = track(recording, IMAGING, phases=measurements)
    for name, axis in parts.axes.items():
        phase, _ = track_errors(axis, quiet()[1][f"angle_{name}"][0])
        assert np.rad2deg(np.sqrt(np.mean(phase**2))) < 0.05
        moved = np.interp(time, axis.time, combined.axes[name].phase - axis.phase)
        assert np.median(moved) == pytest.approx(0.002, rel=0.2)


@pytest.mark.parametrize("stop", np.arange(0.0090, 0.0111, 0.0002))
def test_drive_may_stop_at_the_end_of_a_section(stop: float) -> None:
    device = replace(own_electrodes(), axes={"x": own_electrodes().axis("x")}, scan=None)
    drive = Sequence(((DRIVES["x"], stop), (Constant(0.0), 0.02 - stop)))
    recording, truth = simulate(device, Plan({"x": drive}, 0.02))
    axis, angle = track(recording, device).axes["x"], truth["angle_x"][0]
    miss = np.minimum(np.abs(axis.angle.read() - angle), np.abs(axis.angle.read() + angle))
    assert miss.max() < 0.01 * np.abs(angle).max()


def test_sections_without_samples_are_refused() -> None:
    with pytest.raises(BadInput, match="holds no sample that can be used"):
        track(with_sense(noisy(7), lambda y: np.full(y.size, np.nan)), IMAGING)
