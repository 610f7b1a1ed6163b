"""The report of ``identify``: the constants with their nominal values, and frequency responses with their fit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from estimation.slow.response import Response, ResponseFit
from recon.report.conclusions import conclude_identification
from recon.report.figures import figure_uri, new_figure
from recon.report.numbers import format_interval, format_range, format_uncertain, format_value
from recon.report.page import Figure, Section, Table, render
from scanner.device import Device

LABELS = {
    "J": "moment of inertia J",
    "b": "damping b",
    "k": "stiffness k",
    "k_over_J": "k / J, square of the resonance's angular frequency",
    "b_over_J": "b / J, rate of the damping",
    "C0": "capacitance C0",
    "theta0": "width θ0 of the capacitance",
    "theta_th": "angle θ_th of the largest capacitance",
    "a_cir": "gain a_cir of the readout",
    "b_cir": "offset b_cir of the readout",
    "noise_var": "variance of the readout's noise",
    "noise_sd": "standard deviation of the readout's noise",
    "delay": "delay of the readout",
    "amplitude_over_theta0": "amplitude / θ0",
}
"""Names of the constants for readers, by their key in summary.json."""


def identification_report(
    summary: Mapping[str, Any],
    nominal: Device,
    names: Sequence[str],
    responses: Mapping[str, Sequence[tuple[Response, ResponseFit]]],
) -> str:
    """The page.

    Args:
        summary: content of summary.json.
        nominal: the device before.
        names: of the recordings.
        responses: by axis frequency responses, each with its fit.
    """
    sections = []
    for axis, result in summary["axes"].items():
        rows = [
            [
                LABELS.get(name, name),
                format_interval(value["value"], value["ci95"][0], value["ci95"][1], value["unit"]),
                format_range(*value["ci95"]),
                *_compare_with_nominal(value["value"], nominal_value(nominal, axis, name)),
            ]
            for name, value in result["values"].items()
        ]
        table = Table(["constant", "measured ± standard deviation", "95 % interval", "nominal", "change"], rows)
        figures = [response_figure(*each) for each in responses[axis]]
        sections.append(Section(f"Axis {axis}", "; ".join(result["used"]), table, figures, least="26rem"))
    subject = f"{nominal.name}, from {', '.join(names)}."
    return render("Identification", conclude_identification(summary), sections, summary["notes"], subject)


def response_figure(response: Response, fit: ResponseFit) -> Figure:
    """Amplitude and phase of a frequency response against frequency, measured and fitted."""
    drawing, axes = new_figure(2, 1, (6.0, 4.2))
    top, bottom = axes[:, 0]
    for values, style, label in ((response.values, ".", "measured"), (fit.predicted, "-", "fit at the same tones")):
        top.plot(response.frequency, np.abs(values), style, label=label)
        bottom.plot(response.frequency, np.degrees(np.unwrap(np.angle(values))), style)
    top.set(ylabel=f"amplitude ({'rad' if response.in_rad else 'V'})")
    top.legend(frameon=False)
    bottom.set(xlabel="frequency (Hz)", ylabel="phase (°)")
    (frequency, quality), (frequency_sd, quality_sd) = fit.modes[0], fit.mode_sd[0]
    effects = f"; fitted with {' and '.join(fit.effects)}" if fit.effects else ""
    caption = f"resonance {format_uncertain(frequency, frequency_sd, 'Hz')}, Q {format_uncertain(quality, quality_sd)}"
    return Figure(figure_uri(drawing), f"frequency response of {response.name}: {caption}{effects}")


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
    return [format_value(nominal), change]
