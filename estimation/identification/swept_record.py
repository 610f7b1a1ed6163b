"""Driven motion of any frequency and amplitude, with what a lock-in amplifier recorded of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from estimation.identification.fits import DrivenRecord
from estimation.reference import PhaseReference
from scanner.arrays import Array, Complex


@dataclass(frozen=True)
class LockInOutput:
    """Amplitude and phase of a motion behind a lock-in amplifier.

    Attributes:
        time: shape (m,) [s].
        values: amplitude exp(i phase), shape (m,) [rad].
        turn: phase of the reference at given times [rad].
        frequency: mean frequency of the reference [Hz].
        order: time derivatives of the angle that were recorded, converted to ``values`` at ``frequency``.
    """

    time: Array
    values: Complex
    turn: Callable[[Array], Array]
    frequency: float
    order: int = 0


@dataclass(frozen=True)
class SweptRecord:
    """Driven motion of any frequency and amplitude.

    Attributes:
        driven: angle and drive voltage.
        time: of its samples, shape (n,) [s].
        reference: phase of the motion's drive.
        lock_in: what a lock-in amplifier recorded, where the angle is interpolated from that.
        recording: its name.
        delay: of the angle against the drive [s].
    """

    driven: DrivenRecord
    time: Array
    reference: PhaseReference
    lock_in: LockInOutput | None = None
    recording: str = ""
    delay: float = 0.0


def has_one_frequency(record: SweptRecord) -> bool:
    """Whether the phase of the reference stays within half a turn of that of a constant frequency."""
    psi = record.reference.phase(record.time)
    return bool(np.ptp(psi - np.linspace(psi[0], psi[-1], psi.size)) < np.pi)
