"""Quantities of a fit for the report: posterior draws, residuals by state, phase errors and waveforms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from estimation.device_fit.fit import Fit, Likelihood
from estimation.least_squares import Z_95
from scanner.arrays import Array

POSTERIOR_DRAWS = 40
"""Draws from the posterior for a 95 % band. The ends of the band have a standard error of a tenth of its width."""

PORTRAIT_CELLS = 24
"""Number of cells of a phase portrait along each side: each is about 4 % of the peak-to-peak range."""

PHASE_POINTS, SAMPLES_PER_PHASE = 200, 16
"""Times at which a phase error is computed, and samples of the motion whose mean is that at one time."""

WAVEFORM_SAMPLES = 120
"""Samples of a channel whose waveform is shown: a few periods."""


def draw_parameters(fit: Fit, count: int = POSTERIOR_DRAWS) -> Array:
    """Parameters drawn from the Gaussian posterior, shape (count, len(x)); the same draws in every call."""
    return np.random.default_rng(0).multivariate_normal(fit.x, fit.covariance, count, method="eigh")


def phase_portrait(
    likelihood: Likelihood, final: Fit, residuals: Sequence[Array], run_index: int, channel_index: int
) -> list[Array]:
    """Root mean square of each residual over the angle and rate of the mirror, in units of the noise.

    Returns:
        For each residual shape (PORTRAIT_CELLS, PORTRAIT_CELLS): rows are rates and columns angles, from minus to plus
        the largest of the run; NaN for states that the mirror never had.
    """
    outputs_before = sum(len(run.outputs) for run in likelihood.runs[:run_index])
    output = likelihood.runs[run_index].outputs[channel_index]
    of_channel = likelihood.channel == outputs_before + channel_index
    trajectory = final.model.trajectories(run_index, final.x)[output.axes[0]]
    at = (likelihood.time[of_channel] * output.data.size - 0.5) * output.stride + output.first
    grid = np.arange(trajectory.angle.size)
    row, column = (
        np.clip((np.interp(at, grid, v) / np.abs(v).max() + 1.0) / 2.0 * PORTRAIT_CELLS, 0, PORTRAIT_CELLS - 1)
        for v in (trajectory.rate, trajectory.angle)
    )
    compared = (likelihood.rows | likelihood.validation_rows)[of_channel]
    cell = (row.astype(np.intp) * PORTRAIT_CELLS + column.astype(np.intp))[compared]
    count = np.bincount(cell, minlength=PORTRAIT_CELLS**2)
    portraits = []
    for residual in residuals:
        power = np.bincount(cell, residual[of_channel][compared] ** 2, PORTRAIT_CELLS**2)
        mean = np.where(count, power / np.maximum(count, 1), np.nan)
        portraits.append(np.sqrt(mean).reshape(PORTRAIT_CELLS, PORTRAIT_CELLS))
    return portraits


@dataclass(frozen=True)
class PredictionPhaseError:
    """Phase error of an open-loop prediction of the motion.

    Attributes:
        time: of the run [s], shape (n,).
        before: phase of the nominal device's motion, as fitted, against that of the improved device [rad].
        after: half the 95 % band of the improved device's phase [rad].
        amplitude: of the improved device's motion [rad].
    """

    time: Array
    before: Array
    after: Array
    amplitude: Array


def phase_error(nominal: Fit, final: Fit, axis: str, run_index: int) -> PredictionPhaseError | None:
    """Phase error of one axis; None if it is driven far below its resonance, where it follows the drive."""
    run = final.model.runs[run_index]
    scales = run.scales[axis]
    if scales.rate < 0.5 * np.sqrt(scales.k / scales.J):
        return None
    at = np.linspace(0, len(run.inputs[axis].voltage), PHASE_POINTS * SAMPLES_PER_PHASE + 1).astype(np.intp)

    def phasor(fit: Fit, x: Array) -> Array:
        trajectory = fit.model.trajectories(run_index, x)[axis]
        return np.asarray(trajectory.angle[at] - 1j * trajectory.rate[at] / scales.rate)

    def mean_phase(product: Array) -> Array:
        return np.angle(product[:-1].reshape(PHASE_POINTS, SAMPLES_PER_PHASE).mean(axis=1))

    reference = phasor(final, final.x).conj()
    spread = [mean_phase(phasor(final, x) * reference) for x in draw_parameters(final, POSTERIOR_DRAWS // 2)]
    before = mean_phase(phasor(nominal, nominal.x) * reference)
    time = run.inputs[axis].time[at[:-1]].reshape(PHASE_POINTS, SAMPLES_PER_PHASE).mean(axis=1)
    amplitude = np.abs(reference[:-1]).reshape(PHASE_POINTS, SAMPLES_PER_PHASE).mean(axis=1)
    return PredictionPhaseError(time, before, Z_95 * np.sqrt(np.mean(np.square(spread), axis=0)), amplitude)


@dataclass(frozen=True)
class Waveform:
    """A few periods of one channel, measured and predicted.

    Attributes:
        time: of the run [s], shape (n,).
        measured, before, after: the channel, and its prediction by the nominal and by the improved device, shape (n,).
    """

    time: Array
    measured: Array
    before: Array
    after: Array


def waveform(nominal: Fit, final: Fit, run_index: int, channel_index: int) -> Waveform:
    """The part of a channel in which the nominal device is most wrong, without the samples that are not compared."""
    output = final.model.runs[run_index].outputs[channel_index]
    before, after = (fit.model.outputs(fit.x)[run_index][channel_index] for fit in (nominal, final))
    start, stop = output.guard[0], output.data.size - output.guard[1]
    length = min(WAVEFORM_SAMPLES, stop - start)
    misfit = np.concatenate([[0.0], np.cumsum((output.data - before)[start:stop] ** 2)])
    first = start + int(np.argmax(misfit[length:] - misfit[:-length]))
    part = slice(first, first + length)
    time = np.asarray(output.step * np.arange(first, first + length), np.float64)
    return Waveform(time, output.data[part], before[part], after[part])
