"""Phases without any knowledge of them: a place that the beam passes in both directions looks the same both times.

Sort samples by the reference phases (a, b) of both axes. With angles A sin(a + δ) and B sin(b + ε), the intensity is a
function F(a, b) = f(sin(a + δ), sin(b + ε)), which is symmetric: F(a, b) = F(π - 2 δ - a, b), because the beam is at
one place at both phases of x, once in a forward and once in a backward half-period. The shift s for which F(a, b) and
F(s - a, b) correlate best gives δ = (π - s)/2, up to half a turn, which mirrors the picture. All shifts are evaluated
at once by a Fourier transform. The sharpness of the picture is not evaluated.
"""

from __future__ import annotations

from math import pi
from typing import NamedTuple

import numpy as np

from scanner.arrays import Array, Complex

PHASE_CELLS = 128
"""Cells of a turn of either phase: 2.8° of phase, 1.4° of the result."""

MIN_CORRELATION_SD = 6.0
"""Correlation above its median over all shifts, in standard deviations of pure noise, from which a phase counts as
found. The largest of 128 correlations reaches 3 by chance."""

MIN_CORRELATION_RATIO = 0.7
"""Correlation of opposite directions over that of samples of one phase cell, from which the frequency counts as right.
The ratio is 1 at the right frequency, 0.8 if the phase drifts by a tenth of a turn, below 0.6 if by a third."""


class PhaseFound(NamedTuple):
    """Phase of one axis against its reference, up to half a turn.

    Attributes:
        value: in [-π/2, π/2) [rad].
        correlation: of samples that the beam took at one place in opposite directions.
        quarter_turn: the same for a phase a quarter of a turn away; as large for a specimen equal to its mirror image.
        noise_sd: standard deviation of both correlations for pure noise.
        significance: correlation above its median, in these standard deviations.
        ratio: correlation over that of the samples of one cell.
    """

    value: float
    correlation: float
    quarter_turn: float
    noise_sd: float
    significance: float
    ratio: float

    @property
    def is_clear(self) -> bool:
        """Whether the samples of opposite directions agree."""
        return self.significance >= MIN_CORRELATION_SD and self.ratio >= MIN_CORRELATION_RATIO


def search_phases(phase_x: Array, phase_y: Array, intensity: Array) -> tuple[PhaseFound, PhaseFound]:
    """Phases of x and y for which the samples of opposite directions agree best.

    Args:
        phase_x, phase_y: reference phases, shape (n,) [rad]. They drift against the motion by less than 0.6 rad.
        intensity: shape (n,), finite.
    """
    n = PHASE_CELLS
    column, row = (np.floor(phase / (2 * pi) * n).astype(np.int64) % n for phase in (phase_x, phase_y))
    centred, cell = intensity - intensity.mean(), row * n + column
    sums = [np.bincount(cell, centred**power, n * n).astype(float) for power in range(3)]
    count, first, second = sums
    square = max(float(np.sum(second * (count - 1))), np.finfo(float).tiny)
    same_cell = float(np.sum(first**2 - second)) / square
    square_sums = [each.reshape(n, n) for each in sums]
    return _search_reflection(square_sums, 1, same_cell), _search_reflection(square_sums, 0, same_cell)


def _search_reflection(sums: list[Array], axis: int, same_cell: float) -> PhaseFound:
    """The shift of the reflected cells along one axis for which they correlate best with the cells themselves."""
    count, first, second = (np.fft.rfft(each, axis=axis) for each in sums)

    def products(a: Complex, b: Complex) -> Array:
        return np.asarray(np.fft.irfft((a * b).sum(axis=1 - axis), PHASE_CELLS))

    pairs = np.maximum(products(count, count), 0.5)
    mean, square, product = (products(a, b) / pairs for a, b in ((first, count), (second, count), (first, first)))
    match = (product - mean**2) / np.maximum(square - mean**2, np.finfo(float).tiny)
    best = int(np.argmax(match))
    below, at, above = match[best - 1], match[best], match[(best + 1) % PHASE_CELLS]
    curvature = below - 2 * at + above
    vertex = 0.5 * (below - above) / curvature if curvature < 0.0 else 0.0
    shift = (best + 1 + vertex) * 2 * pi / PHASE_CELLS  # cell i holds the phases around i + 1/2
    value, noise_sd = (pi - shift) / 2, float(np.sqrt(2.0 / pairs[best]))
    return PhaseFound(
        value=float((value + pi / 2) % pi - pi / 2),
        correlation=float(at),
        quarter_turn=float(match[(best + PHASE_CELLS // 2) % PHASE_CELLS]),
        noise_sd=noise_sd,
        significance=float((at - np.median(match)) / noise_sd),
        ratio=float(at / same_cell) if same_cell > 0.0 else 0.0,
    )
