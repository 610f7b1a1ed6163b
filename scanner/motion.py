"""Motion: the result of every estimator and the input of every reconstruction."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from scanner.angle_tracks import AngleTrack
from scanner.arrays import Array

if TYPE_CHECKING:
    import xarray


UNKNOWN_PHASE_SD_RAD = float(np.pi / np.sqrt(3.0))
"""Standard deviation of a phase of which nothing is known: the largest that an estimator states."""


def typical_amplitude(amplitude: Array) -> float:
    """Return the mean amplitude in which each time counts by its amplitude, in the unit of ``amplitude``, shape (n,).

    It is that of the swinging mirror also where the recording contains the rest before its start.
    """
    size = float(np.sum(amplitude))
    return float(np.sum(amplitude * (amplitude / size))) if size > 0.0 else 0.0


def in_proportion_to_amplitude(phase: Array, amplitude: Array) -> Array:
    """Return phase errors times the amplitude over :func:`typical_amplitude`, shape (n,) [rad].

    An error of the phase displaces a sample in proportion to the amplitude. Where the mirror nearly rests its phase is
    not known, and displaces nothing. Errors of a steady motion are returned as they are.

    Args:
        phase: errors of the phase or their standard deviations, shape (n,) [rad].
        amplitude: shape (n,), in any unit.
    """
    typical = typical_amplitude(amplitude)
    return phase * (amplitude / typical) if typical > 0.0 else phase


def rms_phase(phase: Array, amplitude: Array) -> float:
    """Return the root mean square of phase errors, weighted with the squared amplitude [rad].

    Args as for :func:`in_proportion_to_amplitude`, for the same reason.
    """
    weight = in_proportion_to_amplitude(np.ones_like(phase), amplitude)
    return float(np.sqrt(np.sum((weight * phase) ** 2) / np.sum(weight**2)))


@dataclass(frozen=True)
class AxisMotion:
    """Phase and amplitude of one axis on a slow clock, and its angle at the intensity's samples.

    Attributes:
        time: shape (n,) [s], increasing.
        phase: shape (n,) [rad], unwrapped; of theta = A sin(reference + phase), where the reference is half the
            drive's phase for a parametric (electrostatic) drive, the drive's phase for a linear one, and
            ``2 pi f t`` with f = ``reference_frequency`` where no drive was recorded, an arbitrary one that makes
            blocks of time where the motion repeats at no known frequency.
        amplitude: shape (n,) [rad].
        frequency: shape (n,), of the motion [Hz].
        phase_sd: shape (n,), standard deviation of ``phase`` [rad].
        angle: the angle at the intensity's samples.
        reference: ``"half-drive"``, ``"drive"``, ``"absolute"``, or ``"blocks"`` if the frequency is not determined.
        sign: ``"known: <how>"`` or ``"ambiguous"``; an even capacitance fixes the phase modulo pi only.
        amplitude_sd: shape (n,), standard deviation of ``amplitude`` by the noise, without the calibration's [rad];
            None from an estimator that states none.
        angle_noise_sd: standard deviation of the white noise in single samples of ``angle`` [rad]; 0 where the
            estimator filters the noise, whose rest ``phase_sd`` and ``amplitude_sd`` state.
        reference_frequency: of the reference at its start [Hz].
    """

    time: Array
    phase: Array
    amplitude: Array
    frequency: Array
    phase_sd: Array
    angle: AngleTrack
    reference: str = "half-drive"
    sign: str = "ambiguous"
    amplitude_sd: Array | None = None
    angle_noise_sd: float = 0.0
    reference_frequency: float | None = None

    @property
    def known(self) -> NDArray[np.bool_]:
        """Whether a phase is known at each time, shape (n,); all where none is, as in noise alone."""
        known = np.asarray(self.phase_sd < UNKNOWN_PHASE_SD_RAD)
        return known if known.any() else np.ones_like(known)

    def __repr__(self) -> str:
        sd = np.degrees(rms_phase(self.phase_sd[self.known], self.amplitude[self.known]))
        return (
            f"{np.median(self.frequency):.6g} Hz, amplitude {np.median(self.amplitude):.4g} rad, "
            f"phase sd {sd:.3g}° rms, {self.time.size} times, sign {self.sign}"
        )

    def negated(self) -> AxisMotion:
        """Return the same motion with the opposite sign."""
        return replace(self, phase=self.phase + np.pi, angle=self.angle.negated())

    def advanced(self, phase: Array) -> AxisMotion:
        """Return the motion whose phase is ahead by ``phase`` at ``time``, shape (n,), n > 1 [rad]."""
        ahead = self.angle.advanced(self.time, phase, self.frequency)
        frequency = self.frequency + np.gradient(phase, self.time) / (2.0 * np.pi)
        return replace(self, phase=self.phase + phase, frequency=frequency, angle=ahead)


@dataclass(frozen=True)
class Motion:
    """Motion of all axes.

    Attributes:
        axes: ``"x"`` and, for two axes, ``"y"``.
        estimator: name of the estimator that made it.
        info: further facts worth reporting (tuned noise, log-likelihood, ...), JSON-serialisable.
        notes: what a reader has to know, a line each.
        ends: from which the estimator continues in the next segment of the recording, by sense channel.
    """

    axes: Mapping[str, AxisMotion]
    estimator: str
    info: Mapping[str, object] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    ends: Mapping[str, object] = field(default_factory=dict)

    def to_xarray(self) -> xarray.Dataset:
        """Return phase, amplitude, frequency and their clocks as an xarray dataset: ``phase_x`` over ``time_x``, ….

        Angles are mechanical. ``angle`` of an axis, which has millions of samples, is not part of it.

        Raises:
            BadInput: xarray is not installed.
        """
        from scanner.extras import import_extra

        units = {"phase": "rad", "amplitude": "rad", "frequency": "Hz", "phase_sd": "rad"}
        variables, coordinates = {}, {}
        for name, axis in self.axes.items():
            time = f"time_{name}"
            coordinates[time] = (time, axis.time, {"units": "s"})
            for key, unit in units.items():
                attributes = {"units": unit, "reference": axis.reference, "sign": axis.sign}
                variables[f"{key}_{name}"] = (time, getattr(axis, key), attributes)
        attributes = {"estimator": self.estimator}
        dataset: xarray.Dataset = import_extra("xarray", "xarray").Dataset(variables, coordinates, attributes)
        return dataset

    def __repr__(self) -> str:
        lines = [f"Motion by {self.estimator!r}", *(f"  {name}: {axis!r}" for name, axis in self.axes.items())]
        return "\n".join([*lines, *(f"  note: {note}" for note in self.notes)])
