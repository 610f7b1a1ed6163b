"""Law of a fitted discrepancy term: a curve with its band, and a table for a device."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from estimation.candidate_terms.curves import CURVE_KNOTS, CURVE_NAMES, CURVE_TERMS, table_columns
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


def correction_curve(fit: Fit) -> dict[str, Any] | None:
    """Curve of the last term of a fit, a discrepancy term, with its band of one standard deviation.

    It is drawn along the section on which the law is largest relative to its possible contributions.

    Returns:
        the content of ``curve`` in diagnosis.json: labels, units and points; None if nothing of the term can be drawn,
        as a law with memory.
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

    is_curve = candidate.term.effect in CURVE_TERMS
    sections = [_curve_section(fit)] if is_curve else _sections(candidate.term.effect, scales)
    drawable = [section for section in sections if not section.columns.keys().isdisjoint(names)]
    if not drawable:
        return None
    section = max(drawable, key=share)
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
    x, v = np.cos(np.pi * u), -np.sin(np.pi * u)  # angle and rate of an oscillation

    def waves(letter: str) -> dict[str, Array]:
        return {f"{letter}{j}": np.cos(j * phase) for j in range(GAIN_COSINES + 1)}  # of all terms the most

    match effect:
        case "free-mechanics":
            torque = s.k * s.amplitude
            powers = range(2, FORCE_DEGREE + 1)
            angle = {f"f{n}0": torque * u**n for n in powers}
            rate = {f"f0{n}": torque * u**n for n in powers}
            mixed = {f"f{i}{j}": torque * x**i * v**j for i, j in FORCE_POWERS if i and j}
            return [
                Section(angle, "torque at zero rate", "N m", s.amplitude * u, "angle (rad)"),
                Section(rate, "torque at zero angle", "N m", s.amplitude * s.rate * u, "rate (rad/s)"),
                Section(mixed, "torque of angle and rate together", "N m", np.pi * u, "phase of the oscillation (rad)"),
                Section({n: torque * c for n, c in waves("k").items()}, "change of k A", "N m", time, "time (s)"),
                Section({n: torque * c for n, c in waves("b").items()}, "change of b A ω", "N m", time, "time (s)"),
            ]
        case "free-stiffness":
            return [
                Section(waves("k"), "stiffness error / k", "1", time, "time (s)"),
                Section(waves("b"), "damping error · rate / k", "1", time, "time (s)"),
            ]
        case "free-capacitance":
            span = 1.5 * u
            profile = {f"a{n}": np.exp(-(span**2)) * span**n for n in PROFILE_POWERS}
            return [Section(profile, "extra capacitance / C0", "1", span, "angle / theta0")]
        case "free-drive":
            static, slopes = {"v0": u, "v2": u**2, "v3": u**3}, {"v1": u, "v5": u**3}
            return [
                Section(static, "drive error / rms", "1", u, "drive / rms"),
                Section(slopes, "drive error / rms", "1", u, "slope / (rms · rate)"),
                Section({"v4": x * v}, "drive error / rms", "1", np.pi * u, "phase of the drive (rad)"),
                Section(waves("g"), "gain error", "1", time, "time (s)"),
                Section(waves("o"), "offset / rms", "1", time, "time (s)"),
            ]
        case "free-readout":
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


def _curve_section(fit: Fit) -> Section:
    """The whole range of the signal of a curve, the last term of a fit."""
    signal, rms = _signal_before_law(fit)
    u = np.linspace(-1.0, 1.0, 121) * np.abs(signal - signal.mean()).max() / rms
    name = "signal" if fit.model.candidates[-1].term.stage == "readout" else "drive"
    columns = {"c2": u**2, "c3": u**3} | dict(zip(CURVE_NAMES, table_columns(u).T, strict=True))
    return Section(columns, f"{name} error / rms", "1", u, f"{name} / rms")


STATIC_PARAMETERS = {
    "free-mechanics": tuple(f"f{i}{j}" for i, j in FORCE_POWERS),
    "free-readout": ("y0", "y1"),
    "free-drive": ("v0", "v2", "v3"),
    "free-readout-curve": ("c2", "c3", *CURVE_NAMES),
    "free-drive-curve": ("c2", "c3", *CURVE_NAMES),
}
"""Parameters of a discrepancy term that depend on the present state only, not on time or on previous states."""


def measured_law_table(fit: Fit) -> dict[str, Any] | None:
    """The static part of the last term of a fit, a discrepancy term, as table ``[x.terms.measured-law]`` in SI units.

    None if the term has no static law that a device file can state: a delay, a capacitance, or a dependence on time or
    previous states only.
    """
    model, candidate = fit.model, fit.model.candidates[-1]
    term, scales = candidate.term, model.scales(candidate.axis)
    static = STATIC_PARAMETERS.get(term.effect, ())
    if {parameter.name for parameter in term.free_parameters}.isdisjoint(static):
        return None
    value, covariance = _static_parameters(fit, static)
    sd = np.sqrt(np.diag(covariance))
    if term.effect == "free-mechanics":
        angle, rate = scales.amplitude, scales.amplitude * scales.rate
        powers = [list(exponents) for exponents in FORCE_POWERS]
        stiffness = model.nominal(candidate.axis, fit.x).require_mechanics().k
        factors = [stiffness * angle / (angle**i * rate**j) for i, j in FORCE_POWERS]
        motions = _motions(fit, candidate.axis)
        radius = max(float(np.hypot(theta / angle, omega / rate).max()) for theta, omega in motions)
        variables, centre, half_width = ["angle", "rate"], [0.0, 0.0], [radius * angle, radius * rate]
    else:
        powers = [[1], [2], [3]] if term.effect == "free-drive" else [[2], [3]]
        variables, (signal, rms) = ["signal" if term.stage == "readout" else "voltage"], _signal_before_law(fit)
        factors = [1.0 / rms ** (power - 1) for (power,) in powers]
        centre, half_width = [float(signal.mean())], [float(np.abs(signal - signal.mean()).max())]
    n = len(powers)
    law = {
        "stage": term.stage,
        "variables": variables,
        "centre": centre,
        "lower": [c - r for c, r in zip(centre, half_width, strict=True)],
        "upper": [c + r for c, r in zip(centre, half_width, strict=True)],
        "powers": powers,
        "coefficients": (value[:n] * factors).tolist(),
        "coefficients_sd": (sd[:n] * factors).tolist(),
    }
    if len(static) > n:
        reach = half_width[0] / rms
        at = np.unique([-reach, *np.clip(CURVE_KNOTS, -reach, reach), reach])
        columns = table_columns(at)
        variance = np.einsum("ij,jk,ik->i", columns, covariance[n:, n:], columns)
        law["knots"] = (centre[0] + rms * at).tolist()
        law["knot_values"] = (rms * columns @ value[n:]).tolist()
        law["knot_values_sd"] = (rms * np.sqrt(np.maximum(variance, 0.0))).tolist()
    return law


def _static_parameters(fit: Fit, names: Sequence[str]) -> tuple[Array, Array]:
    """Values of parameters of the last term of a fit in its units, and their covariance; 0 for those not fitted."""
    candidate, scales = fit.model.candidates[-1], fit.model.scales(fit.model.candidates[-1].axis)
    indices = fit.model.indices("term", candidate.key)
    units = {p.name: (i, p.value(1.0, scales)) for i, p in zip(indices, candidate.term.free_parameters, strict=True)}
    at = [j for j, name in enumerate(names) if name in units]
    index, unit = (list(each) for each in zip(*(units[names[j]] for j in at), strict=True)) if at else ([], [])
    value, covariance = np.zeros(len(names)), np.zeros((len(names), len(names)))
    value[at] = fit.x[index] * unit
    covariance[np.ix_(at, at)] = fit.covariance[np.ix_(index, index)] * np.outer(unit, unit)
    return value, covariance


def _signal_before_law(fit: Fit) -> tuple[Array, float]:
    """Signal, of all runs, to which the last term of a fit, a law of drive or readout, adds, and its rms [V].

    A readout that folds a signal reaches larger values of it than the recording shows.
    """
    model, candidate = fit.model, fit.model.candidates[-1]
    scales = model.scales(candidate.axis)
    if candidate.term.stage == "drive":
        voltages = [run.inputs[candidate.axis].voltage.ravel() for run in model.runs if candidate.axis in run.inputs]
        return np.concatenate(voltages), scales.voltage_rms
    without = model.with_candidates(model.candidates[:-1])
    x = without.map_parameters_from(model, fit.x)
    signals = [
        signal
        for r, run in enumerate(model.runs)
        for output, signal in zip(run.outputs, without.full_signals(x, r), strict=True)
        if output.kind == "sense" and candidate.axis in output.axes
    ]
    return np.concatenate(signals), scales.sense_rms


def _motions(fit: Fit, axis: str) -> list[tuple[Array, Array]]:
    """Angle [rad] and rate [rad/s] of an axis in every run that contains it, each shape (n,)."""
    model = fit.model
    found = [model.trajectories(r, fit.x)[axis] for r, run in enumerate(model.runs) if axis in run.inputs]
    return [(trajectory.angle, trajectory.rate) for trajectory in found]
