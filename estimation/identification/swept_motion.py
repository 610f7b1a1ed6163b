"""Mechanics from swept or transient motion: from angles, and from what lock-in amplifiers recorded."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from estimation.identification.agreement import Found, IdentifiedValue, combine_values, contradiction_notes
from estimation.identification.lock_in_sweep import fit_lock_in_sweep
from estimation.identification.sweep import LockInOutput, SweptRecord, fit_swept
from estimation.lock_in_channels import lock_in_values, recorded_derivatives, reference_turn
from scanner.arrays import Array
from scanner.device import Axis
from scanner.recording import Recording


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
    plain = [record for record in records if record.lock_in is None]
    found, notes = [Found(", ".join(each.recording for each in plain), fit_swept(axis, plain))] if plain else [], []
    for record in records:
        first = fit_swept(axis, [record]) if record.lock_in is not None else {}
        if record.lock_in is None or not first:
            continue
        start = (first["k_over_J"].value, max(first["b_over_J"].value, first["b_over_J"].sd))
        fit = fit_lock_in_sweep(axis, record, record.lock_in, start)
        found.append(Found(record.recording, fit.values))
        notes += [fit.describe()] if fit.values else []
    return SweptMotion(combine_values([each.values for each in found]), notes + contradiction_notes(found))


def lock_in_output(recording: Recording, axis: Axis) -> LockInOutput:
    """Amplitude and phase of an axis with their reference. Raises as ``reference_turn``."""
    time, values = lock_in_values(recording, axis)
    _, frequency = reference_turn(recording, axis, time)
    order = recorded_derivatives(recording, axis)
    return LockInOutput(time, values, partial(_turn, recording, axis), frequency, order)


def _turn(recording: Recording, axis: Axis, time: Array) -> Array:
    return np.asarray(reference_turn(recording, axis, time)[0])
