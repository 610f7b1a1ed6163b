"""Drive frequencies for a Lissajous scan: from the field, pixels, frame rate and fill wanted to pairs that give them.

Motions at n_x F and n_y F, n_x and n_y without a common divisor, trace one figure F times a second (Hwang et al., Sci.
Rep. 7, 14075 (2017)). In u = arcsin(theta_x / A_x), v = arcsin(theta_y / A_y) it is straight lines that fold back at
the edges, a mesh of rhombi pi/n_y wide and pi/n_x high; in the picture the middle rhombus is the largest. That holds
for the best phase between the axes. At the worst the figure runs into a corner of the field and returns on its own
trace: the rhombi are twice as large. Between the two lie pi/(2 n_y) of the phase of x or pi/(2 n_x) of the phase of y,
fractions of a degree, and a drifting resonance moves them by degrees: what has to hold has to hold at the worst phase.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon.coverage import time_for_fill
from recon.mapping import Grid, map_samples, pixel_index
from scanner.device import Axis, Device
from scanner.errors import BadInput
from scanner.parametric import sine_drive, steady_state, stiffness_modulation, threshold, tongue_edges

Array = NDArray[np.float64]
Span = tuple[float, float]  # from, to

FASTER = 0.1  # a figure may repeat up to this fraction faster than asked: few pairs meet a rate exactly
MOST = 12  # pairs whose fill is computed: those nearest to the frame rate, of the finest mesh
PHASES = ("best", "worst")
_STEPS = 12  # of the drive's frequency across the tongue
_HALVINGS = 8  # of a step, for the edge at which the motion is lost


@dataclass(frozen=True)
class Wish:
    """What a scan should do.

    Attributes:
        grid: the picture's pixels and the field that they cover.
        frame_rate: pictures a second, at least [Hz].
        fill: fraction of the pixels that a picture has to visit, in (0, 1].
        rate: samples a second [Hz]; None counts the beam's path, as if it were sampled without end.
        margin: relative change of either stiffness, up or down, that field and motion have to survive.
    """

    grid: Grid
    frame_rate: float
    fill: float = 0.95
    rate: float | None = None
    margin: float = 0.0005

    def __post_init__(self) -> None:
        if not 0.0 < self.fill <= 1.0:
            raise BadInput(f"a fill of {self.fill:g}", hint="give a fraction above 0 and at most 1")
        if not (math.isfinite(self.frame_rate) and self.frame_rate > 0.0):
            raise BadInput(f"a frame rate of {self.frame_rate:g} Hz", hint="give a positive one")
        if not 0.0 <= self.margin < 0.1:
            raise BadInput(f"a margin of {self.margin:g}", hint="give a fraction below 0.1")


@dataclass(frozen=True)
class Band:
    """The motion that a drive sustains against the drive's frequency.

    Attributes:
        axis: its name.
        drive: frequencies of the drive, increasing, shape (n,) [Hz].
        amplitude: shape (n,) [rad].
        turns: of the drive in one of the motion: 2 for a parametric drive, 1 for a linear one.
    """

    axis: str
    drive: Array
    amplitude: Array
    turns: int

    def at(self, motion: float) -> float:
        """Amplitude [rad] of a motion of that frequency [Hz]."""
        return float(np.interp(self.turns * motion, self.drive, self.amplitude))

    def covering(self, half_angle: float, margin: float) -> Span:
        """Frequencies of the motion [Hz] whose amplitude reaches ``half_angle`` [rad].

        Args:
            margin: relative change of the stiffness, up or down, that they allow for: the band goes with its root.

        Raises:
            BadInput: no frequency does; the line says what is reached.
        """
        reach = float(self.amplitude.max())
        peak = int(self.amplitude.argmax())
        low, high = (
            _crossing(self.drive[part][::order], self.amplitude[part][::order], half_angle) / self.turns
            for part, order in ((slice(0, peak + 1), 1), (slice(peak, None), -1))
        )
        low, high = low * math.sqrt(1.0 + margin), high * math.sqrt(1.0 - margin)
        if reach < half_angle or low > high:
            raise BadInput(
                f"the drive sustains {reach:.4g} rad, the field asks for {half_angle:.4g} with a margin of {margin:g}",
                channel=self.axis,
                hint="give a smaller field, more volts or a smaller margin",
            )
        return low, high


def _crossing(frequency: Array, amplitude: Array, level: float) -> float:
    """Frequency at which an amplitude that rises with the index passes ``level``, the first where it begins above."""
    return float(np.interp(level, np.maximum.accumulate(amplitude), frequency))


@dataclass(frozen=True)
class Figure:
    """A pair of motions.

    Attributes:
        windings: cycles of x and of y in a picture, n_x and n_y.
        frame_rate: pictures a second [Hz].
        amplitude: of x and of y [rad].
    """

    windings: tuple[int, int]
    frame_rate: float
    amplitude: tuple[float, float]

    @property
    def phase_room(self) -> tuple[float, float]:
        """From the best phase of x, or of y, to the worst [rad]."""
        n_x, n_y = self.windings
        return 0.5 * math.pi / n_y, 0.5 * math.pi / n_x

    def angles(self, rate: float, phase: str) -> tuple[Array, Array]:
        """Angles of one picture at ``rate`` samples a second, shape (samples a picture,) [rad].

        The figure runs into a corner where both motions turn at once: n_y phi_x - n_x phi_y = (n_y - n_x) pi/2, modulo
        pi. That is the "worst" ``phase``; the "best", of the finest mesh, lies half way to the next. (It is symmetric,
        as the pixels are, so that traces may share theirs: a phase nearby can fill a few pixels in a hundred more.)
        """
        n_x, n_y = self.windings
        turn = 2.0 * np.pi * self.frame_rate * np.arange(round(rate / self.frame_rate)) / rate
        phi_x = 0.5 * math.pi * (n_y - n_x + (phase == "best")) / n_y
        return self.amplitude[0] * np.sin(n_x * turn + phi_x), self.amplitude[1] * np.sin(n_y * turn)

    def mesh(self, grid: Grid) -> float:
        """Diameter of the disc that fits into the middle rhombus at the best phase [px]."""
        across = 0.5 * math.pi * grid.width * self.amplitude[0] / grid.half_angle_x / self.windings[1]
        high = 0.5 * math.pi * grid.height * self.amplitude[1] / grid.half_angle_y / self.windings[0]
        return across * high / math.hypot(across, high)

    def path_rate(self, grid: Grid) -> float:
        """Samples a second [Hz] from which on the beam moves half a pixel or less from one to the next on each axis."""
        x = self.windings[0] * self.amplitude[0] / grid.half_angle_x * grid.width
        y = self.windings[1] * self.amplitude[1] / grid.half_angle_y * grid.height
        return 2.0 * math.pi * self.frame_rate * max(x, y)


@dataclass(frozen=True)
class Candidate:
    """A figure, how to drive it and what it does; what depends on the phase between the axes, by ``PHASES``.

    Attributes:
        drive: frequencies of the drives of x and y [Hz].
        mesh: as ``Figure.mesh`` [px].
        fill: fraction of the pixels that one picture visits.
        gap: diameter of the largest disc that holds no visited pixel, see ``largest_gap`` [px].
        time: in which the fill that was wanted is there [s]; None if one picture does not reach it.
    """

    figure: Figure
    drive: tuple[float, float]
    mesh: float
    fill: Mapping[str, float]
    gap: Mapping[str, float]
    time: Mapping[str, float | None]

    def meets(self, fill: float) -> str:
        """When the fill is reached: "at any phase", "at the best phase" or "no"."""
        reached = sum(self.fill[phase] >= fill for phase in PHASES)
        return ("no", "at the best phase", "at any phase")[reached]


def sustained(axis: Axis, amplitude: float, offset: float) -> Band:
    """The motion of one axis under ``offset + amplitude sin`` volts against the drive's frequency.

    Raises:
        BadInput: the drive is below the threshold of parametric resonance.
    """
    from scipy.interpolate import PchipInterpolator

    linear = axis.require_drive().torque_per_volt
    if linear is not None:
        mechanics = axis.require_mechanics()
        swept = axis.resonance * (1.0 + np.linspace(-20.0, 20.0, 2001) / axis.quality)
        w = 2.0 * np.pi * swept
        stiffness = mechanics.k - mechanics.J * w * w + 1j * mechanics.b * w
        return Band(axis.name, swept, np.abs(linear * amplitude / stiffness), 1)
    tongue = tongue_edges(axis, sine_drive(2.0 * axis.resonance, amplitude, offset))
    if tongue is None:
        delta = stiffness_modulation(axis, sine_drive(2.0 * axis.resonance, amplitude, offset))
        raise BadInput(
            f"{offset:g} V + {amplitude:g} V sin modulate the stiffness by {delta:.2g}, the threshold is "
            f"{threshold(axis):.2g}: nothing oscillates",
            channel=axis.name,
            hint="give more volts",
        )
    # The large motion grows from the tongue's upper edge downwards, past its lower edge, until it is lost.
    step = (tongue[1] - tongue[0]) / _STEPS
    found: list[tuple[float, float]] = []
    frequency, halvings = tongue[1] - step, 0
    while halvings <= _HALVINGS:
        state = steady_state(axis, sine_drive(frequency, amplitude, offset))
        if state is not None:
            found.append((frequency, state[0]))
        if halvings or state is None:
            halvings += 1
            step *= 0.5
        frequency += step if state is None else -step
    if not found:
        raise BadInput("no steady motion was found in the tongue", channel=axis.name, hint="give more volts")
    drive, reached = np.array(sorted(found)).T
    finer = np.linspace(drive[0], drive[-1], 401)
    return Band(axis.name, finer, PchipInterpolator(drive, reached)(finer), 2)



def figures(x: Span, y: Span, frame_rate: float) -> Iterator[tuple[tuple[int, int], float]]:
    """Windings and frame rate [Hz] of each figure that repeats at ``frame_rate`` or up to ``FASTER`` faster.

    Args:
        x, y: lowest and highest frequency of the motions [Hz].
    """
    most = frame_rate * (1.0 + FASTER)
    for n_x in range(math.ceil(x[0] / most), math.floor(x[1] / frame_rate) + 1):
        for n_y in range(math.ceil(y[0] / most), math.floor(y[1] / frame_rate) + 1):
            slowest = max(frame_rate, x[0] / n_x, y[0] / n_y)
            if math.gcd(n_x, n_y) == 1 and slowest <= min(most, x[1] / n_x, y[1] / n_y):
                yield (n_x, n_y), slowest


def largest_gap(visited: NDArray[np.bool_]) -> float:
    """Diameter of the largest disc, centred on a pixel, that holds no visited pixel's centre, less one pixel [px].

    0 where all of ``visited``, shape (height, width), is set, 1 for single holes, infinite where nothing is.
    """
    from scipy.ndimage import distance_transform_edt

    if not visited.any():
        return math.inf
    return max(0.0, 2.0 * float(distance_transform_edt(~visited).max()) - 1.0)


def gap_against_time(theta_x: Array, theta_y: Array, rate: float, grid: Grid, times: Sequence[float] | Array) -> Array:
    """``largest_gap`` [px] at each of ``times`` [s], increasing: of their shape.

    Args:
        theta_x, theta_y: angles, shape (n,) [rad]. rate: their samples a second [Hz].
    """
    row = pixel_index(theta_y, grid.half_angle_y, grid.height)
    column = pixel_index(theta_x, grid.half_angle_x, grid.width)
    inside = (row >= 0) & (column >= 0)
    visited = np.zeros((grid.height, grid.width), bool)
    gaps, done = [], 0
    for time in times:
        new = slice(done, done := round(time * rate))
        visited[row[new][inside[new]], column[new][inside[new]]] = True
        gaps.append(largest_gap(visited))
    return np.array(gaps)


def design(device: Device, wish: Wish, volts: tuple[float, float]) -> tuple[dict[str, Band], list[Candidate]]:
    """The bands that a drive sustains, and the pairs within them that come nearest to the wish, best first.

    Those that reach the fill at any phase come first, then those that do at the best phase, then the others; among
    each, those nearest to the frame rate, then those of the smallest gap at the worst phase.

    Args:
        volts: amplitude and offset of both drives [V].

    Raises:
        BadInput: a drive does not sustain the field, or no pair repeats at the frame rate.
    """
    grid = wish.grid
    bands = {name: sustained(device.axis(name), *volts) for name in ("x", "y")}
    x = bands["x"].covering(grid.half_angle_x, wish.margin)
    y = bands["y"].covering(grid.half_angle_y, wish.margin)
    found = [
        Figure((n_x, n_y), rate, (bands["x"].at(n_x * rate), bands["y"].at(n_y * rate)))
        for (n_x, n_y), rate in figures(x, y, wish.frame_rate)
    ]
    if not found:
        raise BadInput(
            f"no pair of motions within {x[0]:.2f} to {x[1]:.2f} Hz and {y[0]:.2f} to {y[1]:.2f} Hz repeats "
            f"{wish.frame_rate:g} times a second",
            hint="ask for a lower frame rate, a smaller field or a smaller margin",
        )
    nearest = sorted(found, key=lambda each: (each.frame_rate, each.mesh(grid)))[:MOST]
    candidates = [_candidate(each, bands, wish) for each in nearest]
    order = ("at any phase", "at the best phase", "no")
    candidates.sort(key=lambda c: (order.index(c.meets(wish.fill)), c.figure.frame_rate, c.gap["worst"]))
    return bands, candidates


def _candidate(figure: Figure, bands: Mapping[str, Band], wish: Wish) -> Candidate:
    rate = wish.rate or figure.path_rate(wish.grid)
    fill, gap, time = {}, {}, {}
    for phase in PHASES:
        x, y = figure.angles(rate, phase)
        visited = map_samples(x, y, x, wish.grid).coverage > 0
        fill[phase], gap[phase] = float(visited.mean()), largest_gap(visited)
        time[phase] = time_for_fill(x, y, rate, wish.grid, wish.fill)
    n_x, n_y = figure.windings
    drive = bands["x"].turns * n_x * figure.frame_rate, bands["y"].turns * n_y * figure.frame_rate
    return Candidate(figure, drive, figure.mesh(wish.grid), fill, gap, time)
