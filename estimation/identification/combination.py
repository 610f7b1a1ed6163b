"""Combination of the mechanics of one axis from several recordings: decays among themselves, and with driven motion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from estimation.diagnosis.identifiability import DISCRIMINATION_SIGMA
from estimation.identification.agreement import (
    Differences,
    Found,
    IdentifiedValue,
    combine_values,
    scaled_by_inertia,
    weighted_mean,
    widen,
)
from estimation.identification.fits import fit_ringdown
from estimation.slow.response import ResponseFit
from scanner.arrays import Array
from scanner.device import Axis


class Decay(NamedTuple):
    """Free decay of one recording.

    Attributes:
        recording: its name.
        angle: shape (n,) [rad].
        rate: of the samples [Hz].
        volt: voltage on the combs [V].
    """

    recording: str
    angle: Array
    rate: float
    volt: float


def values_of_mode(fit: ResponseFit) -> dict[str, IdentifiedValue]:
    """k/J and b/J from the first mode of a frequency response."""
    (frequency, quality), (frequency_sd, quality_sd) = fit.modes[0], fit.mode_sd[0]
    rate, floor = 2.0 * np.pi * float(frequency), np.finfo(float).tiny
    relative = float(np.hypot(frequency_sd / frequency, quality_sd / quality))
    return {
        "k_over_J": IdentifiedValue(rate**2, max(2.0 * rate**2 * float(frequency_sd / frequency), floor)),
        "b_over_J": IdentifiedValue(rate / float(quality), max(rate / float(quality) * relative, floor)),
    }


def fit_decays(axis: Axis, decays: Sequence[Decay]) -> list[Found]:
    """k/J, b/J and, under a bias, J of every free decay."""
    return [Found(each.recording, fit_ringdown(each.angle, each.rate, axis, each.volt)[0]) for each in decays]


def mechanics_from_decays(axis: Axis, fits: Sequence[Found]) -> dict[str, IdentifiedValue]:
    """Mechanics from fits of free decays; J is the nominal one where no bias determines it."""
    found = combine_values([each.values for each in fits])
    J = found.setdefault("J", IdentifiedValue(axis.require_mechanics().J, 0.0))
    return found | {key: scaled_by_inertia(found[f"{key}_over_J"], J) for key in ("k", "b")}


def average_ratios(
    decay: Mapping[str, IdentifiedValue], driven: Mapping[str, IdentifiedValue]
) -> tuple[dict[str, IdentifiedValue], dict[str, float], list[str]]:
    """Average the ratios of free decays with those of driven motion; k and b follow from them and the driven J.

    Where the two differ by more than their noise, as by a drift between the recordings or a stiffness that depends
    on the amplitude, the interval is widened until it contains the difference.

    Args:
        decay: ``k_over_J``, ``b_over_J`` or both. driven: ``J`` and the same ratios.

    Returns:
        the averages with k and b, the weight of driven motion in every ratio, and notes on differences.
    """
    values, weights, notes = {}, {}, []
    for key, free in decay.items():
        mean = weighted_mean([free, driven[key]])
        difference, sd = free.value - driven[key].value, float(np.hypot(free.sd, driven[key].sd))
        values[key] = widen([mean], Differences(np.array([difference]), np.array([sd])))[0]
        values[key[0]] = scaled_by_inertia(values[key], driven["J"])
        weights[key] = (mean.sd / driven[key].sd) ** 2
        if abs(difference) > DISCRIMINATION_SIGMA * sd:
            notes.append(
                f"free decay and driven motion differ in {key[0]}/J by {abs(difference) / sd:.3g} standard deviations "
                f"({difference / driven[key].value:+.2%}): the device changed between them, or its law is not linear; "
                "`lissajous diagnose` of the driven motion names such a law"
            )
    return values, weights, notes


def conflict_notes(found: Sequence[Mapping[str, IdentifiedValue]]) -> list[str]:
    """One note if a motion contradicts the linear law that all fits of the mechanics assume, else none.

    Args:
        found: values by name, of decays and of driven motion, before they are averaged.
    """
    conflict = max((value.conflict for each in found for value in each.values()), default=0.0)
    if conflict <= DISCRIMINATION_SIGMA:
        return []
    return [
        f"the law of the device is not linear, or the device changed during the recording: with a stiffness and a "
        f"damping that depend on the amplitude, the constants differ by {conflict:.3g} standard deviations; their "
        "intervals contain the difference; `lissajous diagnose` names such a law"
    ]


def axis_with_values(axis: Axis, values: Mapping[str, IdentifiedValue]) -> Axis:
    """The axis with the identified values, whose relative standard deviations are its tolerances."""
    tolerance = dict(axis.tolerance)
    for stage in ("mechanics", "capacitance", "readout"):
        part = getattr(axis, stage)
        keys = [key for key in values if key in getattr(type(part), "__dataclass_fields__", {})]
        if keys:
            axis = replace(axis, **{stage: replace(part, **{key: values[key].value for key in keys})})
        tolerance |= {key: abs(values[key].sd / values[key].value) for key in keys if values[key].value}
    return replace(axis, tolerance=tolerance)
