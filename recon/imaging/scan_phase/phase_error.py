"""Phase errors that the picture shows of an assumed motion, in slices of the scan."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

from recon.imaging.scan_phase.slow_gain import SlowGain
from scanner.arrays import Array


class PhaseEstimate(NamedTuple):
    """A phase error and its standard error [rad]; (nan, inf) where the samples do not determine it."""

    value: float
    sd: float


class PhaseErrorParts(NamedTuple):
    """Phase errors of equal parts of a slice, against the picture that all slices share.

    Attributes:
        time: middle of each part, from the first sample on, shape (PARTS_PER_SLICE,) [s].
        value, sd: of x and y, shape (PARTS_PER_SLICE, 2) [rad]; (nan, inf) where the samples determine none.
    """

    time: Array
    value: Array
    sd: Array


@dataclass(frozen=True)
class PhaseError:
    """True phase minus assumed phase in one time slice.

    Attributes:
        time: middle of the slice since the first sample [s].
        x, y: value and standard error of each axis [rad].
        parts: the same of short parts of the slice; None where they were not measured.
        gain: slow gain of all slices that share the picture; None where it was not measured.
        shift_factor: of x and y, on the standard errors, for a shift that all these slices have in common.
    """

    time: float
    x: PhaseEstimate
    y: PhaseEstimate
    parts: PhaseErrorParts | None = None
    gain: SlowGain | None = None
    shift_factor: tuple[float, float] = (1.0, 1.0)

    def with_common_shift(self) -> PhaseError:
        """The phase error with standard errors that allow for the shift."""
        x, y = (
            each._replace(sd=each.sd * factor) for each, factor in zip((self.x, self.y), self.shift_factor, strict=True)
        )
        parts = self.parts and self.parts._replace(sd=self.parts.sd * self.shift_factor)
        return replace(self, x=x, y=y, parts=parts, shift_factor=(1.0, 1.0))
