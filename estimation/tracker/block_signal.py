"""The measurements of one sense channel, block by block, in the form that the compiled filter takes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimation.tracker.demodulation import NoiseSpectrum
from scanner.arrays import Array, Complex

MIN_OFFSET_DENSITY_V2_PER_S = 1e-8
"""Least spectral density of the random walk of the readout's offset [V^2/s]: 0.1 mV in 1 s, a thermal drift."""


class BlockSignal(NamedTuple):
    """One sense channel as block projections, with drive and readout of every block.

    m = 1 + 2 lines is the number of projections, a line being a harmonic of one axis.

    Attributes:
        psi: reference phase at the block's middle, shape (blocks, axes) [rad].
        w: its rate there, shape (blocks, axes) [rad/s].
        force: harmonics of the drive's force, shape (blocks, axes, FORCE_HARMONICS).
        drive_share: fraction of the step to the next block during which this block's drive acts, shape (blocks, axes);
            0.5 unless the drive switches.
        step: time from one block to the next [s].
        lines: (axis, order) of each line, shape (lines, 2).
        response: of the readout at each line, shape (blocks, lines). response_slope: its derivative by the motion's
            angular frequency [s].
        mean_gain: readout response at 0 Hz, 0 where it has no DC response. mean_delay: response to the mean's rate [s].
        table_w: angular frequency of the projections' tables, shape (blocks, axes) [rad/s].
        spectrum: of the noise.
        whitened: W B'y of each block, shape (blocks, m) [V], with W of ``demodulation.whiten_projections``.
        whitened_moments: W B'T^nB for n = 0, 1, 2 of each geometry, shape (geometries, 3, m, m).
        solvers: least-squares coefficients from ``whitened``, shape (geometries, m, m). geometry: index of each
            block's, shape (blocks,).
        noise_var: variance of a block's samples, shape (blocks,) [V^2].
        offset_density: spectral density of the random walk of the readout's offset [V^2/s].
        external_phase: phase measured by other means, shape (blocks, axes) [rad]. external_var: its variance, infinite
            where there is none [rad^2].
        amplitude_table: amplitudes [rad] and the magnitude of the main line of C or theta, shape (axes, 2, size).
        main_order: order of the main line: 2 for a capacitance, 1 for a position.
    """

    psi: Array
    w: Array
    force: Complex
    drive_share: Array
    step: float
    lines: NDArray[np.int64]
    response: Complex
    response_slope: Complex
    mean_gain: float
    mean_delay: float
    table_w: Array
    spectrum: NoiseSpectrum
    whitened: Array
    whitened_moments: Array
    solvers: Array
    geometry: NDArray[np.int64]
    noise_var: Array
    offset_density: float
    external_phase: Array
    external_var: Array
    amplitude_table: Array
    main_order: int

    def with_blocks(self, block: NDArray[np.int64], whitened: Array, moments: Array, solvers: Array) -> BlockSignal:
        """The signal with other projections of the blocks ``block``, each with its own geometry."""
        shared = 1 + np.delete(self.geometry, block).max(initial=-1)
        geometry, projections = self.geometry.copy(), self.whitened.copy()
        geometry[block], projections[block] = shared + np.arange(block.size), whitened
        return self._replace(
            geometry=geometry,
            whitened=projections,
            whitened_moments=np.concatenate([self.whitened_moments[:shared], moments]),
            solvers=np.concatenate([self.solvers[:shared], solvers]),
        )
