"""Localisation of a misfit by channel, time and harmonic of the motion."""

from __future__ import annotations

import numpy as np

from estimation.device_fit.fit import Fit, Likelihood
from estimation.device_fit.parameters import Candidate
from scanner.arrays import Array

TIME_BINS, MAX_HARMONIC = 40, 8
"""Intervals of time, and the highest multiple of the motion's frequency, by which a misfit is located."""


def chi2_reduction_by_channel(likelihood: Likelihood, before: Fit, after: Fit) -> dict[str, float]:
    """Fall of chi-square from ``before`` to ``after`` in each channel, over fitted and held-out samples."""
    keep = likelihood.rows | likelihood.validation_rows
    fall = np.where(keep, before.residual**2 - after.residual**2, 0.0)
    total: dict[str, float] = {}
    for i, output in enumerate(output for run in likelihood.runs for output in run.outputs):
        total[output.name] = total.get(output.name, 0.0) + float(fall[likelihood.channel == i].sum())
    return total


def _chi2_reduction_by_time(likelihood: Likelihood, before: Fit, after: Fit) -> Array:
    """Fall of the mean squared whitened residual in ``TIME_BINS`` intervals of equal duration, shape (bins,)."""
    keep = likelihood.rows | likelihood.validation_rows
    slot = np.minimum((likelihood.time * TIME_BINS).astype(int), TIME_BINS - 1)[keep]
    fall = (before.residual**2 - after.residual**2)[keep]
    return np.bincount(slot, fall, TIME_BINS) / np.maximum(np.bincount(slot, minlength=TIME_BINS), 1)


def _chi2_reduction_by_harmonic(likelihood: Likelihood, axis: str, before: Fit, after: Fit) -> dict[int, float]:
    """Share of the fall of chi-square around multiples 0 to ``MAX_HARMONIC`` of the frequency at which an axis moves.

    It is that of the recordings which contain the axis.
    """
    reduction = dict.fromkeys(range(MAX_HARMONIC + 1), 0.0)
    first = 0
    for run, whiteners in zip(likelihood.runs, likelihood.whiteners, strict=True):
        for output, whiten in zip(run.outputs, whiteners, strict=True):
            part = slice(first, first + whiten.samples)
            first += whiten.samples
            if axis not in run.scales:
                continue
            power = np.abs(np.fft.rfft(before.residual[part])) ** 2 - np.abs(np.fft.rfft(after.residual[part])) ** 2
            frequency = np.arange(power.size) / (output.data.size * output.step)
            motion = run.scales[axis].rate / (2 * np.pi)
            nearest = np.rint(frequency / motion).astype(int)
            for n in reduction:
                reduction[n] += float(power[nearest == n].sum())
    total = sum(max(v, 0.0) for v in reduction.values()) or 1.0
    return {n: max(v, 0.0) / total for n, v in reduction.items()}


def describe_localisation(likelihood: Likelihood, candidate: Candidate, before: Fit, after: Fit) -> str:
    """One line: stage, channels, time and harmonics of the misfit that a term explains."""
    place = f"{candidate.term.stage} of axis {candidate.axis}"
    channels = chi2_reduction_by_channel(likelihood, before, after)
    total = sum(max(v, 0.0) for v in channels.values())
    if total < 20.0:
        pulls = before.penalty - after.penalty
        return f"{place}: not in the residual; chi-square of the nominal values' deviations falls by {pulls:.0f}"
    shares = ", ".join(f"{name} {max(v, 0.0) / total:.0%}" for name, v in sorted(channels.items(), key=lambda i: -i[1]))
    by_time = np.maximum(_chi2_reduction_by_time(likelihood, before, after), 0.0)
    centre = float(by_time @ (np.arange(by_time.size) + 0.5) / by_time.size / max(by_time.sum(), 1e-300))
    when = "throughout" if 0.35 < centre < 0.65 else "mostly early" if centre < 0.5 else "mostly late"
    harmonics = _chi2_reduction_by_harmonic(likelihood, candidate.axis, before, after)
    top = sorted(harmonics.items(), key=lambda item: -item[1])[:3]
    around = ", ".join(f"{n}f {share:.0%}" for n, share in top if share > 0.05)
    return f"{place}: {shares} of the misfit, {when} (centre at {centre:.0%}), around {around}"
