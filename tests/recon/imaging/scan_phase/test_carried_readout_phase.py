"""The phase error of the readout from frame to frame: what earlier frames showed is kept, and a change is followed."""

from __future__ import annotations

import numpy as np
import pytest

from estimation.tracker import track
from recon.imaging.scan_phase.carried_readout_phase import CHANGE_SD_RAD, apply_readout_phase, update_readout_phase
from recon.imaging.scan_phase.phase_error import PhaseError, PhaseErrorParts, PhaseEstimate
from recon.imaging.scan_phase.readout_phase_model import ReadoutPhase
from scanner.motion import Motion
from tests.support.simulated import imaging

PARTS = 20


@pytest.fixture(scope="module")
def sensed() -> Motion:
    """Motion of a short segment by its sense signal."""
    recording, _ = imaging()
    device = recording.device
    assert device is not None
    return track(recording.slice(0.0, 0.01), device)


def measure(
    sensed: Motion, truth: float, sd: float, known: dict[str, ReadoutPhase], rng: np.random.Generator
) -> dict[str, ReadoutPhase]:
    """Update ``known`` by a frame whose picture measures ``truth`` in each of ``PARTS`` with ``sd`` [rad]."""
    corrected = apply_readout_phase(sensed, known)
    left = [truth - (known[name].mean[-1] if name in known else 0.0) for name in "xy"]
    values, sds = np.array(left) + rng.normal(0.0, sd, (PARTS, 2)), np.full((PARTS, 2), sd)
    estimates = [PhaseEstimate(float(value), sd / np.sqrt(PARTS)) for value in values.mean(axis=0)]
    parts = PhaseErrorParts(np.linspace(0.0, 0.01, PARTS), values, sds)
    return update_readout_phase(sensed, corrected, [PhaseError(0.005, *estimates, parts)], known)


def last(known: dict[str, ReadoutPhase]) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation of both axes at the end, shape (2,) each [rad]."""
    return (
        np.array([known[name].mean[-1] for name in "xy"]),
        np.sqrt([known[name].variance[-1] for name in "xy"]),
    )


def test_frames_that_determine_little_keep_the_phase_of_earlier_ones(sensed: Motion) -> None:
    rng, truth = np.random.default_rng(31), np.radians(1.2)
    known = measure(sensed, truth, np.radians(0.03), {}, rng)
    _, first_sd = last(known)
    for _ in range(9):
        known = measure(sensed, truth, np.radians(0.4), known, rng)
    mean, sd = last(known)
    assert np.all(np.abs(mean - truth) < 3.0 * sd)
    assert np.all(sd <= np.hypot(first_sd, 3.0 * CHANGE_SD_RAD))  # nine changes; the measurements can only narrow it


def test_frames_that_determine_nothing_widen_the_interval_by_what_a_readout_changes(sensed: Motion) -> None:
    rng = np.random.default_rng(32)
    known = measure(sensed, np.radians(1.2), np.radians(0.03), {}, rng)
    before, first_sd = last(known)
    for _ in range(4):
        known = measure(sensed, np.nan, np.inf, known, rng)
    mean, sd = last(known)
    np.testing.assert_array_equal(mean, before)
    np.testing.assert_allclose(sd, np.hypot(first_sd, 2.0 * CHANGE_SD_RAD))


def test_intervals_of_a_changing_readout_have_their_nominal_coverage(sensed: Motion) -> None:
    rng, truth, known = np.random.default_rng(33), np.radians(0.5), {}
    covered, deviations = [], []
    for _ in range(100):
        known = measure(sensed, truth, np.radians(0.05), known, rng)
        mean, sd = last(known)
        covered.append(np.abs(mean - truth) < 1.96 * sd)
        deviations.append((mean - truth) / sd)
        truth += rng.normal(0.0, CHANGE_SD_RAD)
    assert np.mean(covered) > 0.9
    assert np.sqrt(np.mean(np.square(deviations))) > 0.7  # the intervals are not too wide
