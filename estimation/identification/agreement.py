"""Identified values, and estimates of one value that should agree: their mean, a widened interval, and a distance.

Every fit of the mechanics assumes a linear law. The test of this assumption is a second estimate from the same record:
with a stiffness and a damping that depend on the square of the amplitude, to first order. Its values hold at small
amplitude. Under a linear law both estimates agree within their noise.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import NamedTuple

import numpy as np

from estimation.diagnosis.identifiability import DISCRIMINATION_SIGMA
from estimation.least_squares import Z_95, between_variance, fit_linear
from scanner.arrays import Array


@dataclass(frozen=True)
class IdentifiedValue:
    """An identified value and its standard deviation, in the unit of the device file.

    Attributes:
        conflict: largest difference between two estimates of the value that should agree, in its standard deviations.
    """

    value: float
    sd: float
    conflict: float = 0.0

    @property
    def ci95(self) -> tuple[float, float]:
        """95 % confidence interval."""
        return self.value - Z_95 * self.sd, self.value + Z_95 * self.sd


class Differences(NamedTuple):
    """Differences between two estimates of p values that should agree, and their standard deviations, shape (p,)."""

    difference: Array
    sd: Array

    def select(self, chosen: Sequence[int], scale: Sequence[float] | Array) -> Differences:
        """The differences of some of the values, each times a factor of ``scale``, which changes its unit."""
        return Differences(self.difference[chosen] * scale, self.sd[chosen] * scale)

    @property
    def conflict(self) -> Array:
        """Differences in standard deviations, shape (p,); 0 where the difference is not determined."""
        return np.abs(self.difference) / np.where(self.sd > 0.0, self.sd, np.inf)

    @property
    def excess(self) -> Array:
        """Standard deviations by which intervals are widened, with the sign of the difference, shape (p,).

        The differences without what noise explains: 0 within their 95 % intervals. If any of them exceeds
        ``DISCRIMINATION_SIGMA``, the estimates do not agree, and every interval contains both of them: then the
        complete differences with their noise.
        """
        if self.conflict.max() > DISCRIMINATION_SIGMA:
            return np.asarray(np.copysign(np.hypot(self.difference, self.sd), self.difference))
        outside = np.maximum(np.abs(self.difference) - Z_95 * self.sd, 0.0)
        return np.asarray(np.where(self.sd > 0.0, np.copysign(outside, self.difference), 0.0))


def widen(values: Sequence[IdentifiedValue], differences: Differences) -> list[IdentifiedValue]:
    """Values with intervals that allow for their differences from estimates that should agree.

    Args:
        values: p values. differences: of all of them, in the same units.
    """
    return [
        replace(value, sd=float(np.hypot(value.sd, excess)), conflict=max(value.conflict, float(conflict)))
        for value, excess, conflict in zip(values, differences.excess, differences.conflict, strict=True)
    ]


class Found(NamedTuple):
    """Values that one recording determines, by name."""

    recording: str
    values: Mapping[str, IdentifiedValue]


def weighted_mean(same: Sequence[IdentifiedValue]) -> IdentifiedValue:
    """Mean with inverse variances as weights."""
    if len(same) == 1:
        return same[0]
    sds = _positive_sds(same)
    relative = (sds.min() / sds) ** 2
    mean = float(np.average([each.value for each in same], weights=relative))
    return IdentifiedValue(mean, float(sds.min() * relative.sum() ** -0.5), max(each.conflict for each in same))


def combine_values(found: Sequence[Mapping[str, IdentifiedValue]]) -> dict[str, IdentifiedValue]:
    """Mean over recordings of every value, with inverse variances as weights.

    Where the values of recordings scatter by more than their standard deviations, as of a device that changed between
    them, the variance between recordings is added to that of each: :func:`between_variance`.
    """
    values: dict[str, IdentifiedValue] = {}
    for key in dict.fromkeys(key for each in found for key in each):
        same = [each[key] for each in found if key in each]
        excess = between_variance(np.array([each.value for each in same]), _positive_sds(same)) ** 0.5
        values[key] = weighted_mean([replace(each, sd=float(np.hypot(each.sd, excess))) for each in same])
    return values


def _positive_sds(values: Sequence[IdentifiedValue]) -> Array:
    """Standard deviations, at least the rounding of the values, shape (n,)."""
    rounding = np.finfo(float).eps
    return np.array([max(each.sd, rounding * abs(each.value), np.finfo(float).tiny) for each in values])


def contradiction_notes(found: Sequence[Found]) -> list[str]:
    """One note if values of recordings differ by more than ``DISCRIMINATION_SIGMA`` standard deviations, else none.

    It names, for every such value, the two recordings that differ most.
    """
    differences = []
    for key in dict.fromkeys(key for each in found for key in each.values):
        pairs = combinations([each for each in found if key in each.values], 2)
        conflict, first, second = max(
            ((_distance(a.values[key], b.values[key]), a, b) for a, b in pairs),
            key=lambda each: each[0],
            default=(0.0, None, None),
        )
        if first is None or second is None or conflict <= DISCRIMINATION_SIGMA:
            continue
        change = second.values[key].value - first.values[key].value
        size = f"{change / first.values[key].value:+.2%}" if first.values[key].value else f"{change:+.3g}"
        differences.append(
            f"{key.replace('_over_', '/')} by {conflict:.3g} standard deviations ({size}) between {first.recording} "
            f"and {second.recording}"
        )
    if not differences:
        return []
    return [
        f"recordings contradict each other in {'; '.join(differences)}: the device or its surroundings changed between "
        "them, or its law is not linear; the intervals allow for the scatter of the recordings"
    ]


def _distance(first: IdentifiedValue, second: IdentifiedValue) -> float:
    """Difference of two values in its standard deviations."""
    return float(abs(first.value - second.value) / np.hypot(*_positive_sds([first, second])))


def scaled_by_inertia(ratio: IdentifiedValue, J: IdentifiedValue) -> IdentifiedValue:
    """k from k/J, or b from b/J, with independent J."""
    return IdentifiedValue(ratio.value * J.value, float(np.hypot(ratio.sd * J.value, ratio.value * J.sd)))


def difference_by_extra_columns(
    columns: Array, extra: Array, residual: Array, covariance: Array | None = None
) -> Differences:
    """How much the coefficients of a linear fit change if further columns are fitted too.

    Args:
        columns: of the fit, shape (n, p). extra: further columns, shape (n, q). residual: of the fit, shape (n,).
        covariance: of the coefficients of ``extra``, shape (q, q); by default that under a white residual.

    Returns:
        differences, shape (p,); not determined, with a standard deviation of 0, if the columns are linearly dependent.
    """
    together, count = np.column_stack([columns, extra]), columns.shape[1]
    if not linearly_independent(together):
        return Differences(np.zeros(count), np.zeros(count))
    coefficients, white = fit_linear(together, residual)
    # an omitted column changes the coefficients by its own coefficient times its projection on the columns
    projection = np.stack([fit_linear(columns, column)[0] for column in extra.T], axis=1)
    spread = projection @ (white[count:, count:] if covariance is None else covariance) @ projection.T
    return Differences(coefficients[:count], np.sqrt(np.maximum(np.diag(spread), 0.0)))


def linearly_independent(columns: Array) -> bool:
    """Whether no column, shape (n, p), is a combination of the others, within the rounding of their inner products."""
    size = np.sqrt(np.einsum("ni,ni->i", columns, columns))
    if not np.all(size > 0.0):
        return False
    eigenvalues = np.linalg.eigvalsh(np.einsum("ni,nj->ij", columns / size, columns / size))
    return bool(eigenvalues[0] > len(columns) * np.finfo(float).eps * eigenvalues[-1])


def amplitude_columns(time: Array, loss: float, by_phase: Array, by_log_amplitude: Array) -> Array:
    """Derivatives of a decay by a frequency and a damping that change with the square of its amplitude, shape (n, 2).

    Args:
        time: from the start [s], shape (n,). loss: b/J [1/s], the decay rate of the squared amplitude.
        by_phase, by_log_amplitude: derivatives of the signal by a phase and a log amplitude that are added, shape (n,).
    """
    growth = -np.expm1(-loss * time) / loss  # integral of the squared amplitude, relative to that at the start
    return np.stack([growth * by_phase, -growth * by_log_amplitude], axis=1)
