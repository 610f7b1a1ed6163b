"""Terms with values: those that a device file states for an axis, and what they do to its constants."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any

from scanner.device import Axis
from scanner.errors import BadInput, DeviceInvalid
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
        BadInput: the catalogue has no such effect, or the file lacks one of its parameters.
    """
    known = catalogue()
    return tuple(
        active for effect, values in axis.terms.items() for active in _stated_term(axis, effect, dict(values), known)
    )


def _stated_term(axis: Axis, effect: str, values: dict[str, Any], known: dict[str, Term]) -> list[ActiveTerm]:
    """The term that a table states; once for each channel where it acts on several."""
    key = f"{axis.name}.terms.{effect}"
    if effect in (MEASURED_LAW, DRIVEN_MODES):
        try:
            if effect == DRIVEN_MODES:
                return [ActiveTerm(*law) for law in driven_modes(values, axis)]
            law, packed = measured_law(values)
        except DeviceInvalid as error:
            raise DeviceInvalid(error.what, file=axis.source, channel=key, hint=error.hint) from None
        return [ActiveTerm(law, packed, law.channels[0])]
    if effect not in known:
        near = get_close_matches(effect, known) or known
        hint = f"known effects: {', '.join(near)}; a term file of your own is given with --terms"
        raise BadInput("is not an effect of the catalogue", file=axis.source, channel=key, hint=hint)
    term = known[effect]
    if missing := [p.name for p in term.parameters if p.name not in values]:
        hint = f"{effect} needs {', '.join(p.name for p in term.parameters)}"
        raise BadInput(f"lacks {missing[0]}", file=axis.source, channel=key, hint=hint)
    variant = int(values.get("variant", 0))
    if not 0 <= variant < len(term.variants):
        raise BadInput(f"variant {variant} is unknown", file=axis.source, channel=key, hint="count from 0")
    return [ActiveTerm(term, tuple(values[p.name] for p in term.parameters), term.variants[variant])]


def in_stage_order(terms: Iterable[ActiveTerm]) -> list[ActiveTerm]:
    """Return terms in the order of their stages, which is the order in which a signal passes them."""
    return sorted(terms, key=lambda active: STAGES.index(active.term.stage))


def with_constants(axis: Axis, terms: Iterable[ActiveTerm]) -> Axis:
    """Return the axis with the constants that its terms change."""
    for active in terms:
        if active.term.constants is not None:
            axis = active.term.constants(axis, active.values)
    return axis
