"""Sums of the frames' equations, which determine what all frames of a film share."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from recon.imaging.raster.line_phase import (
    BLOCKS_ACROSS,
    MAX_FILL_SQUARED,
    MAX_SHIFT_SD_PX,
    LinePhase,
    ShiftEquations,
    column_places,
    lag_at,
    standard_errors,
)
from scanner.arrays import Array

COLUMN_GROUPS = 16
"""Groups of columns whose lag is measured separately, for the figure that compares it with the law."""


class ColumnLag(NamedTuple):
    """Measured shift of groups of columns as a fraction of that at the middle, its standard error, and their places u.

    Each of shape (COLUMN_GROUPS,).
    """

    place: Array
    value: Array
    sd: Array


class SharedFill(NamedTuple):
    """Change of fill² that the equations of all frames ask for, and the standard error of fill²."""

    step: float
    sd: float


class PooledEquations:
    """Equations of the frames, added up one frame after the other.

    Scores of a block are added up over the frames. What their noise is averages out; what the specimen's detail adds to
    them is the same in each frame of one specimen.
    """

    def __init__(self, columns: int, fill_squared: float) -> None:
        self.fill_squared = fill_squared
        self._group = np.arange(columns) * COLUMN_GROUPS // columns
        self._first = np.searchsorted(self._group, np.arange(COLUMN_GROUPS))
        self._places = column_places(columns)
        self._score, self._slope = np.zeros((BLOCKS_ACROSS**2, 3)), np.zeros((BLOCKS_ACROSS**2, 3, 3))
        self._column_score, self._column_slope = np.zeros((2, BLOCKS_ACROSS, COLUMN_GROUPS))
        self._variances: list[float] = []

    def add(self, phase: LinePhase, equations: ShiftEquations | None) -> float:
        """Add a frame; return the change of its shift with fill² [px], nan if it determines no phase."""
        if equations is None or phase.sd >= MAX_SHIFT_SD_PX:
            return np.nan
        self._variances.append(phase.sd**2)
        self._score += equations.score
        self._slope += equations.slope
        self._column_score += phase.shift * np.add.reduceat(equations.column_score, self._first, axis=1)
        self._column_slope += phase.shift**2 * np.add.reduceat(equations.column_slope, self._first, axis=1)
        total = equations.slope.sum(axis=0)
        return -float(np.linalg.solve(total[:2, :2], total[:2, 2])[0])

    def lag(self) -> ColumnLag:
        """Lag in groups of columns: the law, and what is left to it."""
        slope = self._column_slope.sum(axis=0)
        total = np.where(slope > 0.0, slope, np.nan)
        left = self._column_score.sum(axis=0) / total
        scatter = np.sum(np.square(self._column_score - self._column_slope * left), axis=0)
        scatter *= BLOCKS_ACROSS / (BLOCKS_ACROSS - 1)
        place = np.add.reduceat(self._places, self._first) / np.bincount(self._group)
        return ColumnLag(place, lag_at(place, self.fill_squared) + left, np.sqrt(scatter) / total)

    def detail_sd(self) -> float:
        """Error of the shift by the specimen's own detail [px]: what averaging over the frames does not reduce."""
        count = len(self._variances)
        if count < 2:
            return 0.0
        slope, score = self._slope[:, :2, :2], self._score[:, :2]
        step = np.linalg.solve(slope.sum(axis=0), score.sum(axis=0))
        pooled = float(standard_errors(score, slope, step)[0]) ** 2
        detail = (pooled - np.mean(self._variances) / count) * count / (count - 1)
        return float(np.sqrt(np.clip(detail, 0.0, np.mean(self._variances))))

    def fill(self) -> SharedFill:
        """Newton step of fill² and its standard error; shift and tilt of the frames are eliminated."""
        total = self._slope.sum(axis=0)
        projection = total[2, :2] @ np.linalg.inv(total[:2, :2])
        score = self._score[:, 2] - self._score[:, :2] @ projection
        slope = float(total[2, 2] - projection @ total[:2, 2])
        if not slope > 0.0:
            return SharedFill(0.0, np.inf)
        step = float(np.sum(score)) / slope
        step = float(np.clip(step, -self.fill_squared, MAX_FILL_SQUARED - self.fill_squared))
        return SharedFill(step, float(np.sqrt(np.sum(np.square(score - np.mean(score))))) / slope)
