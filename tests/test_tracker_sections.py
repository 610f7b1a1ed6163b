"""A long recording is tracked section by section; nothing of that may show."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_tracker import errors
from worlds import DRIVES, noisy, own_electrodes, quiet, with_sense

from estimation.tracker import PhaseSeen, track
from estimation.tracker.track import sections
from phantoms.forward import Plan, simulate
from phantoms.waveforms import Constant, Sequence
from scanner import devices
from scanner.errors import BadInput
from scanner.motion import Motion

IMAGING = devices.load("imaging")
MODULE = sys.modules["estimation.tracker.track"]


@pytest.fixture(autouse=True)
def short_sections(monkeypatch: pytest.MonkeyPatch) -> None:
    """16 blocks of the 49 that the scan of 30 ms has."""
    monkeypatch.setattr(MODULE, "SECTION", 16)
    monkeypatch.setattr(MODULE, "LAG", 12)


def in_one(recording, device=IMAGING, **how) -> Motion:  # type: ignore[no-untyped-def]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(MODULE, "SECTION", 1000)
        return track(recording, device, **how)


@given(st.lists(st.booleans(), max_size=80))
def test_sections_follow_each_other_and_end_at_no_switch(switched: list[bool]) -> None:
    share = np.array([[0.3 if here else 0.5] for here in switched[:-1]] + [[0.5]])
    found = list(sections(share))
    assert [first for first, _ in found] == [0, *(stop for _, stop in found[:-1])]
    assert found[-1][1] == len(share)
    assert all(share[stop - 1, 0] == 0.5 for _, stop in found)


@pytest.mark.parametrize("causal", [False, True])
def test_the_motion_is_that_of_one_section(causal: bool) -> None:
    parts, whole = track(noisy(3), IMAGING, causal), in_one(noisy(3), causal=causal)
    for name, axis in parts.axes.items():
        own = whole.axes[name]
        assert np.array_equal(axis.time, own.time)
        off = (axis.phase - own.phase) / own.phase_sd
        assert np.sqrt(np.mean(off**2)) < 0.5  # the process noise of each section is its own
        assert np.median(axis.phase_sd / own.phase_sd) == pytest.approx(1.0, abs=0.2)
        miss = np.abs(axis.angle.values - own.angle.values)
        assert miss.max() < 4 * np.median(own.phase_sd) * own.amplitude.mean()
    facts, known = parts.info["sense"], whole.info["sense"]
    assert facts["noise_sd"] == pytest.approx(known["noise_sd"], rel=0.01)  # type: ignore[index]
    assert facts["used"] == pytest.approx(known["used"], abs=2e-3)  # type: ignore[index]


def test_a_gap_of_whole_sections_is_bridged() -> None:
    def gap(y: np.ndarray) -> np.ndarray:
        y[45_000:105_000] = np.nan  # blocks 15 to 34
        return y

    recording = with_sense(noisy(5), gap)
    parts, whole = track(recording, IMAGING), in_one(recording)
    for name, axis in parts.axes.items():
        phase, _ = errors(axis, quiet()[1][f"angle_{name}"][0])
        assert np.mean(np.abs(phase) < 3 * axis.phase_sd) > 0.95
        assert axis.phase_sd.max() > 0.5 * whole.axes[name].phase_sd.max()
        behind = axis.time > 0.0225
        assert np.rad2deg(np.abs(phase[behind]).max()) < 0.15


def test_clipped_samples_and_phases_seen_belong_to_their_section() -> None:
    recording = with_sense(noisy(6), lambda y: np.clip(y, *np.quantile(y, [0.15, 0.85])))
    parts = track(recording, IMAGING)
    time = np.linspace(0.001, 0.029, 29)
    seen = {
        n: PhaseSeen(time, np.interp(time, a.time, a.phase) + 0.002, np.full(29, 1e-5)) for n, a in parts.axes.items()
    }
    helped = track(recording, IMAGING, seen=seen)
    for name, axis in parts.axes.items():
        phase, _ = errors(axis, quiet()[1][f"angle_{name}"][0])
        assert np.rad2deg(np.sqrt(np.mean(phase**2))) < 0.05
        moved = np.interp(time, axis.time, helped.axes[name].phase - axis.phase)
        assert np.median(moved) == pytest.approx(0.002, rel=0.2)


@pytest.mark.parametrize("stop", np.arange(0.0090, 0.0111, 0.0002))
def test_a_drive_may_stop_where_a_section_ends(stop: float) -> None:
    device = replace(own_electrodes(), axes={"x": own_electrodes().axis("x")}, scan=None)
    drive = Sequence(((DRIVES["x"], stop), (Constant(0.0), 0.02 - stop)))
    recording, truth = simulate(device, Plan({"x": drive}, 0.02))
    axis, angle = track(recording, device).axes["x"], truth["angle_x"][0]
    miss = np.minimum(np.abs(axis.angle.values - angle), np.abs(axis.angle.values + angle))
    assert miss.max() < 0.01 * np.abs(angle).max()


def test_no_samples_in_any_section_are_refused() -> None:
    with pytest.raises(BadInput, match="holds no sample that can be used"):
        track(with_sense(noisy(7), lambda y: np.full(y.size, np.nan)), IMAGING)
