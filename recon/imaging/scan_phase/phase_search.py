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
from scanner.channel import Channel

PHASE_CELLS = 128
"""Cells of a turn of either phase: 2.8° of phase, 1.4° of the result."""

MIN_CORRELATION_SD = 6.0
"""Correlation above its median over all shifts, in standard deviations of pure noise, from which a phase counts as
found. The largest of 128 correlations reaches 3 by chance."""

MIN_CORRELATION_RATIO = 0.7
"""Correlation of opposite directions over that of samples of one phase cell, from which the frequency counts as right.
The ratio is 1 at the right frequency, 0.8 if the phase drifts by a tenth of a turn, below 0.6 if by a third."""

BANDS = 8
"""Bands of phase of the other axis in which correlations are compared: each holds 16 cells of it."""

MIN_VARIANCE_SHARE = 1e-9
"""Variance of the samples of a band over their mean square below which they differ by rounding only."""


PERIODS_PER_SEARCH = 12
"""Periods of the slower axis in which the phases are searched at once: enough to cross most of the field, and half of a
slice of the registration, within which the phase drifts less."""

MIN_FOUND_FRACTION = 0.5
"""Fraction of the slices in which the search has to find the phase of an axis."""


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


class PhaseMatches(NamedTuple):
    """Correlations of the samples in cells of phase of one axis.

    Attributes:
        reflected: of F(a, b) and F(s - a, b) for all shifts s, shape (PHASE_CELLS,).
        by_band: the same in bands of phase of the other axis, shape (BANDS, PHASE_CELLS).
        noise_sd: standard deviation of ``reflected`` for pure noise, shape (PHASE_CELLS,).
        common_cells: pairs of visited cells that are compared, shape (PHASE_CELLS,).
        half_turn: of F(a, b) and F(a + π, b); 0 without such pairs.
        same_cell: of the samples of one cell.
    """

    reflected: Array
    by_band: Array
    noise_sd: Array
    common_cells: Array
    half_turn: float
    same_cell: float

    @property
    def best(self) -> int:
        """Number of the shift with the largest correlation."""
        return int(np.argmax(self.reflected))

    def phase(self, shift: float) -> float:
        """Phase δ at a shift in cells, in [-π/2, π/2) [rad]."""
        return float(((pi - _shift_rad(shift)) / 2 + pi / 2) % pi - pi / 2)


def search_phases(phase_x: Array, phase_y: Array, intensity: Array) -> tuple[PhaseFound, PhaseFound]:
    """Phases of x and y for which the samples of opposite directions agree best.

    Args:
        phase_x, phase_y: reference phases, shape (n,) [rad]. They drift against the motion by less than 0.6 rad.
        intensity: shape (n,), finite.
    """
    x, y = match_phases(phase_x, phase_y, intensity)
    return best_reflection(x), best_reflection(y)


def match_phases(phase_x: Array, phase_y: Array, intensity: Array) -> tuple[PhaseMatches, PhaseMatches]:
    """Correlations of the samples over all reflections of x and of y; arguments as for ``search_phases``."""
    n = PHASE_CELLS
    column, row = (np.floor(phase / (2 * pi) * n).astype(np.int64) % n for phase in (phase_x, phase_y))
    centred, cell = intensity - intensity.mean(), row * n + column
    sums = [np.bincount(cell, centred**power, n * n).astype(float) for power in range(3)]
    count, first, second = sums
    square = max(float(np.sum(second * (count - 1))), np.finfo(float).tiny)
    same_cell = float(np.sum(first**2 - second)) / square
    square_sums = [each.reshape(n, n) for each in sums]
    return _match_axis(square_sums, 1, same_cell), _match_axis(square_sums, 0, same_cell)


def _match_axis(sums: list[Array], axis: int, same_cell: float) -> PhaseMatches:
    """Correlations of the cells with the reflected cells along one axis, and with those half a turn away."""
    moved = sums if axis == 1 else [each.T for each in sums]
    visited, *own = (np.fft.rfft(each) for each in (moved[0] > 0.0, *moved))
    by_band, _ = _correlate(own, own, PHASE_CELLS // BANDS)
    reflected, pairs = (each[0] for each in _correlate(own, own, PHASE_CELLS))
    turned, turned_pairs = (each[0] for each in _correlate(own, [each.conj() for each in own], PHASE_CELLS))
    return PhaseMatches(
        reflected=reflected,
        by_band=by_band,
        noise_sd=np.sqrt(2.0 / pairs),
        common_cells=np.fft.irfft((visited**2).sum(axis=0), PHASE_CELLS),
        half_turn=float(turned[PHASE_CELLS // 2]) if turned_pairs[PHASE_CELLS // 2] >= 1.0 else 0.0,
        same_cell=same_cell,
    )


def _correlate(a: list[Complex], b: list[Complex], rows: int) -> tuple[Array, Array]:
    """Normalised correlations and pairs of samples for all shifts, in bands of ``rows`` rows each.

    Args:
        a, b: spectra of count, sum and sum of squares of the cells, each of shape (PHASE_CELLS, frequencies).

    Returns:
        arrays of shape (bands, PHASE_CELLS).
    """

    def products(first: Complex, second: Complex) -> Array:
        bands = (first * second).reshape(-1, rows, first.shape[1]).sum(axis=1)
        return np.asarray(np.fft.irfft(bands, PHASE_CELLS))

    pairs = np.maximum(products(a[0], b[0]), 0.5)
    mean, square, product = (products(a[k], b[m]) / pairs for k, m in ((1, 0), (2, 0), (1, 1)))
    variance = square - mean**2
    is_varied = variance > MIN_VARIANCE_SHARE * square
    return np.divide(product - mean**2, variance, out=np.zeros_like(product), where=is_varied), pairs


def _shift_rad(shift: float) -> float:
    """A shift in cells as an angle [rad]; cell i holds the phases around i + 1/2."""
    return (shift + 1) * 2 * pi / PHASE_CELLS


def best_reflection(matches: PhaseMatches) -> PhaseFound:
    """The shift of the reflected cells for which they correlate best with the cells themselves."""
    match, best = matches.reflected, matches.best
    below, at, above = match[best - 1], match[best], match[(best + 1) % PHASE_CELLS]
    curvature = below - 2 * at + above
    vertex = 0.5 * (below - above) / curvature if curvature < 0.0 else 0.0
    return PhaseFound(
        value=matches.phase(best + vertex),
        correlation=float(at),
        quarter_turn=float(match[(best + PHASE_CELLS // 2) % PHASE_CELLS]),
        noise_sd=float(matches.noise_sd[best]),
        significance=float((at - np.median(match)) / matches.noise_sd[best]),
        ratio=float(at / matches.same_cell) if matches.same_cell > 0.0 else 0.0,
    )


def continue_phases(found: list[PhaseFound]) -> tuple[Array, bool]:
    """Phases of slices without jumps [rad], and whether they are the only ones that fit.

    A specimen that nearly equals its mirror image allows two phases, a quarter of a turn apart. The scan as a whole
    decides between them.
    """
    raw = np.array([each.value for each in found])
    value = np.unwrap(raw, period=pi / 2)
    sign = np.where(np.abs(np.sin(value - raw)) < np.sin(pi / 4), 1.0, -1.0)
    margin = float(sign @ np.array([each.correlation - each.quarter_turn for each in found]))
    noise_sd = float(np.sqrt(2.0 * sum(each.noise_sd**2 for each in found)))
    return value + (0.0 if margin >= 0.0 else pi / 2), abs(margin) > MIN_CORRELATION_SD * noise_sd


def cut_slices(intensity: Channel, duration: float) -> list[tuple[int, int]]:
    """Samples (first, stop) of equal parts of about ``duration`` [s]."""
    parts = max(1, round(intensity.size / intensity.sample_rate / duration))
    edges = np.linspace(0, intensity.size, parts + 1).round().astype(int)
    return list(zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True))
