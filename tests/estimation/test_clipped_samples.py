"""Rails of clipped samples, and corrections of clipped samples."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from estimation.clipped_samples import clip_again, find_rails


@given(st.floats(-0.8, -0.2), st.floats(0.2, 0.8), st.floats(-0.1, 0.1))
def test_corrected_samples_stand_beyond_no_true_signal(lower: float, upper: float, drift: float) -> None:
    time = np.linspace(0.0, 1.0, 2000)
    signal = np.sin(2 * np.pi * 5.0 * time)
    added = drift * time
    measured = np.clip(signal + added, lower, upper)
    corrected = clip_again(measured - added, measured)
    low, high = find_rails(corrected)
    inside = (corrected > low) & (corrected < high)
    np.testing.assert_allclose(corrected[inside], signal[inside], atol=1e-12)
    assert (signal[corrected < low] <= corrected.min() + 1e-12).all()
    assert (signal[corrected > high] >= corrected.max() - 1e-12).all()
    assert (corrected > high).sum() >= (measured >= upper).sum()


def test_samples_that_are_not_clipped_are_only_corrected() -> None:
    measured = np.sin(np.linspace(0.0, 10.0, 500))
    assert np.array_equal(find_rails(measured), [-np.inf, np.inf])
    assert np.array_equal(clip_again(measured - 0.1, measured), measured - 0.1)


def test_missing_samples_stay_missing() -> None:
    measured = np.minimum(np.sin(np.linspace(0.0, 20.0, 500)), 0.5)
    measured[100:110] = np.nan
    corrected = clip_again(measured + 0.2, measured)
    assert np.array_equal(np.isnan(corrected), np.isnan(measured))
    assert np.nanmax(corrected) == 0.7
