"""The law that a free correction measured: a curve with its band, and the few strongest parts as a formula."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from estimation.diagnosis.discrepancy import (
    AMPLITUDE_MEMORY_SHARES,
    DELAY_MEMORY_PERIODS,
    FORCE_DEGREE,
    FORCE_POWERS,
    MAPPING_KNOTS,
    PLAY_HALF_WIDTHS,
    apply_play,
)
from estimation.diagnosis.fit import Fit
from scanner.arrays import Array
from scanner.terms import NaturalScales

MIN_CHI2_PER_TERM = 12.0
"""Fall of chi-square that a part of a formula has to be worth."""

LENGTH = "T: the recording's length"
STATE = "x = θ/A, y = θ'/(A ω)"
VARIABLES = {
    "free-mechanics": ("f/(k A)", f"{STATE}, H_s: x² + y² as remembered over s T, {LENGTH}"),
    "free-stiffness": ("(δk θ + δb θ')/(k A)", f"{STATE}, {LENGTH}"),
    "free-capacitance": ("δC/(C0 exp(−u²))", "u = (θ − centre)/θ0"),
    "free-drive": ("δV/s", f"u = V/s, v = V'/(s ω), s: the drive's rms, {LENGTH}"),
    "free-readout": (
        "δy/s",
        f"u = y/s, w = y'/(s ω), {STATE}, r = y/√(x² + y²), P_h: play of half-width h, s: the signal's rms, {LENGTH}",
    ),
    "free-timing": ("delay/s", f"r² = x² + y², {STATE}, M_n: what is remembered over n turns, {LENGTH}"),
    "free-optics": ("δθ/A", "x = θ/A"),
}
"""What the formula of a free correction gives, and the variables that it is written in."""

POLYNOMIALS = {
    "free-mechanics": {
        f"h{2 * i + j}": f"H_{share:g} {state}"
        for i, state in enumerate("xy")
        for j, share in enumerate(AMPLITUDE_MEMORY_SHARES)
    },
    "free-capacitance": {"a1": "u", "a3": "u³", "a4": "u⁴", "a5": "u⁵", "a6": "u⁶"},
    "free-drive": {"v0": "u", "v1": "v", "v2": "u²", "v3": "u³", "v4": "u v", "v5": "v³"},
    "free-readout": {
        "y0": "u²", "y1": "u³", "y2": "w", "w0": "u y", "w1": "u x y", "w2": "u r", "w3": "u r³", "w4": "u r⁵",
        **{f"m{i}": f"(P_{width}[u] − u)" for i, width in enumerate(PLAY_HALF_WIDTHS)},
    },
    "free-timing": {
        "r2": "r²", "r4": "r⁴", **{f"m{i}": f"(M_{turns:g}[r²] − r²)" for i, turns in enumerate(DELAY_MEMORY_PERIODS)},
    },
}  # fmt: skip
"""Parts of free corrections that are no cosines, as a formula shows them."""

SWAYING = {"k": "x ", "b": "y ", "g": "u ", "o": "", "d": ""}
"""What the cosines of each letter multiply."""

POWER = ("", "", "²", "³", "⁴", "⁵")


class Section(NamedTuple):
    """A cut through a free correction along which its law can be drawn.

    Attributes:
        columns: of the parameters that are seen along it, what one unit of each adds, each of the shape of ``grid``.
        label, unit: of the law. grid: of what it is drawn over; x_label: what that is.
    """

    columns: dict[str, Array]
    label: str
    unit: str
    grid: Array
    x_label: str


def correction_curve(fit: Fit) -> dict[str, Any]:
    """The law that the last, free correction of a fit measured: a curve with its band of one standard deviation.

    It is drawn along the section on which most of it stands.
    """
    candidate = fit.model.candidates[-1]
    scales = fit.model.scales(candidate.axis)
    at = [i for i, f in enumerate(fit.model.parameters) if f.kind == "term" and f.owner == candidate.key]
    names = [fit.model.parameters[i].name for i in at]
    sizes = np.array([p.value(1.0, scales) for p in candidate.term.free_parameters])

    def basis(section: Section) -> Array:
        nothing = np.zeros(section.grid.size)
        return sizes * np.stack([section.columns.get(name, nothing) for name in names], axis=1)

    def share(section: Section) -> float:
        """Mean square of the law along a section, over its largest unit: sections have units of their own."""
        largest = max(np.abs(column).max() for column in section.columns.values())
        return float(np.mean((basis(section) @ fit.x[at] / largest) ** 2))

    section = max(_sections(candidate.term.effect, scales), key=share)
    columns = basis(section)
    value = columns @ fit.x[at]
    band = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", columns, fit.covariance[np.ix_(at, at)], columns), 0.0))
    points = [[float(a), float(b), float(c)] for a, b, c in zip(section.grid, value, band, strict=True)]
    return {
        "x": section.x_label,
        "y": section.label,
        "unit": section.unit,
        "columns": [section.x_label, section.label, "sd"],
        "points": points,
        "formula": formula(fit, at),
    }


def _sections(effect: str, s: NaturalScales) -> list[Section]:
    """The ways in which the law of a free correction can be drawn."""
    u = np.linspace(-1.0, 1.0, 121)
    turn = 0.5 * np.pi * (u + 1.0)
    time = s.duration * turn / np.pi

    def waves(letter: str, most: int = 40) -> dict[str, Array]:
        return {f"{letter}{j}": np.cos(j * turn) for j in range(most)}

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
            profile = {f"a{n}": np.exp(-(span**2)) * span**n for n in (1, 3, 4, 5, 6)}
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
            swing = np.sqrt(2.0) * np.tile(x, 2)  # the second time round is the loop that a steady swing goes
            loops = {f"m{i}": (apply_play(swing, width) - swing)[x.size :] for i, width in enumerate(PLAY_HALF_WIDTHS)}
            return [
                Section({"y0": u**2, "y1": u**3}, "signal error / rms", "1", u, "signal / rms"),
                Section(by_rate, "gain error at full swing", "1", np.pi * u, "phase of the swing (rad)"),
                Section(loops, "signal error / rms", "1", np.pi * u, "phase of the swing (rad)"),
                Section(waves("g"), "gain error", "1", time, "time (s)"),
                Section(waves("o"), "offset / rms", "1", time, "time (s)"),
            ]
        case "free-timing":
            r = 0.5 * (u + 1.0)
            swing = Section({"r2": r**2, "r4": r**4}, "delay", "s", s.amplitude * r, "swing (rad)")
            return [Section(waves("d"), "delay", "s", time, "time (s)"), swing]
        case _:
            hats = {
                f"c{i}": s.amplitude * np.interp(u, MAPPING_KNOTS, hat)
                for i, hat in enumerate(np.eye(MAPPING_KNOTS.size))
            }
            return [Section(hats, "angle error", "rad", s.amplitude * u, "angle (rad)")]


def _symbol(effect: str, name: str) -> str:
    """A parameter's part of the law, for a reader."""
    letter, number = name[0], name[1:]
    if name in POLYNOMIALS.get(effect, {}):
        return POLYNOMIALS[effect][name]
    if effect == "free-mechanics" and letter == "f":
        parts = [base + POWER[int(n)] for base, n in zip("xy", number, strict=True) if n != "0"]
        return " ".join(parts)
    if letter == "c":
        return f"hat(x − {MAPPING_KNOTS[int(number)]:.2g})".replace("− -", "+ ")
    wave = "" if number == "0" else f"cos({number} π t/T)".replace("(1 ", "(")
    return SWAYING[letter] + wave


def formula(fit: Fit, at: list[int], most: int = 4) -> str:
    """The few strongest parts of a free correction (sparse regression: backward elimination until each is worth it)."""
    candidate = fit.model.candidates[-1]
    information = np.linalg.inv(fit.covariance[np.ix_(at, at)])
    push = information @ fit.x[at]
    values, kept = fit.x[at], list(range(len(at)))
    while kept:
        inner = information[np.ix_(kept, kept)]
        values = np.linalg.solve(inner, push[kept])
        worth = values**2 / np.diag(np.linalg.inv(inner))
        weakest = int(np.argmin(worth))
        if worth[weakest] > MIN_CHI2_PER_TERM and len(kept) <= most:
            break
        kept.pop(weakest)
        values = np.delete(values, weakest)
    scales, effect = fit.model.scales(candidate.axis), candidate.term.effect
    free = [candidate.term.free_parameters[i] for i in kept]
    parts = [f"{p.value(v, scales):.3g} {_symbol(effect, p.name)}".strip() for p, v in zip(free, values, strict=True)]
    law, variables = VARIABLES[effect]
    return f"{law} = {' + '.join(parts) or '0'}".replace("+ -", "− ") + f" with {variables}"


STATIC_PARAMETERS = {
    "free-mechanics": tuple(f"f{i}{j}" for i, j in FORCE_POWERS),
    "free-readout": ("y0", "y1"),
    "free-drive": ("v0", "v2", "v3"),
}
"""Parameters of a free correction that are a law of the state alone, not of time or of what went before."""


def measured_law_table(fit: Fit) -> dict[str, Any] | None:
    """The static part of the last, free correction of a fit, as ``[x.terms.measured-law]`` states it, in SI units.

    None where the correction has no static law that a device file can state: a delay, a capacitance, or nothing but a
    dependence on time.
    """
    candidate, scales = fit.model.candidates[-1], fit.model.scales(fit.model.candidates[-1].axis)
    static = STATIC_PARAMETERS.get(candidate.term.effect, ())
    at = [i for i, f in enumerate(fit.model.parameters) if f.owner == candidate.key and f.name in static]
    names = [fit.model.parameters[i].name for i in at]
    free = {each.name: each for each in candidate.term.free_parameters}
    sizes = np.array([free[name].value(1.0, scales) for name in names])
    value = dict(zip(names, (sizes * fit.x[at]).tolist(), strict=True))
    sd = dict(zip(names, (np.abs(sizes) * np.sqrt(np.diag(fit.covariance)[at])).tolist(), strict=True))
    run = next(run for run in fit.model.runs if candidate.axis in run.inputs)
    match candidate.term.effect:
        case "free-mechanics":
            unit, angle, rate = scales.k * scales.amplitude, scales.amplitude, scales.amplitude * scales.rate
            powers = [list(each) for each in FORCE_POWERS]
            factors = [unit / (angle**i * rate**j) for i, j in FORCE_POWERS]
            moved = [run.scales[candidate.axis] for run in fit.model.runs if candidate.axis in run.scales]
            variables, centre = ["angle", "rate"], [0.0, 0.0]
            reach = [max(each.amplitude for each in moved), max(each.amplitude * each.rate for each in moved)]
        case "free-readout":
            output = next(each for each in run.outputs if each.kind == "sense" and candidate.axis in each.axes)
            size = scales.sense_rms
            powers, factors = [[2], [3]], [1.0 / size, 1.0 / size**2]
            variables, centre = ["signal"], [float(output.data.mean())]
            reach = [float(np.abs(output.data - output.data.mean()).max())]
        case "free-drive":
            volts, size = run.inputs[candidate.axis].voltage, scales.voltage_rms
            powers, factors = [[1], [2], [3]], [1.0, 1.0 / size, 1.0 / size**2]
            variables, centre = ["voltage"], [float(volts.mean())]
            reach = [float(np.abs(volts - volts.mean()).max())]
        case _:
            return None
    table: dict[str, Any] = {"stage": candidate.term.stage, "variables": variables, "centre": centre}
    table["lower"] = [c - r for c, r in zip(centre, reach, strict=True)]
    table["upper"] = [c + r for c, r in zip(centre, reach, strict=True)]
    table["powers"] = powers
    table["coefficients"] = [value.get(key, 0.0) * factor for key, factor in zip(static, factors, strict=True)]
    table["coefficients_sd"] = [sd.get(key, 0.0) * factor for key, factor in zip(static, factors, strict=True)]
    return table
