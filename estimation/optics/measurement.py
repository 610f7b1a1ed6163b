"""Measurement of the optics parameters of a scan: the fit from the best start, and their covariance without effects."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from estimation.optics.fit import UNRESOLVED_SD_CELLS, OpticsFit, fit_optics
from estimation.optics.samples import (
    MIN_CELLS,
    NOMINAL,
    OpticsParameters,
    ScanSamples,
    measure_cell_variances,
    project_samples,
)
from estimation.optics.scene import CellVariances
from estimation.parallel import map_parallel
from scanner.arrays import Array
from scanner.device import AXES, Device
from scanner.motion import Motion
from scanner.stages import Amdm

MEASURED_PARAMETERS = (
    "delay_x", "delay_y", "delay_growth_x", "delay_growth_y", "amplitude_growth_x", "amplitude_growth_y", "decay",
    "drift_x", "drift_y",
)  # fmt: skip
"""Parameters that are fitted together; m is their number. Delay and lag of the intensity are not included: the delay is
the common part of both axes' delays, and the linear effect of a lag is that of a delay."""

FLICKER_SD = 0.01
"""Standard deviation of the apparent relative change of the light over the recording that is caused by detail of the
scene finer than a cell."""

RESOLUTION_RATIO = 1.25
"""Ratio of noise to prior variance from which on the grid does not resolve the sample: cells then differ inside by as
much as from their neighbours. ``UNRESOLVED_SD_CELLS`` and ``FLICKER_SD`` are replaced by the two values below."""

UNRESOLVED_SD_CELLS_COARSE_GRID, FLICKER_SD_COARSE_GRID = 1.0, 0.5
"""A whole cell and half of the light, where the grid does not resolve the sample: the pattern of the scan then decides
which detail which half-period meets."""

MAX_INTENSITY_DELAY_S = 25e-6
"""Largest delay of the intensity that is searched for: several times the latency of common converters and filters."""

MAX_PHASE_ERROR_RAD = np.radians(15.0)
"""Largest phase error of an axis that is searched for: beyond it a picture is visibly doubled."""

PRIOR_PHASE_GROWTH_RAD = np.radians(5.0)
"""Width of the fit's prior on the growth of a phase error over the recording, wide enough to leave it free."""

IMPROVEMENT_RATIO = 0.95
"""Noise variance relative to that at nominal optics below which another start is fitted: smaller differences arise by
chance from the assignment of samples to cells."""

SEARCH_SAMPLES = 40_000
"""Samples used to find a start, which needs no precision."""

PHASE_WANDER_SD_RAD = np.radians(0.3)
"""Slow change of phase over a recording that an estimator may have missed."""

AMPLITUDE_WANDER_SD = 0.02
"""Slow relative change of amplitude over a recording that an estimator may have missed."""


def _fit_priors(rates: Mapping[str, float]) -> OpticsParameters:
    """Prior standard deviations of the fit itself, wide enough to leave all parameters free."""
    priors = {"decay": 1.0}
    for axis in AXES:
        priors |= {f"amplitude_growth_{axis}": AMPLITUDE_WANDER_SD, f"drift_{axis}": 0.1}
        priors[f"delay_{axis}"] = max(MAX_INTENSITY_DELAY_S, MAX_PHASE_ERROR_RAD / rates[axis])
        priors[f"delay_growth_{axis}"] = PRIOR_PHASE_GROWTH_RAD / rates[axis]
    return {name: priors[name] for name in MEASURED_PARAMETERS}


def fit_from_best_start(scan: ScanSamples, rates: Mapping[str, float]) -> tuple[CellVariances, OpticsFit]:
    """The measured parameters, and the variances of the intensity under them.

    A repetitive sample makes a wrong position fit, and cells that do not resolve it err. A fit that starts far from
    nominal optics is therefore taken only where it is clearly better than the one that starts there.
    """
    priors = _fit_priors(rates)
    fits = [_refine(scan, priors, NOMINAL, scan.finest_cells)]
    fits += [_refine(scan, priors, start, MIN_CELLS) for start in _starts(scan, rates)]
    best = min(fits, key=lambda pair: pair[0].noise)
    return best if best[0].noise < IMPROVEMENT_RATIO * fits[0][0].noise else fits[0]


def _refine(
    scan: ScanSamples, priors: OpticsParameters, parameters: OpticsParameters, cells: int
) -> tuple[CellVariances, OpticsFit]:
    """Fit on grids of twice as many cells each time, from ``cells`` to the finest."""
    while True:
        variances = measure_cell_variances(scan, project_samples(scan, parameters, cells), cells)
        fit = fit_optics(scan, priors, parameters, variances, cells)
        parameters = fit.parameters
        if cells == scan.finest_cells:
            return measure_cell_variances(scan, project_samples(scan, parameters, cells), cells), fit
        cells = min(2 * cells, scan.finest_cells)


def _starts(scan: ScanSamples, rates: Mapping[str, float]) -> list[OpticsParameters]:
    """Nominal optics, and the delay of both axes or of one axis under which samples of a coarse cell agree best.

    The second only where they agree clearly better than at nominal optics.
    """
    few, speed = scan.first_samples(SEARCH_SAMPLES), scan.largest_speed
    grids: list[tuple[tuple[str, ...], float, float]] = [
        (
            ("delay_x", "delay_y"),
            1.0 / MIN_CELLS / max(speed.values()),
            max(MAX_INTENSITY_DELAY_S, MAX_PHASE_ERROR_RAD / max(rates.values())),
        )
    ]
    grids += [((f"delay_{axis}",), 1.0 / MIN_CELLS / speed[axis], MAX_PHASE_ERROR_RAD / rates[axis]) for axis in AXES]
    trials = [NOMINAL]
    for names, step, largest in grids:
        delays = step * np.arange(-np.ceil(largest / step), np.ceil(largest / step) + 1)
        trials += [{**NOMINAL, **dict.fromkeys(names, float(delay))} for delay in delays]

    def noise_of(trial: OpticsParameters) -> float:
        return measure_cell_variances(few, project_samples(few, trial, MIN_CELLS), MIN_CELLS).noise

    noise = map_parallel(noise_of, trials)
    best = int(np.argmin(noise))
    return [NOMINAL, trials[best]] if noise[best] < IMPROVEMENT_RATIO * noise[0] else [NOMINAL]


def nominal_covariance(
    motion: Motion, device: Device, rates: Mapping[str, float], scan: ScanSamples, variances: CellVariances
) -> Array:
    """Covariance of the measured parameters without any effect, shape (m, m): known uncertainties alone."""
    resolved = variances.noise < RESOLUTION_RATIO * variances.prior
    unresolved, flicker = (
        (UNRESOLVED_SD_CELLS, FLICKER_SD) if resolved else (UNRESOLVED_SD_CELLS_COARSE_GRID, FLICKER_SD_COARSE_GRID)
    )
    position_sd = 2.0 * unresolved / scan.finest_cells
    sd = {"decay": flicker}
    for axis in AXES:
        phase_sd = float(np.sqrt(np.nanmean(np.square(motion.axes[axis].phase_sd))))
        delay = float(np.hypot(phase_sd / rates[axis], position_sd / scan.largest_speed[axis]))
        growth = float(np.hypot(delay, PHASE_WANDER_SD_RAD / rates[axis]))
        sd |= {f"delay_{axis}": delay, f"delay_growth_{axis}": growth}
        sd |= {f"drift_{axis}": position_sd, f"amplitude_growth_{axis}": AMPLITUDE_WANDER_SD}
    covariance = np.diag([sd[name] ** 2 for name in MEASURED_PARAMETERS])
    delays = np.array([readout_delay_sd(device, axis, rates[axis]) for axis in AXES])
    shared = device.readout is not None  # one readout, one error
    covariance[:2, :2] += np.outer(delays, delays) if shared else np.diag(delays**2)
    return covariance


def readout_delay_sd(device: Device, axis: str, rate: float) -> float:
    """Standard deviation of the motion's delay [s] from the tolerance of the readout's corner frequencies."""
    readout = device.readout or device.axis(axis).readout
    if not isinstance(readout, Amdm):
        return 0.0
    frequency = rate / np.pi  # an even capacitance shows the motion at twice its frequency [Hz]
    ratio = frequency / np.array(readout.lpf_hz)
    phase_sd = device.tolerance(axis, "lpf_hz") * float(np.sum(ratio / (1.0 + ratio**2)))
    return phase_sd / (2 * np.pi * frequency)
