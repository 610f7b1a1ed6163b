"""Optics effects that are found beside those of the same name that a device states.

A picture is diagnosed after the correction for the stated terms, so that what it shows is the remainder.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from estimation.diagnosis.finding import Finding
from scanner.device import Device
from scanner.terms import Parameter, catalogue

Values = Mapping[str, float]
"""Parameters of a term by name."""


def with_remainders(device: Device, found: Mapping[str, Mapping[str, Values]]) -> Device:
    """Return the device with the effects that were found, added to those that it states.

    Args:
        device: with which the recording was corrected.
        found: axis -> effect -> parameter -> value, of what is left after the correction.
    """
    terms = {
        axis: {name: _total(name, device.axis(axis).terms.get(name), values) for name, values in effects.items()}
        for axis, effects in found.items()
    }
    return device.with_terms(terms)


def describe_total(finding: Finding, device: Device, improved: Device) -> Finding:
    """Return the finding with the stated and the total value of its term, if ``device`` states that.

    Args:
        finding: of the remainder.
        device: with which the recording was corrected.
        improved: as :func:`with_remainders` returns it.
    """
    stated, total = (each.axis(finding.axis).terms.get(finding.effect) for each in (device, improved))
    if not finding.parameters or stated is None or total is None or stated == total:
        return finding
    name, unit = finding.parameters[0].name, finding.parameters[0].unit
    where = f"{finding.where}; this is beside the stated {name} = {stated[name]:.6g} {unit}, and the device takes the "
    return replace(finding, where=f"{where}total, {total[name]:.4g} {unit}")


def _total(effect: str, stated: Values | None, found: Values) -> Values:
    """Parameters of a term that causes the stated and the found effect together, to first order in both.

    A term has one channel: one that was found on another than the stated replaces it.
    """
    if stated is None or stated.get("variant", 0) != found.get("variant", 0):
        return found
    size = catalogue()[effect].parameters[0]
    return {**found, **stated, size.name: _sum(size, stated[size.name], found[size.name])}


def _sum(parameter: Parameter, first: float, second: float) -> float:
    """Size of two equal effects together: rates and time constants of an ``inverse`` parameter add as reciprocals."""
    return 1.0 / (1.0 / first + 1.0 / second) if parameter.kind == "inverse" else first + second
