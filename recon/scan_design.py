"""Scan design: drive frequencies for a given field, resolution, frame rate and fill factor.

Motions at n_x F and n_y F, with n_x and n_y coprime, trace one figure F times a second (Hwang et al., Sci. Rep. 7,
14075 (2017)). Over u = arcsin(theta_x / A_x) and v = arcsin(theta_y / A_y) the figure consists of straight lines that
are reflected at the edges: a mesh of rhombi pi/n_y wide and pi/n_x high, of which the middle one is the largest in the
picture. That is the best phase between the axes. At the worst phase the figure runs into a corner of the field and
returns on the same path, and the rhombi are twice as large. The two differ by pi/(2 n_y) in the phase of x or
pi/(2 n_x) in that of y: fractions of a degree. A drifting resonance shifts the phases by degrees, so a requirement has
to be met at the worst phase.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from recon.imaging.coverage import largest_gap, time_for_fill
from recon.imaging.gridding import map_samples
from recon.imaging.picture import Grid
from scanner.arrays import Array
from scanner.device import Axis, Device
from scanner.errors import BadInput
from scanner.parametric import sine_drive, steady_state, stiffness_modulation, threshold, tongue_edges
from scanner.stages import Scan

FrequencyRange = tuple[float, float]
"""Lowest and highest frequency [Hz]."""

MAX_RATE_EXCESS = 0.1
"""Fraction by which a figure may repeat faster than required: few pairs meet a frame rate exactly."""

MAX_EVALUATED_FIGURES = 12
"""Figures whose fill is computed, those nearest to the frame rate. It bounds the cost, a second for each."""

MAX_PICTURE_SAMPLES = 5e7
"""Most samples of one picture, which take 4 GB of memory: 10 s at 5 MHz."""

MAX_WINDINGS = 20_000
"""Most cycles of an axis in one picture. It bounds the pairs that are compared to some millions, a few seconds, and
the beam's path over 400 pixels to the samples of ``MAX_PICTURE_SAMPLES``."""

PHASES = ("best", "worst")
"""Phases between the axes at which a figure is evaluated: of the finest and of the coarsest mesh."""

_TONGUE_STEPS = 12
"""Steps of the drive's frequency across the instability tongue."""

_EDGE_HALVINGS = 8
"""Halvings of a step in the search for the frequency at which the motion ceases: to 1/3000 of the width of the
instability tongue."""


def wanted_field(device: Device, half_angles: tuple[float, float] | None) -> Scan:
    """Return the device's field of view, with other half angles [rad] if some are given.

    Raises:
        DeviceInvalid: none is given and the device states none.
    """
    if half_angles is None:
        return device.require_scan()
    stated = device.scan or Scan(*half_angles)
    return replace(stated, half_angle_x=half_angles[0], half_angle_y=half_angles[1])


@dataclass(frozen=True)
class ScanRequirements:
    """Requirements on a scan.

    Attributes:
        grid: the pixels and the field that they cover.
        frame_rate: smallest number of pictures per second [Hz].
        fill: fraction of the pixels that a picture has to visit, in (0, 1].
        sample_rate: of the intensity [Hz]; None counts all pixels on the beam's path.
        stiffness_margin: relative change of either stiffness, in both directions, at which the field still has to be
            covered.
    """

    grid: Grid
    frame_rate: float
    fill: float = 0.95
    sample_rate: float | None = None
    stiffness_margin: float = 0.0005

    def __post_init__(self) -> None:
        if not 0.0 < self.fill <= 1.0:
            raise BadInput(f"a fill of {self.fill:g}", hint="give a fraction above 0 and at most 1")
        if not (math.isfinite(self.frame_rate) and self.frame_rate > 0.0):
            raise BadInput(f"a frame rate of {self.frame_rate:g} Hz", hint="give a positive one")
        if self.sample_rate is not None and not 2.0 <= self.sample_rate / self.frame_rate <= MAX_PICTURE_SAMPLES:
            what = f"{self.sample_rate:g} samples a second at {self.frame_rate:g} pictures a second"
            raise BadInput(what, hint=f"give a picture 2 to {MAX_PICTURE_SAMPLES:.0e} samples")
        if not 0.0 <= self.stiffness_margin < 0.1:
            raise BadInput(f"a margin of {self.stiffness_margin:g}", hint="give a fraction below 0.1")


@dataclass(frozen=True)
class SustainedBand:
    """Amplitude of the sustained motion over the drive's frequency.

    Attributes:
        axis: name of the axis.
        drive: frequencies of the drive, increasing, shape (n,) [Hz].
        amplitude: of the motion, shape (n,) [rad].
        drive_per_motion: cycles of the drive in one of the motion: 2 for a parametric drive, 1 for a linear one.
    """

    axis: str
    drive: Array
    amplitude: Array
    drive_per_motion: int

    def amplitude_at(self, motion: float) -> float:
        """Return the amplitude [rad] at a frequency of the motion [Hz]."""
        return float(np.interp(self.drive_per_motion * motion, self.drive, self.amplitude))

    def motion_frequencies_reaching(self, half_angle: float, margin: float) -> FrequencyRange:
        """Return the range of frequencies of the motion [Hz] whose amplitude reaches ``half_angle``.

        Args:
            half_angle: of the field [rad].
            margin: relative change of the stiffness, in both directions, that the range allows for. The band shifts
                with the square root of the stiffness.

        Raises:
            BadInput: no frequency does; the message states the largest amplitude.
        """
        reach = float(self.amplitude.max())
        peak = int(self.amplitude.argmax())
        low, high = (
            _crossing_frequency(self.drive[part][::order], self.amplitude[part][::order], half_angle)
            / self.drive_per_motion
            for part, order in ((slice(0, peak + 1), 1), (slice(peak, None), -1))
        )
        low, high = low * math.sqrt(1.0 + margin), high * math.sqrt(1.0 - margin)
        if reach < half_angle or low > high:
            raise BadInput(
                f"the drive sustains {reach:.4g} rad, the field needs {half_angle:.4g} with a margin of {margin:g}",
                channel=self.axis,
                hint="give a smaller field, more volts or a smaller margin",
            )
        return low, high


def _crossing_frequency(frequency: Array, amplitude: Array, level: float) -> float:
    """Frequency at which an amplitude that increases with the index crosses ``level``; the first if it starts above."""
    return float(np.interp(level, np.maximum.accumulate(amplitude), frequency))


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

    def angles(self, rate: float, phase: str) -> tuple[Array, Array]:
        """Return the angles of one picture, shape (samples per picture,) [rad].

        The figure runs into a corner where both motions reverse at once: n_y phi_x - n_x phi_y = (n_y - n_x) pi/2,
        modulo pi. That is the "worst" phase. The "best" phase, of the finest mesh, is half way to the next worst one.
        It is symmetric, as the pixels are, so lines may share pixels: a phase nearby can fill a few per cent more.

        Args:
            rate: samples per second [Hz].
            phase: one of ``PHASES``.
        """
        n_x, n_y = self.windings
        turn = 2.0 * np.pi * self.frame_rate * np.arange(round(rate / self.frame_rate)) / rate
        phi_x = 0.5 * math.pi * (n_y - n_x + (phase == "best")) / n_y
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


@dataclass(frozen=True)
class ScanCandidate:
    """A figure with its drive and its performance, by ``PHASES`` where it depends on the phase between the axes.

    "best" is the phase at which one picture visits more pixels.

    Attributes:
        figure: the motions.
        drive: frequencies of the drives of x and y [Hz].
        mesh_diameter: as ``LissajousFigure.mesh_diameter`` [px].
        fill: fraction of the pixels that one picture visits.
        gap: diameter of the largest disc that holds no visited pixel, see ``largest_gap`` [px].
        time: after which the required fill is reached [s]; None if one picture does not reach it.
        phases: the phase of ``figure`` with that fill; the samples of the coarser mesh may visit more pixels.
    """

    figure: LissajousFigure
    drive: tuple[float, float]
    mesh_diameter: float
    fill: Mapping[str, float]
    gap: Mapping[str, float]
    time: Mapping[str, float | None]
    phases: Mapping[str, str]

    def fill_reached(self, fill: float) -> str:
        """Return when the fill is reached: "at any phase", "at the best phase" or "no"."""
        reached = sum(self.fill[phase] >= fill for phase in PHASES)
        return ("no", "at the best phase", "at any phase")[reached]


def find_sustained_band(axis: Axis, amplitude: float, offset: float) -> SustainedBand:
    """Return the motion of one axis under ``offset + amplitude sin`` over the drive's frequency.

    Args:
        axis: of the device.
        amplitude, offset: of the drive [V].


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
        return SustainedBand(axis.name, swept, np.abs(linear * amplitude / stiffness), 1)
    tongue = tongue_edges(axis, sine_drive(2.0 * axis.resonance, amplitude, offset))
    if tongue is None:
        delta = stiffness_modulation(axis, sine_drive(2.0 * axis.resonance, amplitude, offset))
        raise BadInput(
            f"{offset:g} V + {amplitude:g} V sin modulate the stiffness by {delta:.2g}, the threshold is "
            f"{threshold(axis):.2g}: nothing oscillates",
            channel=axis.name,
            hint="give more volts",
        )
    # The motion grows from the upper edge of the tongue to lower frequencies, past its lower edge, until it ceases.
    step = (tongue[1] - tongue[0]) / _TONGUE_STEPS
    points: list[tuple[float, float]] = []
    frequency, halvings = tongue[1] - step, 0
    while halvings <= _EDGE_HALVINGS:
        state = steady_state(axis, sine_drive(frequency, amplitude, offset))
        if state is not None:
            points.append((frequency, state[0]))
        if halvings or state is None:
            halvings += 1
            step *= 0.5
        frequency += step if state is None else -step
    if not points:
        raise BadInput("no steady motion was found in the tongue", channel=axis.name, hint="give more volts")
    drive, reached = np.array(sorted(points)).T
    finer = np.linspace(drive[0], drive[-1], 401)
    return SustainedBand(axis.name, finer, PchipInterpolator(drive, reached)(finer), 2)


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


def design(
    device: Device, requirements: ScanRequirements, volts: tuple[float, float]
) -> tuple[dict[str, SustainedBand], list[ScanCandidate]]:
    """Return the sustained bands, and the figures within them that meet the requirements best.

    Figures that reach the fill at any phase come first, then those that reach it at the best phase, then the others.
    Within each group the order is by frame rate, then by the gap at the worst phase.

    Args:
        device: with mechanics and drives.
        requirements: on the scan.
        volts: amplitude and offset of both drives [V].

    Raises:
        BadInput: a drive does not sustain the field, no figure repeats at the frame rate, or none visits a pixel.
    """
    grid = requirements.grid
    bands = {name: find_sustained_band(device.axis(name), *volts) for name in ("x", "y")}
    x = bands["x"].motion_frequencies_reaching(grid.half_angle_x, requirements.stiffness_margin)
    y = bands["y"].motion_frequencies_reaching(grid.half_angle_y, requirements.stiffness_margin)
    figures = [
        LissajousFigure((n_x, n_y), rate, (bands["x"].amplitude_at(n_x * rate), bands["y"].amplitude_at(n_y * rate)))
        for (n_x, n_y), rate in enumerate_figures(x, y, requirements.frame_rate)
    ]
    if not figures:
        raise BadInput(
            f"no pair of motions within {x[0]:.2f} to {x[1]:.2f} Hz and {y[0]:.2f} to {y[1]:.2f} Hz repeats "
            f"{requirements.frame_rate:g} times a second",
            hint="choose a lower frame rate, a smaller field or a smaller margin",
        )
    nearest = sorted(figures, key=lambda figure: (figure.frame_rate, figure.mesh_diameter(grid)))[
        :MAX_EVALUATED_FIGURES
    ]
    evaluated = (_evaluate_figure(figure, bands, requirements) for figure in nearest)
    candidates = [candidate for candidate in evaluated if candidate.fill["worst"] > 0.0]
    if not candidates:
        raise BadInput("the scan visits no pixel", hint="give a larger field, or more samples a second")
    return bands, sorted(candidates, key=lambda candidate: _rank(candidate, requirements.fill))


def _rank(candidate: ScanCandidate, fill: float) -> tuple[float, ...]:
    """Sort key of pairs: those that reach ``fill``, nearest to the frame rate first; of the others the most filled."""
    reached = candidate.fill_reached(fill)
    order = ("at any phase", "at the best phase", "no").index(reached)
    first = -candidate.fill["worst"] if reached == "no" else candidate.figure.frame_rate
    return order, first, candidate.gap["worst"]


def _evaluate_figure(
    figure: LissajousFigure, bands: Mapping[str, SustainedBand], requirements: ScanRequirements
) -> ScanCandidate:
    rate = requirements.sample_rate or figure.path_rate(requirements.grid)
    results = []
    for phase in PHASES:
        x, y = figure.angles(rate, phase)
        visited = map_samples(x, y, x, requirements.grid).coverage > 0
        reached = time_for_fill(x, y, rate, requirements.grid, requirements.fill)
        results.append((float(visited.mean()), largest_gap(visited), reached, phase))
    results.sort(key=lambda result: -result[0])
    fill, gap, time, phases = (dict(zip(PHASES, values, strict=True)) for values in zip(*results, strict=True))
    n_x, n_y = figure.windings
    drive = bands["x"].drive_per_motion * n_x * figure.frame_rate, bands["y"].drive_per_motion * n_y * figure.frame_rate
    return ScanCandidate(figure, drive, figure.mesh_diameter(requirements.grid), fill, gap, time, phases)
