"""Reference picture of a film: the mean of its frames, as instrument for the line phase of each frame.

A frame by itself determines its line phase from the noisy gradient of its own lines. The mean of n frames has 1/n of
their variance. It is made of corrected frames, which are moved by whole pixels where the specimen moves, and is
weighted by the inverse variance of its pixels over the frames, which photon counts have in bright places and changing
specimens in those that change. A frame that is part of the mean is taken out of it when it is compared with it, so that
noise of the frame is not compared with itself.

The reference is an instrument (:mod:`recon.imaging.raster.line_phase`): an error of it, of its own line phase, or of
the motion makes a frame's phase less precise and its standard error larger, and does not bias it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.imaging.raster.line_phase import BLOCKS_ACROSS, Gradients, gradients, moved_lines
from scanner.arrays import Array, Complex

Frame = Sequence[NDArray[np.float32]]
"""Pictures of one frame by detector, each of shape (rows, columns)."""

MAX_MOTION_FRACTION = 1.0 / BLOCKS_ACROSS
"""Largest motion of the specimen that is searched for, as a fraction of the side: one block."""

VARIANCE_SMOOTHING_SD_PX = 3.0
"""Standard deviation of the Gaussian that smooths the variance of the pixels: it averages 100 of them, so that even two
frames determine it to 15 %, and resolves cells."""

MIN_VARIANCE_RATIO = 0.05
"""Least variance of a pixel as a fraction of the mean variance. It limits the weight of pixels that are constant in all
frames, such as masked or saturated ones, to 20 times the mean weight."""

MIN_COVERED_FRACTION = 0.5
"""Part of the frames that have to cover a pixel of a moving specimen."""

BACKGROUND_TO_DETAIL = 8.0
"""Standard deviation of the background that is subtracted for registration, in those of the smoothing: vignetting,
which does not move with the specimen, is wider."""


class Member(NamedTuple):
    """Line phase [px] of a frame of the reference, and the whole pixels (rows, columns) that it was moved by."""

    shift: float
    offset: tuple[int, int]


@dataclass
class FilmReference:
    """Sums over the corrected frames, of which ``instruments`` makes the gradients for one frame.

    Attributes:
        fill_squared: that the frames were corrected with.
        smoothing: standard deviation of the Gaussian that smooths the picture [px].
        sums, squares: of the pixels' values by detector, each of shape (rows, columns).
        count: number of frames that cover a pixel, shape (rows, columns).
        members: the frames that were added, by index.
    """

    fill_squared: float
    smoothing: float
    sums: list[Array]
    squares: list[Array]
    count: NDArray[np.float32]
    members: dict[int, Member] = field(default_factory=dict)
    _template: Complex | None = None
    _variances: list[Array] | None = None

    def add(self, index: int, frame: Frame, shift: float) -> None:
        """Add a frame whose line phase is known."""
        moved = self._corrected(frame, shift)
        offset = self._register(moved) if self.members else (0, 0)
        self.members[index] = Member(shift, offset)
        to, of = _overlap(self.count.shape, offset)
        self.count[to] += 1.0
        for lines, total, square in zip(moved, self.sums, self.squares, strict=True):
            total[to] += lines[of]
            square[to] += np.square(lines[of])
        self._template = self._variances = None

    def instruments(self, index: int, frame: Frame, shift: float) -> list[Gradients]:
        """Gradients by detector for a frame whose line phase is known to about a pixel, without the frame itself."""
        import cv2

        member = self.members.get(index)
        moved = self._corrected(frame, member.shift if member else shift)
        to, of = _overlap(self.count.shape, member.offset if member else self._register(moved))
        own = 1.0 if member else 0.0
        others = self.count[to] - own
        known = others > MIN_COVERED_FRACTION * (len(self.members) - own)
        reach = 2 * math.ceil(3.0 * self.smoothing) + 1
        inner = cv2.erode(known.astype(np.uint8), np.ones((reach, reach), np.uint8))  # the smoothing reaches no further
        if self._variances is None:
            self._variances = self._pixel_variances()
        found = []
        for lines, total, variance in zip(moved, self.sums, self._variances, strict=True):
            mean = ((total[to] - own * lines[of]) / np.where(known, others, np.inf)).astype(np.float32)
            smooth: NDArray[Any] = cv2.GaussianBlur(mean, (0, 0), self.smoothing, borderType=cv2.BORDER_REFLECT_101)
            weight = inner / variance[to]
            placed = Gradients(*(np.zeros(lines.shape, np.float32) for _ in range(2)))
            for picture, gradient in zip(placed, gradients(smooth), strict=True):
                picture[of] = gradient * weight
            found.append(placed)
        return found

    def _pixel_variances(self) -> list[Array]:
        """Variance of the pixels over the frames by detector, smoothed, each of shape (rows, columns)."""
        import cv2

        found = []
        for total, square in zip(self.sums, self.squares, strict=True):
            count = np.maximum(self.count, 1.0)
            variance = np.maximum(square / count - np.square(total / count), 0.0)
            sizes = (0, 0), VARIANCE_SMOOTHING_SD_PX
            smooth = cv2.GaussianBlur(variance, *sizes) / np.maximum(
                cv2.GaussianBlur((self.count > 1.0).astype(np.float64), *sizes), 1e-9
            )
            found.append(np.maximum(smooth, MIN_VARIANCE_RATIO * smooth.mean() + np.finfo(np.float32).tiny))
        return found

    def _corrected(self, frame: Frame, shift: float) -> list[NDArray[np.float32]]:
        return [moved_lines(lines, shift, self.fill_squared) for lines in frame]

    def _register(self, moved: Frame) -> tuple[int, int]:
        """Whole pixels (rows, columns) by which a frame has to be moved to match the reference: their correlation."""
        if self._template is None:
            self._template = np.conj(np.fft.rfft2(self._detail()))
        picture = np.sum(moved, axis=0)
        correlation = np.fft.irfft2(np.fft.rfft2(picture) * self._template, picture.shape)
        reach = [int(MAX_MOTION_FRACTION * side) for side in picture.shape]
        near = np.roll(correlation, reach, (0, 1))[: 2 * reach[0] + 1, : 2 * reach[1] + 1]
        row, column = np.unravel_index(np.argmax(near), near.shape)
        return reach[0] - int(row), reach[1] - int(column)

    def _detail(self) -> NDArray[np.float32]:
        """The reference less its background, in its middle; what may leave the field by motion is 0."""
        import cv2

        mean = (np.sum(self.sums, axis=0) / np.maximum(self.count, 1.0)).astype(np.float32)
        fine, coarse = (
            cv2.GaussianBlur(mean, (0, 0), factor * self.smoothing) for factor in (1.0, BACKGROUND_TO_DETAIL)
        )
        detail = np.zeros_like(mean)
        middle = tuple(slice(int(MAX_MOTION_FRACTION * n), n - int(MAX_MOTION_FRACTION * n)) for n in mean.shape)
        detail[middle] = (fine - coarse)[middle]
        detail[middle] -= detail[middle].mean()
        return detail


def empty_reference(frame: Frame, fill_squared: float, smoothing: float) -> FilmReference:
    """A reference of frames like this one, to which none is added yet."""
    shape = frame[0].shape
    sums, squares = ([np.zeros(shape) for _ in frame] for _ in range(2))
    return FilmReference(fill_squared, smoothing, sums, squares, np.zeros(shape, np.float32))


def _overlap(shape: tuple[int, ...], offset: Iterable[int]) -> tuple[tuple[slice, ...], tuple[slice, ...]]:
    """Slices of the reference and of the frame that show the same, for a frame moved by ``offset``."""
    to = tuple(slice(max(d, 0), n + min(d, 0)) for n, d in zip(shape, offset, strict=True))
    of = tuple(slice(max(-d, 0), n + min(-d, 0)) for n, d in zip(shape, offset, strict=True))
    return to, of
