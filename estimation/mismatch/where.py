"""Where the misfit stands: channel, time and harmonic; and the law that a free correction measured."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimation.mismatch.fit import Comparison, Fit
from estimation.mismatch.free import GAINS, KNOTS, POWERS
from estimation.mismatch.model import Candidate

Array = NDArray[np.float64]


def excess_by_channel(comparison: Comparison, before: Fit, after: Fit) -> dict[str, float]:
    """By how much chi-square falls in each channel, over all compared samples."""
    keep = comparison.rows | comparison.held
    fall = np.where(keep, before.residual**2 - after.residual**2, 0.0)
    names = [output.name for run in comparison.runs for output in run.outputs]
    total: dict[str, float] = {}
    for i, name in enumerate(names):
        total[name] = total.get(name, 0.0) + float(fall[comparison.channel == i].sum())
    return total


def excess_by_time(comparison: Comparison, before: Fit, after: Fit, bins: int = 40) -> Array:
    """Fall of the mean squared residual over time, shape (bins,)."""
    keep = comparison.rows | comparison.held
    slot = np.minimum((comparison.time * bins).astype(int), bins - 1)[keep]
    fall = (before.residual**2 - after.residual**2)[keep]
    return np.bincount(slot, fall, bins) / np.maximum(np.bincount(slot, minlength=bins), 1)


def excess_by_harmonic(comparison: Comparison, before: Fit, after: Fit, count: int = 8) -> dict[int, float]:
    """Share of the fall of power that stands around each multiple of the motion's frequency, over all channels."""
    found: dict[int, float] = {}
    first = 0
    for run, whiteners in zip(comparison.runs, comparison.whiteners, strict=True):
        for output, whiten in zip(run.outputs, whiteners, strict=True):
            part = slice(first, first + whiten.samples)
            first += whiten.samples
            power = np.abs(np.fft.rfft(before.residual[part])) ** 2 - np.abs(np.fft.rfft(after.residual[part])) ** 2
            frequency = np.arange(power.size) / (output.data.size * output.step)
            motion = run.scales[output.axes[0]].rate / (2 * np.pi)
            nearest = np.rint(frequency / motion).astype(int)
            for n in range(count + 1):
                found[n] = found.get(n, 0.0) + float(power[nearest == n].sum())
    total = sum(max(v, 0.0) for v in found.values()) or 1.0
    return {n: max(v, 0.0) / total for n, v in found.items()}


def where(comparison: Comparison, candidate: Candidate, before: Fit, after: Fit) -> str:
    """In words and numbers: stage, channels, time and harmonics that carried the misfit."""
    place = f"{candidate.term.stage} of axis {candidate.axis}"
    channels = excess_by_channel(comparison, before, after)
    total = sum(max(v, 0.0) for v in channels.values())
    if total < 20.0:
        pulls = before.penalty - after.penalty
        return f"{place}: in no residual; the pulls on nominal values fall by {pulls:.0f} in chi-square"
    shares = ", ".join(f"{name} {max(v, 0.0) / total:.0%}" for name, v in sorted(channels.items(), key=lambda i: -i[1]))
    by_time = np.maximum(excess_by_time(comparison, before, after), 0.0)
    centre = float(by_time @ (np.arange(by_time.size) + 0.5) / by_time.size / max(by_time.sum(), 1e-300))
    when = "throughout" if 0.35 < centre < 0.65 else "mostly early" if centre < 0.5 else "mostly late"
    harmonics = excess_by_harmonic(comparison, before, after)
    top = sorted(harmonics.items(), key=lambda item: -item[1])[:3]
    around = ", ".join(f"{n}f {share:.0%}" for n, share in top if share > 0.05)
    return f"{place}: {shares} of the misfit, {when} (centre at {centre:.0%}), around {around}"


def correction_curve(fit: Fit) -> dict[str, Any]:
    """The law that the last, free correction of a fit measured: a curve with its band of one standard deviation."""
    candidate = fit.model.candidates[-1]
    at = [i for i, f in enumerate(fit.model.free) if f.kind == "term" and f.owner == candidate.key]
    spread = fit.covariance[np.ix_(at, at)]
    basis, label, unit, grid, x_label = _basis(fit, at)
    value = basis @ fit.x[at]
    band = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", basis, spread, basis), 0.0))
    points = [[float(a), float(b), float(c)] for a, b, c in zip(grid, value, band, strict=True)]
    labels = {"x": x_label, "y": label, "unit": unit, "columns": [x_label, label, "sd"]}
    return labels | {"points": points, "formula": formula(fit, at)}


def _basis(fit: Fit, at: list[int]) -> tuple[Array, str, str, Array, str]:
    candidate = fit.model.candidates[-1]
    scales = fit.model.scales(candidate.axis)
    sizes = np.array([p.value(1.0, scales) for p in candidate.term.free])
    unit = np.linspace(-1.0, 1.0, 41)
    names = [fit.model.free[i].name for i in at]
    match candidate.term.stage:
        case "mechanics":
            columns = [unit**i if j == 0 else 0.0 * unit for i, j in POWERS]
            columns += [0.0 * unit for _ in range(len(at) - len(POWERS))]
            torque = scales.k * scales.amplitude
            return (
                torque * np.stack(columns, axis=1) * sizes,
                "torque at zero rate",
                "N m",
                scales.amplitude * unit,
                "angle (rad)",
            )
        case "capacitance":
            span = 1.5 * unit
            bell = np.exp(-(span**2))
            columns = [bell * span**n for n in (1, 3, 4, 5, 6)]
            return np.stack(columns, axis=1) * sizes, "extra capacitance / C0", "1", span, "angle / theta0"
        case "timing":
            s = 0.5 * (unit + 1.0)
            columns = [np.cos(np.pi * j * s) for j in range(len(at))]
            return np.stack(columns, axis=1) * sizes, "delay", "s", scales.duration * s, "time (s)"
        case "optics":
            columns = [scales.amplitude * np.interp(unit, KNOTS, hat) for hat in np.eye(KNOTS.size)]
            return np.stack(columns, axis=1) * sizes, "angle error", "rad", scales.amplitude * unit, "angle (rad)"
        case "readout" if _wanders(fit, at, sizes):
            s = 0.5 * (unit + 1.0)
            columns = [*[0.0 * s for _ in names[:-GAINS]], *[np.cos(np.pi * j * s) for j in range(1, GAINS + 1)]]
            return np.stack(columns, axis=1) * sizes, "gain error", "1", scales.duration * s, "time (s)"
        case "readout":
            columns = [unit**2, unit**3, *[0.0 * unit for _ in names[2:]]]
            return np.stack(columns, axis=1) * sizes, "signal error / rms", "1", unit, "signal / rms"
        case _:
            columns = [unit, 0.0 * unit, unit**2, *[0.0 * unit for _ in names[3:]]]
            return np.stack(columns, axis=1) * sizes, "drive error / rms", "1", unit, "drive / rms"


def _wanders(fit: Fit, at: list[int], sizes: Array) -> bool:
    """Whether a free readout's gain over time tells more than its static law."""
    parts = sizes * fit.x[at]
    return bool(np.linalg.norm(parts[-GAINS:]) > np.linalg.norm(parts[:2]))


def formula(fit: Fit, at: list[int], most: int = 4) -> str:
    """The few strongest parts of a free correction (sparse regression: backward elimination until each is worth it)."""
    names = [fit.model.free[i].name for i in at]
    covariance = fit.covariance[np.ix_(at, at)]
    information = np.linalg.inv(covariance)
    x, kept = fit.x[at], list(range(len(at)))
    push = information @ x
    sizes = [p.value(1.0, fit.model.scales(fit.model.candidates[-1].axis)) for p in fit.model.candidates[-1].term.free]
    values = x
    while kept:
        inner = information[np.ix_(kept, kept)]
        values = np.linalg.solve(inner, push[kept])
        worth = values**2 / np.diag(np.linalg.inv(inner))
        weakest = int(np.argmin(worth))
        if worth[weakest] > 12.0 and len(kept) <= most:
            break
        kept.pop(weakest)
        values = np.delete(values, weakest)
    return " + ".join(f"{sizes[i] * v:.3g}·{names[i]}" for i, v in zip(kept, values, strict=True)) or "none"
