"""Where to start: the mirror's angle and rate at the first sample, and windows over which the fit may grow."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from estimation.mismatch.experiment import Output
from estimation.mismatch.fit import Comparison, Fit, solve, solve_all
from estimation.mismatch.model import Model
from estimation.mismatch.noise import Whitener, flat_psd, near_lines, noise_psd, whitener

Array = NDArray[np.float64]

FIRST_TURNS = 5
"""Turns of the mirror in the first window."""

GROWTH = 3.0
"""Each window is this much longer than the one before."""

HARMONICS = 12
"""Multiples of the motion's frequency around which no noise is measured."""


def windows(model: Model) -> list[float]:
    """Growing windows as fractions of the recordings, the last one 1.

    Far below its resonance an axis follows its drive: there is no phase to lose, and one window does.
    """
    if all(scales.rate < 0.5 * np.sqrt(scales.k / scales.J) for run in model.runs for scales in run.scales.values()):
        return [1.0]
    turns = min(run.duration * scales.rate / (2 * np.pi) for run in model.runs for scales in run.scales.values())
    stops = [FIRST_TURNS / turns]
    while stops[-1] * GROWTH < 0.7:
        stops.append(stops[-1] * GROWTH)
    return [*stops, 1.0] if stops[0] < 0.7 else [1.0]


def first_whiteners(model: Model) -> list[list[Whitener]]:
    """White noise of the level that each channel's own high frequencies show."""
    return [[whitener(flat_psd(o.data, o.bins), o.data.size, o.guard) for o in run.outputs] for run in model.runs]


def measured_whiteners(model: Model, x: Array) -> list[list[Whitener]]:
    """The noise that ``x`` leaves, away from the harmonics of motion and drive."""
    made = []
    for run, signals in zip(model.runs, model.outputs(x), strict=True):
        row = []
        for output, signal in zip(run.outputs, signals, strict=True):
            motions = [run.scales[axis].rate / (2 * np.pi) for axis in output.axes]
            harmonics = np.outer(motions, np.arange(1, HARMONICS + 1)).ravel()
            lines = np.concatenate([harmonics, *(run.lines[axis] for axis in output.axes)])
            width = 0.06 * max(motions)  # of a motion that decays
            if _crowded(output, lines, width, min(motions)):
                width = 0.0
            psd, first = noise_psd(output.data - signal, output.bins, output.step, lines, width)
            row.append(whitener(psd, output.data.size, output.guard, first))
        made.append(row)
    return made


def _crowded(output: Output, lines: Array, width: float, motion: float) -> bool:
    """Whether lines lie so close, as a multisine's do, that around the motion hardly a bin is clear of them."""
    frequency = np.arange(output.bins) / (output.data.size * output.step)
    around = frequency < 1.5 * motion
    return bool(near_lines(frequency, lines, width)[around].mean() > 0.8)


def started(
    comparison: Comparison, model: Model, stop: float, grid: tuple[int, int] = (9, 12), finalists: int = 3
) -> Fit:
    """The nominal model over the first window, from a grid of amplitudes and phases, run by run.

    An even capacitance tells the phase modulo pi only; the grid goes round once, and whichever of two equal starts
    comes first stays: nothing but a sign that the recording does not hold hangs on it.
    """
    x = np.zeros(len(model.free))
    starts: list[list[Array]] = []
    for r, run in enumerate(model.runs):
        for axis in run.inputs:
            at = _start_of(model, axis, r)
            scored = []
            for size in np.geomspace(0.03, 1.5, grid[0]):
                for phase in 2 * np.pi * np.arange(grid[1]) / grid[1]:
                    x[at] = size * np.cos(phase), size * np.sin(phase)
                    scored.append((_misfit(model, r, x, stop), x[at].copy()))
            scored.sort(key=lambda pair: pair[0])
            x[at] = scored[0][1]
            starts.append([values for _, values in scored[:finalists]])
    tried = [x.copy() for _ in range(finalists)]
    for i, one in enumerate(tried):
        place = iter(starts)
        for r, run in enumerate(model.runs):
            for axis in run.inputs:
                one[_start_of(model, axis, r)] = next(place)[i]
    fits = solve_all(comparison, [(model, one) for one in tried], stop, turns=10)
    return min(fits, key=lambda fit: fit.chi2 + fit.penalty)


def _start_of(model: Model, axis: str, r: int) -> list[int]:
    return [i for i, f in enumerate(model.free) if (f.kind, f.owner, f.run) == ("start", axis, r)]


def _misfit(model: Model, r: int, x: Array, stop: float) -> float:
    total = 0.0
    for output, signal in zip(model.runs[r].outputs, model.outputs(x, stop)[r], strict=True):
        data = output.data[: signal.size]
        total += float(np.mean((data - signal)[output.guard[0] :] ** 2)) / max(float(output.data.var()), 1e-300)
    return total


def grown(comparison: Comparison, model: Model, x: Array, stops: Sequence[float], turns: int = 6) -> list[Fit]:
    """Fits over growing windows, one each: what a few turns of the mirror fix first guides the rest."""
    steps = np.full(x.size, 1e-4)
    fits: list[Fit] = []
    for stop in stops:
        last = stop == stops[-1]
        fit = solve(comparison, model, x, stop, 2 * turns if last else turns, steps, 0.05 if last else 1.0)
        fits.append(fit)
        x = fit.x
    return fits
