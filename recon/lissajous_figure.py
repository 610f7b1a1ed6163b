"""Closed Lissajous figures: which pairs of motions repeat at a rate, and the mesh that a figure draws."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from recon.imaging.picture import Grid
from scanner.arrays import Array
from scanner.errors import BadInput

FrequencyRange = tuple[float, float]
"""Lowest and highest frequency [Hz]."""

MAX_RATE_EXCESS = 0.1
"""Fraction by which a figure may repeat faster than required: few pairs meet a frame rate exactly."""

MAX_WINDINGS = 20_000
"""Most cycles of an axis in one picture. It bounds the pairs that are compared to some millions, a few seconds, and
the beam's path over 400 pixels to the samples of ``scan_design.MAX_PICTURE_SAMPLES``."""

PHASES = {"best": 0.5, "worst": 0.0}
"""Phases between the axes of the finest and of the coarsest mesh, as parts of the way from one coarsest to the next."""


@dataclass(frozen=True)
class LissajousFigure:
    """A closed Lissajous figure.

    Attributes:
        windings: cycles of x and of y in one picture, n_x and n_y.
        frame_rate: pictures per second [Hz].
        amplitude: of x and of y [rad].
    """

    windings: tuple[int, int]
    frame_rate: float
    amplitude: tuple[float, float]

    @property
    def phase_best_to_worst(self) -> tuple[float, float]:
        """Difference between the best and the worst phase, of x and of y [rad]."""
        n_x, n_y = self.windings
        return 0.5 * math.pi / n_y, 0.5 * math.pi / n_x

    def angles(self, rate: float, phase: float, delay: float = 0.0) -> tuple[Array, Array]:
        """Return the angles of one picture, shape (samples per picture,) [rad].

        The figure runs into a corner where both motions reverse at once: n_y phi_x - n_x phi_y = (n_y - n_x) pi/2,
        modulo pi. That is the "worst" phase. The "best" phase, of the finest mesh, is half way to the next worst one.
        It is symmetric, as the pixels are, so lines may share pixels: a phase nearby can fill a few per cent more.

        Args:
            rate: samples per second [Hz].
            phase: part of the way from a worst phase to the next one, see ``PHASES``.
            delay: of the first sample, in periods of the sample clock.
        """
        n_x, n_y = self.windings
        turn = 2.0 * np.pi * self.frame_rate * (np.arange(round(rate / self.frame_rate)) + delay) / rate
        phi_x = math.pi * (0.5 * (n_y - n_x) + phase) / n_y
        return self.amplitude[0] * np.sin(n_x * turn + phi_x), self.amplitude[1] * np.sin(n_y * turn)

    def mesh_diameter(self, grid: Grid) -> float:
        """Return the diameter of the largest disc in the middle rhombus at the best phase [px]."""
        across = 0.5 * math.pi * grid.width * self.amplitude[0] / grid.half_angle_x / self.windings[1]
        high = 0.5 * math.pi * grid.height * self.amplitude[1] / grid.half_angle_y / self.windings[0]
        return across * high / math.hypot(across, high)

    def path_rate(self, grid: Grid) -> float:
        """Return the sample rate [Hz] at which the beam moves half a pixel per sample at most, on each axis."""
        x = self.windings[0] * self.amplitude[0] / grid.half_angle_x * grid.width
        y = self.windings[1] * self.amplitude[1] / grid.half_angle_y * grid.height
        return 2.0 * math.pi * self.frame_rate * max(x, y)

    def skips_pixels(self, rate: float, grid: Grid) -> bool:
        """Return whether the beam moves more than a pixel between samples at ``rate`` [Hz]."""
        return rate < 0.5 * self.path_rate(grid)


def enumerate_figures(
    x: FrequencyRange, y: FrequencyRange, frame_rate: float
) -> Iterator[tuple[tuple[int, int], float]]:
    """Yield windings and frame rate [Hz] of each figure that repeats at ``frame_rate`` or slightly faster.

    Args:
        x, y: lowest and highest frequency of the motions [Hz].
        frame_rate: pictures per second [Hz].

    Raises:
        BadInput: a picture would take more than ``MAX_WINDINGS`` cycles.
    """
    if max(x[1], y[1]) > MAX_WINDINGS * frame_rate:
        what = f"a picture at {frame_rate:g} Hz takes {max(x[1], y[1]) / frame_rate:.3g} cycles"
        raise BadInput(what, hint=f"give a frame rate of {max(x[1], y[1]) / MAX_WINDINGS:.2g} Hz or more")
    most = frame_rate * (1.0 + MAX_RATE_EXCESS)
    for n_x in range(max(1, math.ceil(x[0] / most)), math.floor(x[1] / frame_rate) + 1):
        for n_y in range(max(1, math.ceil(y[0] / most)), math.floor(y[1] / frame_rate) + 1):
            slowest = max(frame_rate, x[0] / n_x, y[0] / n_y)
            if math.gcd(n_x, n_y) == 1 and slowest <= min(most, x[1] / n_x, y[1] / n_y):
                yield (n_x, n_y), slowest
