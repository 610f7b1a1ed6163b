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
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from recon.imaging.coverage import largest_gap, time_for_fill
from recon.imaging.gridding import map_samples
from recon.imaging.picture import Grid
from recon.lissajous_figure import PHASES, FrequencyRange, LissajousFigure, enumerate_figures
from scanner.arguments import check_numbers
from scanner.arrays import Array, Mask
from scanner.device import Axis, Device
from scanner.errors import BadInput
from scanner.parametric import sine_drive, steady_state, stiffness_modulation, threshold, tongue_edges
from scanner.stages import Scan

MAX_EVALUATED_FIGURES = 12
"""Figures whose fill is computed, those nearest to the frame rate. It bounds the cost, a second for each."""

MAX_PICTURE_SAMPLES = 5e7
"""Most samples of one picture, which take 4 GB of memory: 10 s at 5 MHz."""

SKIPPING_STARTS = 32
"""Random phases and delays of the first sample at which the fill of samples that skip pixels is computed. The least
fill of four pairs of frequencies, over 400 pixels at 5 MS/s, is 0.44 to 0.56, with 600 of them 0.44 to 0.47."""

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
        check_numbers(frame_rate=self.frame_rate, fill=self.fill, stiffness_margin=self.stiffness_margin)
        if self.sample_rate is not None:
            check_numbers(sample_rate=self.sample_rate)
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
class ScanCandidate:
    """A figure with its drive and its performance, by ``PHASES`` where it depends on the phase between the axes.

    "best" is the phase at which one picture visits the most pixels, "worst" that at which it visits the least. Where
    samples skip pixels, both are those of ``SKIPPING_STARTS`` random phases and delays of the first sample.

    Attributes:
        figure: the motions.
        drive: frequencies of the drives of x and y [Hz].
        mesh_diameter: as ``LissajousFigure.mesh_diameter`` [px].
        fill: fraction of the pixels that one picture visits.
        gap: diameter of the largest disc that holds no visited pixel, see ``largest_gap`` [px].
        time: after which the required fill is reached [s]; None if one picture does not reach it.
        starts: phase and delay of the first sample of ``figure`` with that fill, see ``LissajousFigure.angles``.
    """

    figure: LissajousFigure
    drive: tuple[float, float]
    mesh_diameter: float
    fill: Mapping[str, float]
    gap: Mapping[str, float]
    time: Mapping[str, float | None]
    starts: Mapping[str, tuple[float, float]]

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

    def visited(start: tuple[float, float]) -> Mask:
        x, y = figure.angles(rate, *start)
        return map_samples(x, y, x, requirements.grid).coverage > 0

    starting = _starts(figure.skips_pixels(rate, requirements.grid))
    ranked = sorted(starting, key=lambda start: float(visited(start).mean()))
    starts = {"best": ranked[-1], "worst": ranked[0]}
    pictures = {phase: visited(start) for phase, start in starts.items()}
    fill = {phase: float(picture.mean()) for phase, picture in pictures.items()}
    gap = {phase: largest_gap(picture) for phase, picture in pictures.items()}
    time = {
        phase: time_for_fill(*figure.angles(rate, *start), rate, requirements.grid, requirements.fill)
        for phase, start in starts.items()
    }
    n_x, n_y = figure.windings
    drive = bands["x"].drive_per_motion * n_x * figure.frame_rate, bands["y"].drive_per_motion * n_y * figure.frame_rate
    return ScanCandidate(figure, drive, figure.mesh_diameter(requirements.grid), fill, gap, time, starts)


def _starts(skipping: bool) -> list[tuple[float, float]]:
    """Phases and delays of the first sample at which a figure is evaluated.

    Args:
        skipping: whether samples skip pixels. The fill then depends on the delay too: where the cycles of a picture are
            nearly commensurate with the sample clock, neighbouring cycles visit the same pixels or those in between.
            Phase and delay are then random, those of a scan whose resonances drift.
    """
    if not skipping:
        return [(phase, 0.0) for phase in PHASES.values()]
    return [(phase, delay) for phase, delay in np.random.default_rng(0).random((SKIPPING_STARTS, 2)).tolist()]
