"""Law of a fitted discrepancy term: a curve with its band, and a table for a device."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from estimation.candidate_terms.discrepancy import (
    FORCE_DEGREE,
    FORCE_POWERS,
    GAIN_COSINES,
    MAPPING_KNOTS,
    PLAY_HALF_WIDTHS,
    PROFILE_POWERS,
    apply_play,
)
from estimation.device_fit.fit import Fit
from scanner.arrays import Array
from scanner.terms import NaturalScales


class Section(NamedTuple):
    """A line through the variables of a discrepancy term, along which its law can be drawn.

    Attributes:
        columns: by parameter, the contribution to the law of one unit of it, shape of ``grid``. Parameters without a
            contribution along this line are not listed.
        label, unit: quantity that the law changes, and its unit.
        grid: values of the variable on the horizontal axis, shape (n,).
        x_label: name and unit of that variable.
    """

    columns: dict[str, Array]
    label: str
    unit: str
    grid: Array
    x_label: str


def correction_curve(fit: Fit) -> dict[str, Any]:
    """Curve of the last term of a fit, a discrepancy term, with its band of one standard deviation.

    It is drawn along the section on which the law is largest relative to its possible contributions.

    Returns:
        the content of ``curve`` in diagnosis.json: labels, units and points.
    """
    candidate = fit.model.candidates[-1]
    scales = fit.model.scales(candidate.axis)
    indices = fit.model.indices("term", candidate.key)
    names = [fit.model.parameters[i].name for i in indices]
    scale_factors = np.array([p.value(1.0, scales) for p in candidate.term.free_parameters])

    def basis(section: Section) -> Array:
        nothing = np.zeros(section.grid.size)
        return scale_factors * np.stack([section.columns.get(name, nothing) for name in names], axis=1)

    def share(section: Section) -> float:
        """Mean square of the law along a section, relative to its largest column: sections differ in units."""
        largest = max(np.abs(column).max() for column in section.columns.values())
        return float(np.mean((basis(section) @ fit.x[indices] / largest) ** 2))

    section = max(_sections(candidate.term.effect, scales), key=share)
    columns = basis(section)
    value = columns @ fit.x[indices]
    band = np.sqrt(
        np.maximum(np.einsum("ij,jk,ik->i", columns, fit.covariance[np.ix_(indices, indices)], columns), 0.0)
    )
    points = [[float(a), float(b), float(c)] for a, b, c in zip(section.grid, value, band, strict=True)]
    return {
        "x": section.x_label,
        "y": section.label,
        "unit": section.unit,
        "columns": [section.x_label, section.label, "sd"],
        "points": points,
    }


def _sections(effect: str, s: NaturalScales) -> list[Section]:
    """Lines along which the law of a discrepancy term can be drawn."""
    u = np.linspace(-1.0, 1.0, 121)
    phase = 0.5 * np.pi * (u + 1.0)
    time = s.duration * phase / np.pi

    def waves(letter: str) -> dict[str, Array]:
        return {f"{letter}{j}": np.cos(j * phase) for j in range(GAIN_COSINES + 1)}  # of all terms the most

    match effect:
        case "free-mechanics":
            torque = s.k * s.amplitude
            powers = range(2, FORCE_DEGREE + 1)
            angle = {f"f{n}0": torque * u**n for n in powers}
            rate = {f"f0{n}": torque * u**n for n in powers}
            return [
                Section(angle, "torque at zero rate", "N m", s.amplitude * u, "angle (rad)"),
                Section(rate, "torque at zero angle", "N m", s.amplitude * s.rate * u, "rate (rad/s)"),
                Section({n: torque * c for n, c in waves("k").items()}, "change of k A", "N m", time, "time (s)"),
            ]
        case "free-stiffness":
            return [Section(waves("k"), "stiffness error / k", "1", time, "time (s)")]
        case "free-capacitance":
            span = 1.5 * u
            profile = {f"a{n}": np.exp(-(span**2)) * span**n for n in PROFILE_POWERS}
            return [Section(profile, "extra capacitance / C0", "1", span, "angle / theta0")]
        case "free-drive":
            static, slopes = {"v0": u, "v2": u**2, "v3": u**3}, {"v1": u, "v5": u**3}
            return [
                Section(static, "drive error / rms", "1", u, "drive / rms"),
                Section(slopes, "drive error / rms", "1", u, "slope / (rms · rate)"),
                Section(waves("g"), "gain error", "1", time, "time (s)"),
                Section(waves("o"), "offset / rms", "1", time, "time (s)"),
            ]
        case "free-readout":
            x, v = np.cos(np.pi * u), -np.sin(np.pi * u)
            by_rate = {"w0": v, "w1": v * x, "w2": v, "w3": v**3, "w4": v**5}
            steady_oscillation = np.sqrt(2.0) * np.tile(x, 2)  # the second period is the steady loop
            loops = {
                f"m{i}": (apply_play(steady_oscillation, width) - steady_oscillation)[x.size :]
                for i, width in enumerate(PLAY_HALF_WIDTHS)
            }
            return [
                Section({"y0": u**2, "y1": u**3}, "signal error / rms", "1", u, "signal / rms"),
                Section(by_rate, "gain error at full amplitude", "1", np.pi * u, "phase of the oscillation (rad)"),
                Section(loops, "signal error / rms", "1", np.pi * u, "phase of the oscillation (rad)"),
                Section(waves("g"), "gain error", "1", time, "time (s)"),
                Section(waves("o"), "offset / rms", "1", time, "time (s)"),
            ]
        case "free-timing":
            r = 0.5 * (u + 1.0)
            steady_oscillation = Section({"r2": r**2, "r4": r**4}, "delay", "s", s.amplitude * r, "amplitude (rad)")
            return [Section(waves("d"), "delay", "s", time, "time (s)"), steady_oscillation]
        case _:
            hats = {
                f"c{i}": s.amplitude * np.interp(u, MAPPING_KNOTS, hat)
                for i, hat in enumerate(np.eye(MAPPING_KNOTS.size))
            }
            return [Section(hats, "angle error", "rad", s.amplitude * u, "angle (rad)")]


STATIC_PARAMETERS = {
    "free-mechanics": tuple(f"f{i}{j}" for i, j in FORCE_POWERS),
    "free-readout": ("y0", "y1"),
    "free-drive": ("v0", "v2", "v3"),
}
"""Parameters of a discrepancy term that depend on the present state only, not on time or on previous states."""


def measured_law_table(fit: Fit) -> dict[str, Any] | None:
    """The static part of the last term of a fit, a discrepancy term, as table ``[x.terms.measured-law]`` in SI units.

    None if the term has no static law that a device file can state: a delay, a capacitance, or a dependence on time
    only.
    """
    model, candidate = fit.model, fit.model.candidates[-1]
    term, scales = candidate.term, model.scales(candidate.axis)
    static = STATIC_PARAMETERS.get(term.effect, ())
    deviations, value, sd = np.sqrt(np.diag(fit.covariance)), dict.fromkeys(static, 0.0), dict.fromkeys(static, 0.0)
    for i, parameter in zip(model.indices("term", candidate.key), term.free_parameters, strict=True):
        if parameter.name in static:
            size = parameter.value(1.0, scales)
            value[parameter.name], sd[parameter.name] = size * float(fit.x[i]), abs(size) * float(deviations[i])
    run = next(run for run in model.runs if candidate.axis in run.inputs)
    if term.effect == "free-mechanics":
        angle, rate = scales.amplitude, scales.amplitude * scales.rate
        powers = [list(exponents) for exponents in FORCE_POWERS]
        factors = [scales.k * angle / (angle**i * rate**j) for i, j in FORCE_POWERS]
        motions = _motions(fit, candidate.axis)
        radius = max(float(np.hypot(theta / angle, omega / rate).max()) for theta, omega in motions)
        variables, centre, half_width = ["angle", "rate"], [0.0, 0.0], [radius * angle, radius * rate]
    elif static:
        if term.effect == "free-readout":
            output = next(o for o in run.outputs if o.kind == "sense" and candidate.axis in o.axes)
            variables, signal, rms, powers = ["signal"], output.data, scales.sense_rms, [[2], [3]]
        else:
            signal = run.inputs[candidate.axis].voltage
            variables, rms, powers = ["voltage"], scales.voltage_rms, [[1], [2], [3]]
        factors = [1.0 / rms ** (power - 1) for (power,) in powers]
        centre, half_width = [float(signal.mean())], [float(np.abs(signal - signal.mean()).max())]
    else:
        return None
    return {
        "stage": term.stage,
        "variables": variables,
        "centre": centre,
        "lower": [c - r for c, r in zip(centre, half_width, strict=True)],
        "upper": [c + r for c, r in zip(centre, half_width, strict=True)],
        "powers": powers,
        "coefficients": [value[name] * factor for name, factor in zip(static, factors, strict=True)],
        "coefficients_sd": [sd[name] * factor for name, factor in zip(static, factors, strict=True)],
    }


def _motions(fit: Fit, axis: str) -> list[tuple[Array, Array]]:
    """Angle [rad] and rate [rad/s] of an axis in every run that contains it, each shape (n,)."""
    model = fit.model
    found = [model.trajectories(r, fit.x)[axis] for r, run in enumerate(model.runs) if axis in run.inputs]
    return [(trajectory.angle, trajectory.rate) for trajectory in found]
