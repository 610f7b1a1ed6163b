"""Runs of the compiled filter from Python: over some blocks of a signal, from a state estimate."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimation.tracker.block_signal import BlockSignal
from estimation.tracker.kalman_filter import FilterHistory, StateEstimate, empty_history, run_filter
from estimation.tracker.linearisation import Linearisation
from estimation.tracker.observations import BlockObservations
from estimation.tracker.state_space import padded_size
from scanner.arrays import Array


class FilterRun(NamedTuple):
    """Result of a filter's run over a signal.

    Attributes:
        log_likelihood: of the projections. nis: normalised innovations squared, summed. measurements: their number.
        acquired: whether the motion of each axis was detected, shape (axes,). history: the filter's output.
    """

    log_likelihood: float
    nis: float
    measurements: int
    acquired: NDArray[np.bool_]
    history: FilterHistory


def filter_blocks(
    observations: BlockObservations, signal: BlockSignal, linear: Linearisation, start: StateEstimate, densities: Array
) -> FilterRun:
    """Run the filter over ``signal`` from the estimate ``start``.

    Args:
        signal: blocks of ``observations.signal``. linear: linearisations of the same blocks; extended by the run.
        densities: of the process noise, shape (axes, 4), see ``process_noise``.
    """
    acquired, n = start.acquired.copy(), start.mean.size
    x, P = np.zeros(padded_size(n)), np.zeros((padded_size(n), padded_size(n)))
    x[:n], P[:n, :n] = start.mean, start.covariance
    history = empty_history(len(signal.whitened), len(observations.parameters))
    args = x, P, acquired, densities, signal.offset_density, linear, history
    log_likelihood, nis, measurements = run_filter(observations.parameter_rows, signal, *args)
    return FilterRun(log_likelihood, nis, measurements, acquired, history)


def select_blocks(signal: BlockSignal, first: int, stop: int) -> BlockSignal:
    """Blocks ``first`` up to ``stop`` of a signal."""
    by_block = (
        "psi",
        "w",
        "force",
        "drive_share",
        "response",
        "response_slope",
        "table_w",
        "whitened",
        "geometry",
        "noise_var",
        "external_phase",
        "external_var",
    )
    return signal._replace(**{name: getattr(signal, name)[first:stop] for name in by_block})
