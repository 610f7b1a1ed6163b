"""A motion that is not there predicts the samples less well than rest."""

import numpy as np
import pytest

from recon.imaging.sample_motion import rigid_motion
from recon.imaging.sample_motion.block_equations import PARTS, sample_log_likelihoods
from recon.imaging.sample_motion.placed_samples import PlacedSamples
from recon.imaging.sample_motion.rigid_motion import estimate_sample_motion
from scanner.arrays import Array
from tests.support.sample_motion import BLOCKS, PERIOD, PIXELS, beads, scan


def test_few_beads_at_rest_are_reported_at_rest() -> None:
    """Their detail agrees with a motion that the picture follows, with a gain of 22 in the equations around it."""
    found = estimate_sample_motion(
        scan(np.zeros((2, 2)), 300.0, 2 * BLOCKS, beads(8, sd=1.5)), PERIOD, (PIXELS, PIXELS)
    )
    assert found is not None
    assert not found.moving
    assert not found.shift.any()


@pytest.mark.parametrize("size", [0.0, 1.0])
def test_the_true_motion_has_the_larger_likelihood(size: float) -> None:
    samples = scan(np.array([[-0.5, 0.25], [0.5, -0.25]]) * size, 300.0)
    part = round(PERIOD / PARTS)
    blocks = -(-samples.x.size // (part * PARTS))
    moved = np.linspace(-0.5, 0.5, blocks * PARTS)[:, None] * [1.0, -0.5]
    of_motion, of_rest = (
        sample_log_likelihoods(samples, shift, part, (PIXELS, PIXELS), 1.0) for shift in (moved, 0.0 * moved)
    )
    gain = float(np.nansum(of_motion - of_rest, dtype=float))
    assert (gain > 0.0) == (size > 0.0)


def test_a_drift_is_found_whichever_kernel_predicts_best_at_rest(monkeypatch: pytest.MonkeyPatch) -> None:
    """A wider one averages more noise at few photons. That gains as much as this drift does."""

    def chosen(samples: PlacedSamples, shift: Array, *_: object) -> tuple[float, float]:
        return (0.7 if shift.any() else 1.4), 1.0

    monkeypatch.setattr(rigid_motion, "choose_width", chosen)
    found = estimate_sample_motion(scan(np.array([[-0.6, 0.3], [0.6, -0.3]]), 10.0), PERIOD, (PIXELS, PIXELS))
    assert found is not None
    assert found.moving


def drift_and_vibration() -> tuple[Array, float]:
    """A drift of 3 pixels with a vibration of 1 pixel, and the frequency of that [cycles per block]."""
    time = np.linspace(0.0, 1.0, 8 * BLOCKS)
    drift = np.outer(time, [3.0, -1.5])
    return drift + np.outer(np.sin(2.0 * np.pi * 24.0 * time), [0.5, 0.0]), 24.0 / BLOCKS


def test_a_vibration_beside_a_drift_predicts_the_samples_and_another_one_does_not() -> None:
    displacement, frequency = drift_and_vibration()
    samples = scan(displacement)
    part = round(PERIOD / PARTS)
    size = PARTS * -(-samples.x.size // (part * PARTS))
    time = (np.arange(size) + 0.5) / PARTS
    true = np.column_stack(
        [np.interp(time / BLOCKS, np.linspace(0.0, 1.0, len(displacement)), each) for each in displacement.T]
    )
    wave = np.outer(np.sin(2.0 * np.pi * frequency * time), [0.5, 0.0])
    other = np.outer(np.sin(2.0 * np.pi * 1.7 * frequency * time), [0.5, 0.0])
    gains = [
        rigid_motion._prediction_gain(samples, part, (PIXELS, PIXELS), 1.0, moved, without)
        for moved, without in ((true, true - wave), (true + other, true))
    ]
    assert gains[0] > 100.0
    assert gains[1] == 0.0


@pytest.mark.parametrize("predicts", [True, False])
def test_a_vibration_that_does_not_predict_the_samples_is_not_reported(
    predicts: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The drift beside it is."""
    displacement, frequency = drift_and_vibration()
    gain = rigid_motion._prediction_gain

    def with_vibration(*args: object) -> float:
        return gain(*args) if predicts or not np.any(args[-1]) else 0.0  # type: ignore[arg-type]

    monkeypatch.setattr(rigid_motion, "_prediction_gain", with_vibration)
    found = estimate_sample_motion(scan(displacement), PERIOD, (PIXELS, PIXELS))
    assert found is not None
    assert found.moving
    near = [each for each in found.vibrations if each.frequency * PERIOD == pytest.approx(frequency, rel=0.02)]
    assert len(near) == len(found.vibrations) == int(predicts)
    assert np.ptp(found.shift[:, 0]) > 2.0
