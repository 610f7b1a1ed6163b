"""The report of ``identify``: every identified constant with its nominal value."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from recon.report.conclusions import conclude_identification
from recon.report.numbers import format_interval, format_value
from recon.report.page import Section, Table, render
from scanner.device import Device


def identification_report(summary: Mapping[str, Any], nominal: Device, names: Sequence[str]) -> str:
    """The page.

    Args:
        summary: content of summary.json.
        nominal: the device before.
        names: of the recordings.
    """
    sections = []
    for axis, result in summary["axes"].items():
        rows = [
            [
                name,
                format_interval(value["value"], value["ci95"][0], value["ci95"][1], value["unit"]),
                f"{format_value(value['ci95'][0], 6)} to {format_value(value['ci95'][1], 6)}",
                *_compare_with_nominal(value["value"], nominal_value(nominal, axis, name)),
            ]
            for name, value in result["values"].items()
        ]
        table = Table(["constant", "measured ± standard deviation", "95 % interval", "nominal", "change"], rows)
        sections.append(Section(f"Axis {axis}", "; ".join(result["used"]), table))
    subject = f"{nominal.name}, from {', '.join(names)}."
    return render("Identification", conclude_identification(summary), sections, summary["notes"], subject)


def nominal_value(device: Device, axis: str, name: str) -> float | None:
    """The nominal value of a constant, or of a ratio such as ``k_over_J``; None if the device states none."""
    nominal = device.axis(axis)
    for part in (nominal.mechanics, nominal.capacitance, nominal.readout):
        if part is not None and name in part.__dataclass_fields__:
            value = getattr(part, name)
            return None if value is None else float(value)
    if nominal.mechanics is not None and name.endswith("_over_J"):
        return float(getattr(nominal.mechanics, name[0]) / nominal.mechanics.J)
    return None


def _compare_with_nominal(measured: float, nominal: float | None) -> list[str]:
    """The nominal value, and the relative change of the measured one."""
    if nominal is None:
        return ["not stated", ""]
    change = "" if nominal == 0.0 else f"{100.0 * (measured / nominal - 1.0):+.2g} %".replace("-", "−")
    return [format_value(nominal, 6), change]
