"""Pictures that a diagnosis is judged by: where the residual stands, the law that was found, and what it costs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from estimation.mismatch.fit import Comparison, Fit
from estimation.mismatch.free import FREE
from estimation.mismatch.model import Candidate
from scanner.response import Added, Path, passed, pulling, samples, sense, with_constants
from scanner.trajectory import Bell, nominal_values

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = NDArray[np.float64]
BEFORE, AFTER = "#c8553d", "#2f6fb0"

DRAWS = 40
"""Draws from the posterior behind a band."""

CELLS = 24
"""Cells of a phase portrait to a side."""

POINTS = 4000
"""Moments at which a law is evaluated."""

HALF_LINE = 200
"""Pixels from the middle of a line to its end, in a picture of 400."""


def paths(fit: Fit, x: Array, r: int) -> dict[str, Path]:
    """The motion of every axis of run ``r`` at ``x``."""
    model = fit.model
    run = model.runs[r]
    axes = {name: model.nominal(name, x) for name in model.axes}
    return model.paths(run, r, axes, {name: model.added(name, r, x) for name in run.inputs}, x, 1.0)


def draws(fit: Fit, count: int = DRAWS) -> Array:
    """Free numbers drawn from the posterior, shape (count, len(x))."""
    return np.random.default_rng(0).multivariate_normal(fit.x, fit.covariance, count, method="eigh")


@dataclass(frozen=True)
class Law:
    """What a term changes at its stage, along the motion, against what it follows most.

    Attributes:
        x, y: shape (n,); band: shape (2, n), 95 %.
        x_label, y_label: with units.
    """

    x: Array
    y: Array
    band: Array
    x_label: str
    y_label: str


def law(fit: Fit, candidate: Candidate, bins: int = 40) -> Law | None:
    """The law of a named term; None where it is no function of one moment of the motion, or changes nothing there.

    The motion stays as fitted, whatever the parameters: the band is that of the law itself.
    """
    if candidate.term.effect in FREE or candidate.term.hidden:
        return None
    r = next(i for i, run in enumerate(fit.model.runs) if candidate.axis in run.inputs)
    at = [i for i, f in enumerate(fit.model.free) if f.kind == "term" and f.owner == candidate.key]
    motion = paths(fit, fit.x, r)
    own, scales = motion[candidate.axis], fit.model.scales(candidate.axis)
    others = tuple(each for each in own.added if each.term is not candidate.term)
    nominal = fit.model.nominal(candidate.axis, fit.x)
    without = replace(own, axis=with_constants(nominal, others), added=others)
    other = next((path.angle for name, path in motion.items() if name != candidate.axis), np.zeros(own.angle.size))
    moments = np.linspace(0, own.angle.size - 1, min(POINTS, own.angle.size)).astype(np.intp)

    def change(x: Array) -> tuple[Array, str]:
        values = candidate.term.values([float(v) for v in x[at]], scales)
        return _change(without, Added(candidate.term, values, candidate.channel), other, moments)

    value, y_label = change(fit.x)
    if not value.any():
        return None
    variables = {
        "angle (mrad)": 1e3 * own.angle[moments],
        "rate (rad/s)": own.rate[moments],
        "time (ms)": 1e3 * own.inputs.time[moments],
        "voltage (V)": own.voltage[moments],
    }
    usable = {name: v for name, v in variables.items() if np.ptp(v) > 1e-9 * np.abs(v).max()}
    x_label = max(usable, key=lambda name: _explained(usable[name], value, bins))
    slot = _slots(usable[x_label], bins)
    x, y = _means(slot, usable[x_label], bins), _means(slot, value, bins)
    drawn = np.stack([_means(slot, change(each)[0], bins) for each in draws(fit)])
    band = np.percentile(drawn, [2.5, 97.5], axis=0)
    there = np.isfinite(y)
    return Law(x[there], y[there], band[:, there], x_label, y_label)


def _change(without: Path, added: Added, other: Array, moments: NDArray[np.intp]) -> tuple[Array, str]:
    """What one term changes at its stage, at some moments of a motion that is kept, with its name and unit."""
    term, nominal = added.term, nominal_values(without.axis)
    if term.torque is not None:
        values, time = np.asarray(added.values, float), without.inputs.time
        torque = [
            term.torque(time[i], without.angle[i], without.rate[i], other[i], without.voltage[i], 0.0, 0.0, values,
                        nominal)[0]
            for i in moments
        ]  # fmt: skip
        return np.array(torque), "extra torque (N m)"
    if term.bell is not None:
        return Bell(term.bell, added.values).along(without.angle[moments], without.axis)[0], "extra capacitance (F)"
    if term.voltage is not None:
        change = pulling(without.axis, [added], without.inputs) - without.inputs.voltage
        return samples(change)[moments], "extra voltage (V)"
    changed = replace(without, axis=with_constants(without.axis, [added]), added=(*without.added, added))
    if added.channel.startswith("angle"):
        seen = [passed("angle", path.angle, [path], path.axis.readout) for path in (changed, without)]
        return (seen[0] - seen[1])[moments], "change of the recorded angle (rad)"
    readout = without.axis.readout
    if readout is None:
        return np.zeros(moments.size), ""
    difference = sense(readout, [changed]) - sense(readout, [without])
    return difference[moments], "change of the sense signal (V)"


def _slots(variable: Array, bins: int) -> NDArray[np.intp]:
    low, high = variable.min(), variable.max()
    return np.minimum((variable - low) / (high - low) * bins, bins - 1).astype(np.intp)


def _means(slot: NDArray[np.intp], values: Array, bins: int) -> Array:
    """Mean of ``values`` in each slot, NaN where there are none."""
    count = np.bincount(slot, minlength=bins)
    with np.errstate(invalid="ignore"):
        return np.where(count, np.bincount(slot, values, bins) / np.maximum(count, 1), np.nan)


def _explained(variable: Array, values: Array, bins: int) -> float:
    """How well means over a variable tell ``values``: minus the mean square that they leave."""
    slot = _slots(variable, bins)
    return -float(np.mean((values - _means(slot, values, bins)[slot]) ** 2))


def draw_law(found: Law) -> Callable[[Axes], None]:
    def draw(axes: Axes) -> None:
        axes.fill_between(found.x, *found.band, alpha=0.25, color=AFTER, lw=0, label="95 %")
        axes.plot(found.x, found.y, color=AFTER, label="as fitted")
        axes.axhline(0.0, color="#888", lw=0.6)
        axes.set(xlabel=found.x_label, ylabel=found.y_label)
        axes.legend(frameon=False)

    return draw


def portrait(comparison: Comparison, final: Fit, residuals: Sequence[Array], r: int, channel: int) -> list[Array]:
    """Root mean square of each residual over the angle and rate of the mirror, in noise, shape (CELLS, CELLS) each.

    Rows are rates and columns angles, both from minus to plus the largest of the run; NaN where the mirror never was.
    """
    first = [len(run.outputs) for run in comparison.runs]
    index = sum(first[:r]) + channel
    output = comparison.runs[r].outputs[channel]
    here = comparison.channel == index
    own = paths(final, final.x, r)[output.axes[0]]
    at = comparison.time[here] * output.data.size * output.stride + output.first
    grid = np.arange(own.angle.size)
    cell = [
        np.clip((np.interp(at, grid, v) / np.abs(v).max() + 1.0) / 2.0 * CELLS, 0, CELLS - 1).astype(np.intp)
        for v in (own.rate, own.angle)
    ]
    keep = (comparison.rows | comparison.held)[here]
    place = (cell[0] * CELLS + cell[1])[keep]
    return [
        np.sqrt(_means(place, residual[here][keep] ** 2, CELLS * CELLS)).reshape(CELLS, CELLS) for residual in residuals
    ]


@dataclass(frozen=True)
class PhaseCost:
    """What the missing physics does to a scan's phase.

    Attributes:
        time: of the run [s], shape (n,).
        before: phase of the nominal device's motion, as fitted, against the improved one [rad].
        after: half the 95 % band of the improved device's own phase [rad].
    """

    time: Array
    before: Array
    after: Array

    def pixels(self, phase: Array) -> float:
        """Root mean square of a phase error in pixels, at the centre of a line."""
        return HALF_LINE * float(np.sqrt(np.mean(phase**2)))


def phase_cost(nominal: Fit, final: Fit, axis: str, r: int, points: int = 200) -> PhaseCost | None:
    """None for an axis that follows its drive far below its resonance: its motion has no phase of its own."""
    run = final.model.runs[r]
    scales = run.scales[axis]
    if scales.rate < 0.5 * np.sqrt(scales.k / scales.J):
        return None
    at = np.linspace(0, len(run.inputs[axis].voltage), points * 16 + 1).astype(np.intp)

    def turning(fit: Fit, x: Array) -> Array:
        path = paths(fit, x, r)[axis]
        return np.asarray(path.angle[at] - 1j * path.rate[at] / scales.rate)

    def slow(ahead: Array) -> Array:
        return np.angle(ahead[:-1].reshape(points, 16).mean(axis=1))

    true = turning(final, final.x)
    spread = [slow(turning(final, x) * true.conj()) for x in draws(final, DRAWS // 2)]
    before = slow(turning(nominal, nominal.x) * true.conj())
    time = run.inputs[axis].time[at[:-1]].reshape(points, 16).mean(axis=1)
    return PhaseCost(time, before, 1.96 * np.sqrt(np.mean(np.square(spread), axis=0)))


def draw_phase_cost(cost: PhaseCost, tolerated: float = 1.0) -> Callable[[Axes], None]:
    """``tolerated``: p [pixels]."""

    def draw(axes: Axes) -> None:
        low = 1e-3
        axes.plot(1e3 * cost.time, np.maximum(HALF_LINE * np.abs(cost.before), low), color=BEFORE, label="nominal")
        axes.plot(1e3 * cost.time, np.maximum(HALF_LINE * cost.after, low), color=AFTER, label="improved, 95 %")
        axes.axhline(tolerated, color="#444", lw=0.8, ls="--", label="p")
        axes.set(xlabel="time (ms)", ylabel="m δφ (pixels)", yscale="log")
        axes.legend(frameon=False)

    return draw
