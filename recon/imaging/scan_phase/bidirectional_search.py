"""Coarse search for the bidirectional phase: initial values for :mod:`recon.imaging.scan_phase.bidirectional_phase`."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanner.arrays import Array, Mask

SEARCH_REACH_RAD = math.radians(15.0)
"""Largest phase error that is searched. There the pictures of both directions still share two thirds of the field."""

SEARCH_CELLS = 128
"""Cells of phase across half a period of each axis."""

SEARCH_RESOLUTION_RAD = math.pi / SEARCH_CELLS / 4
"""Resolution of the search. A phase error with a larger standard error counts as undetermined."""

MATCH_SMOOTHING_CELLS = 0.7
"""Smoothing of the correlation over phase errors: few pairs of samples fall on exactly one cell."""

MIN_CORRELATION_SD = 6.0
"""Correlation, in standard deviations of pure noise, from which the picture has features. The largest of the 1 800
correlations of a search reaches 3.5 by chance."""


class RegistrationSamples(NamedTuple):
    """Samples from which phase errors are measured, each of shape (n,).

    Attributes:
        x, y: mapped position from the centre of the field [px].
        dx, dy: change of the position with the phase [px/rad].
        intensity: detected.
        block: number of the block of time that contains the sample.
    """

    x: Array
    y: Array
    dx: Array
    dy: Array
    intensity: Array
    block: NDArray[np.int64]

    def select(self, used: Mask) -> RegistrationSamples:
        """The samples of a mask, shape (n,)."""
        return RegistrationSamples(*(column[used] for column in self))  # type: ignore[arg-type]


def search_phase_errors(samples: RegistrationSamples) -> Array:
    """Return the phase errors (x, y) [rad] for which the pictures of opposite directions correlate best, shape (2,).

    NaN where they correlate no better than noise, where an axis does not move, and where the two directions have no
    cells in common at some of the phase errors: the right one may be among these, as in a scan of two nearly equal
    frequencies, whose figure hardly changes within a slice.

    Over arcsin(θ/A) instead of θ, forward and backward pictures are shifted against each other by 2 d everywhere. All
    errors within ``SEARCH_REACH_RAD`` are therefore evaluated at once, by the normalised correlation of the pairs of
    samples that fall into one cell.

    Source:
        Padfield 2012, "Masked object registration in the Fourier domain".
    """
    from scipy.ndimage import gaussian_filter

    n = SEARCH_CELLS
    reach = [float(np.hypot(*axis).max()) for axis in ((samples.x, samples.dx), (samples.y, samples.dy))]
    if min(reach) == 0.0:
        return np.full(2, np.nan)
    column, row = (
        np.minimum((np.arcsin(place / amplitude) / math.pi + 0.5) * n, n - 1).astype(int)
        for place, amplitude in zip((samples.x, samples.y), reach, strict=True)
    )
    index = ((2 * (samples.dy > 0) + (samples.dx > 0)) * n + row) * n + column
    value = samples.intensity - samples.intensity.mean()

    def transforms(weights: Array) -> NDArray[np.complex128]:
        backward, forward_x, forward_y, forward = np.bincount(index, weights, 4 * n * n).reshape(4, n, n)
        # upside down, the mixed pair is shifted in the same direction as the other pair
        pairs = [[forward, backward], [forward_x[::-1], forward_y[::-1]]]
        return np.asarray(np.fft.rfft2(pairs, (2 * n, 2 * n)))

    one, first, second = (transforms(value**power) for power in range(3))
    lag = np.fft.fftfreq(2 * n, 1 / (2 * n)) * math.pi / n
    allowed = np.abs(lag) <= 2 * SEARCH_REACH_RAD
    window = np.ix_(allowed, allowed)

    def correlate(a: NDArray[np.complex128], b: NDArray[np.complex128]) -> Array:
        sums = np.fft.irfft2((a[:, 0].conj() * b[:, 1]).sum(0), (2 * n, 2 * n))
        return np.asarray(gaussian_filter(sums, MATCH_SMOOTHING_CELLS, mode="wrap")[window])

    pairs, smoothed_cells = correlate(one, one), 4.0 * math.pi * MATCH_SMOOTHING_CELLS**2
    if pairs.min() * smoothed_cells < 1.0:
        return np.full(2, np.nan)
    mean_a, mean_b, square_a, square_b, product = (
        correlate(*sums) / pairs for sums in ((first, one), (one, first), (second, one), (one, second), (first, first))
    )
    variance = np.maximum((square_a - mean_a**2) * (square_b - mean_b**2), np.finfo(float).tiny)
    match = (product - mean_a * mean_b) / np.sqrt(variance)
    match[pairs * smoothed_cells < MIN_CORRELATION_SD**2] = -1.0  # not even a correlation of 1 exceeds noise there
    best_y, best_x = np.unravel_index(np.argmax(match), match.shape)
    noise_sd = 1.0 / np.sqrt(pairs[best_y, best_x] * smoothed_cells)
    if match[best_y, best_x] < MIN_CORRELATION_SD * noise_sd:
        return np.full(2, np.nan)
    return np.array([lag[allowed][best_x], lag[allowed][best_y]]) / 2
