"""Mechanics from swept or transient motion: from angles, and from what lock-in amplifiers recorded."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from estimation.diagnosis.identifiability import DISCRIMINATION_SIGMA
from estimation.identification.agreement import Found, IdentifiedValue, combine_values, contradiction_notes
from estimation.identification.lock_in_sweep import fit_lock_in_sweep
from estimation.identification.sweep import fit_delay, fit_swept
from estimation.identification.swept_record import LockInOutput, SweptRecord
from estimation.lock_in_channels import lock_in_values, recorded_derivatives, reference_turn
from scanner.arrays import Array
from scanner.device import Axis
from scanner.recording import Recording

DELAY_ROUNDS = 2
"""Estimates of a delay, each beside those before: its equation is linear in it to first order."""


class SweptMotion(NamedTuple):
    """Identified values by name, and lines: for the filter of every lock-in amplifier, and on contradictions."""

    values: dict[str, IdentifiedValue]
    notes: list[str]


def fit_swept_motion(axis: Axis, records: Sequence[SweptRecord]) -> SweptMotion:
    """``J``, ``b``, ``k``, ``k_over_J`` and ``b_over_J``; no values if 1/J is not determined, as by one tone.

    The fit to the output of a lock-in amplifier begins with the values of the interpolated angle.

    Args:
        axis: its drive and its capacitance set the torque; its mechanics are not used.
    """
    plain, notes = without_delay(axis, [record for record in records if record.lock_in is None])
    found = [Found(", ".join(each.recording for each in plain), fit_swept(axis, plain))] if plain else []
    for record in records:
        first = fit_swept(axis, [record]) if record.lock_in is not None else {}
        if record.lock_in is None or not first:
            continue
        start = (first["k_over_J"].value, max(first["b_over_J"].value, first["b_over_J"].sd))
        fit = fit_lock_in_sweep(axis, record, record.lock_in, start)
        found.append(Found(record.recording, fit.values))
        notes += [fit.describe()] if fit.values else []
    return SweptMotion(combine_values([each.values for each in found]), notes + contradiction_notes(found))


def without_delay(axis: Axis, records: Sequence[SweptRecord]) -> tuple[Sequence[SweptRecord], list[str]]:
    """The records with the delay of the angle against the drive, and a line on it, where it is significant."""
    delay, total = fit_delay(axis, records) if records else None, 0.0
    if delay is None or abs(delay.value) < DISCRIMINATION_SIGMA * delay.sd:
        return records, []
    delayed = records
    for _ in range(DELAY_ROUNDS):
        total += delay.value
        delayed = [replace(record, delay=total) for record in records]
        delay = fit_delay(axis, delayed) or delay
    note = (
        f"the angle is {'late' if total > 0.0 else 'early'} by {1e6 * abs(total):.3g} µs against the drive (1 sd "
        f"{1e6 * delay.sd:.2g} µs); the fit allows for it; correct the start of a channel"
    )
    return delayed, [note]


def lock_in_output(recording: Recording, axis: Axis) -> LockInOutput:
    """Amplitude and phase of an axis with their reference. Raises as ``reference_turn``."""
    time, values = lock_in_values(recording, axis)
    _, frequency = reference_turn(recording, axis, time)
    order = recorded_derivatives(recording, axis)
    return LockInOutput(time, values, partial(_turn, recording, axis), frequency, order)


def _turn(recording: Recording, axis: Axis, time: Array) -> Array:
    return np.asarray(reference_turn(recording, axis, time)[0])
