"""Motion: what every estimator returns and every reconstruction takes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class AngleTrack:
    """Mechanical angle on a uniform clock.

    Attributes:
        values: angle, shape (n,) [rad].
        sample_rate: [Hz].
        start: time of the first sample on the recording's clock [s].
    """

    values: Array
    sample_rate: float
    start: float = 0.0

    @property
    def size(self) -> int:
        """Number of samples."""
        return self.values.size

    def read(self, first: int = 0, stop: int | None = None) -> Array:
        """Angles of samples ``first`` up to ``stop``, shape (n,) [rad]; what a long recording is gone through by."""
        return self.values[first:stop]

    def turned(self) -> AngleTrack:
        """The same motion with the other sign."""
        return replace(self, values=-self.values)


@dataclass(frozen=True)
class AxisMotion:
    """Phase and amplitude of one axis on a slow clock, and its angle at the intensity's samples.

    Attributes:
        time: shape (n,) [s], increasing.
        phase: shape (n,) [rad], unwrapped; of theta = A sin(reference + phase), where the reference is half the
            drive's phase for a parametric (electrostatic) drive, the drive's phase for a linear one, and
            ``2 pi f0 t`` with the device's resonance f0 where no drive was recorded.
        amplitude: shape (n,) [rad].
        frequency: shape (n,), of the motion [Hz].
        phase_sd: shape (n,), standard deviation of ``phase`` [rad].
        angle: the angle at the intensity's samples.
        reference: ``"half-drive"``, ``"drive"`` or ``"absolute"``.
        sign: ``"known: <how>"`` or ``"ambiguous"``; an even capacitance fixes the phase modulo pi only.
    """

    time: Array
    phase: Array
    amplitude: Array
    frequency: Array
    phase_sd: Array
    angle: AngleTrack
    reference: str = "half-drive"
    sign: str = "ambiguous"

    def turned(self) -> AxisMotion:
        """The same motion with the other sign."""
        return replace(self, phase=self.phase + np.pi, angle=self.angle.turned())


@dataclass(frozen=True)
class Motion:
    """Motion of all axes.

    Attributes:
        axes: ``"x"`` and, for two axes, ``"y"``.
        estimator: name of the estimator that made it.
        info: further facts worth reporting (tuned noise, log-likelihood, ...), JSON-serialisable.
        notes: what a reader has to know, a line each.
    """

    axes: Mapping[str, AxisMotion]
    estimator: str
    info: Mapping[str, object] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
