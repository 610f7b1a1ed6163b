"""Terms with values: those that a device file states for an axis, and what they do to its constants."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from typing import Any

from scanner.device import Axis, Device
from scanner.device_toml import INDEX, checked_number
from scanner.errors import BadInput, DeviceInvalid
from scanner.integrator.abi import MAX_TERMS_PER_STAGE
from scanner.stages import Amdm
from scanner.terms import STAGES, Term, catalogue
from scanner.terms.driven_modes import EFFECT as DRIVEN_MODES
from scanner.terms.driven_modes import driven_modes
from scanner.terms.measured_law import EFFECT as MEASURED_LAW
from scanner.terms.measured_law import measured_law


@dataclass(frozen=True)
class ActiveTerm:
    """A term with the values of its parameters, acting on one axis.

    Attributes:
        term: the physics.
        values: of its parameters, in the term's order [SI].
        channel: which of ``term.channels`` its output law acts on.
        hidden_state: its hidden states at the start.
    """

    term: Term
    values: tuple[float, ...]
    channel: str = "sense"
    hidden_state: tuple[float, float] = (0.0, 0.0)


def stated_terms(axis: Axis) -> tuple[ActiveTerm, ...]:
    """Return the terms that a device file states for an axis under ``[x.terms.<effect>]``.

    Raises:
        BadInput: the catalogue has no such effect, or a value of it is missing or cannot be used.
        DeviceInvalid: more terms of one stage than the integrator takes.
    """
    known, others = catalogue(), axis.extra.get("terms", {})
    stated = tuple(
        active
        for effect, values in axis.terms.items()
        for active in _stated_term(axis, effect, {**others.get(effect, {}), **values}, known)
    )
    _check_number_of_terms(axis, "torque", [each.term for each in stated if each.term.torque])
    _check_number_of_terms(axis, "capacitance", [each.term for each in stated if each.term.capacitance])
    return stated


def _check_number_of_terms(axis: Axis, quantity: str, terms: Sequence[Term]) -> None:
    """Check that the integrator takes as many terms that change a quantity. Raises DeviceInvalid."""
    if len(terms) > MAX_TERMS_PER_STAGE:
        what = f"states {len(terms)} effects on the {quantity}, and at most {MAX_TERMS_PER_STAGE} can act on one axis"
        hint = f"keep the largest of {', '.join(term.effect for term in terms)}"
        raise DeviceInvalid(what, file=axis.source, channel=f"{axis.name}.terms", hint=hint)


def _stated_term(axis: Axis, effect: str, values: dict[str, Any], known: dict[str, Term]) -> list[ActiveTerm]:
    """The term that a table states; once for each channel where it acts on several."""
    key = f"{axis.name}.terms.{effect}"
    if effect not in (MEASURED_LAW, DRIVEN_MODES, *known):
        near = get_close_matches(effect, known) or known
        hint = f"known effects: {', '.join(near)}; a term file of your own is given with --terms"
        raise BadInput("is not an effect of the catalogue", file=axis.source, channel=key, hint=hint)
    try:
        if effect == DRIVEN_MODES:
            return [ActiveTerm(*law) for law in driven_modes(values, axis)]
        if effect == MEASURED_LAW:
            law, packed = measured_law(values)
            return [ActiveTerm(law, packed, law.channels[0])]
        return [_catalogue_term(known[effect], values)]
    except DeviceInvalid as error:
        key = ".".join(part for part in (key, error.channel) if part)
        raise DeviceInvalid(error.what, file=axis.source, channel=key, hint=error.hint) from None


def _catalogue_term(term: Term, values: Mapping[str, Any]) -> ActiveTerm:
    """The term of the catalogue with the values of a table.

    Raises:
        DeviceInvalid: a value is missing or does not satisfy the condition of its parameter.
    """
    if missing := [p.name for p in term.parameters if p.name not in values]:
        hint = f"{term.effect} needs {', '.join(p.name for p in term.parameters)}"
        raise DeviceInvalid(f"lacks {missing[0]}", hint=hint)
    channels = ", ".join(f"{index}: {name}" for index, name in enumerate(term.variants))
    variant = int(checked_number(values.get("variant", 0), INDEX["must"], "variant", f"known are {channels}"))
    if variant >= len(term.variants):
        raise DeviceInvalid(f"is {variant}, which is unknown", channel="variant", hint=f"known are {channels}")
    channel = term.variants[variant]
    hint = f"remove the term if it has no effect; its law is {term.equation}"
    checked = tuple(checked_number(values[p.name], p.condition(channel), p.name, hint) for p in term.parameters)
    return ActiveTerm(term, checked, channel)


def check_effects(device: Device) -> None:
    """Check that every stated term has something to act on.

    Raises:
        BadInput: as :func:`stated_terms`.
        DeviceInvalid: a law of a stage that the axis lacks, or of the motion of another axis where there is one axis.
    """
    for name in device.axes:
        axis = device.sensed_axis(name)
        for active in stated_terms(axis):
            if (lacking := _missing_object(active, axis, len(device.axes))) is not None:
                key, hint = f"{name}.terms.{active.term.effect}", "remove the term, or state what it acts on"
                raise DeviceInvalid(f"has no effect {lacking}", file=axis.source, channel=key, hint=hint)


def _missing_object(active: ActiveTerm, axis: Axis, axes: int) -> str | None:
    """What a term acts on and a device lacks, as the end of a sentence; None if it lacks nothing."""
    term = active.term
    if term.coupled and axes == 1:
        return "in a device with one axis"
    if term.capacitance is not None and axis.capacitance is None:
        return "without a capacitance"
    before_demodulation = term.pre_demodulation is not None and not isinstance(axis.readout, Amdm)
    if before_demodulation or (term.constants is not None and _keeps_constants(active, axis)):
        return f"on a {axis.readout.kind} readout" if axis.readout else "without a readout"
    return None


def _keeps_constants(active: ActiveTerm, axis: Axis) -> bool:
    """Whether a law leaves all constants of an axis as they are, with its own values and with others."""
    others = replace(active, values=tuple(2.0 * value + 1.0 for value in active.values))
    return all(with_constants(axis, [each]) == axis for each in (active, others))


def place_in_signal_path(active: ActiveTerm) -> tuple[int, bool]:
    """Return the sorting key of a term by the order in which a signal passes laws: by stage, low-pass sections first.

    The sections of a readout belong to its own electronics, as those that ``lpf_hz`` states; other laws of a channel
    act on their output. Terms with equal keys act in the order in which the device states them.
    """
    return STAGES.index(active.term.stage), active.term.corners is None


def in_signal_order(terms: Iterable[ActiveTerm]) -> list[ActiveTerm]:
    """Return terms in the order in which a signal passes them, see :func:`place_in_signal_path`."""
    return sorted(terms, key=place_in_signal_path)


def with_constants(axis: Axis, terms: Iterable[ActiveTerm]) -> Axis:
    """Return the axis with the constants that its terms change."""
    for active in terms:
        if active.term.constants is not None:
            axis = active.term.constants(axis, active.values)
    return axis
