"""What threshold crossings can add to the samples of a clipped transimpedance signal (docs/bound.md).

Information of one sample about the phase, in units of (h' / s)^2 for a signal h with noise s: 1 where nothing clips.
With a rail at c, z = (c - |h|) / s, P and Q the chances to be inside and beyond, g the normal density, it is
P - z g - g^2 / P of the values inside, and g^2 / (P Q) of whether they are inside, which is all that the times at which
the signal meets the rails can tell; both together are what the bound counts (Tobin, Econometrica 26, 24, 1958).
Run: python -m benchmarks.crossings
"""

from __future__ import annotations

import json

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from estimation.tracker.bound import share_kept
from scanner import devices
from scanner.device import Transimpedance
from scanner.laws import capacitance_slope, transimpedance_voltage

AMPLITUDE, RATE = 0.15, 5e5  # rad, Hz: chen2019's
RAILS = (1.0, 0.5, 0.2, 0.1, 0.05, 0.02, 0.01)  # of the signal's peak
NOISES = (0.1, 1.0, 10.0)  # times the paper's noise
TURNS = 20000  # samples of a turn: an average over where the samples fall


def phase_sds(rail: float, noise: float) -> dict[str, float]:
    """Least sd of the motion's phase from one cycle [deg]: whole signal, samples between the rails, these and the
    rails' crossings, and a comparator at zero alone."""
    axis = devices.load("chen2019").axis("x")
    comb, readout = axis.require_capacitance(), axis.require_readout()
    assert isinstance(readout, Transimpedance)
    u, w = 2 * np.pi * np.arange(TURNS) / TURNS, 2 * np.pi * axis.resonance
    slope = capacitance_slope(AMPLITUDE * np.sin(u), comb.C0, comb.theta0, comb.theta_th)
    h = transimpedance_voltage(slope, AMPLITUDE * w * np.cos(u), readout.R_s, readout.V_bias)
    sd = noise * readout.noise_sd
    each = (np.gradient(h, u) / sd) ** 2
    limit = rail * np.abs(h).max()
    shares = {
        "whole": 1.0,
        "between_rails": _inside((limit - np.abs(h)) / sd),
        "with_crossings": share_kept(np.abs(h), (-np.inf, limit), sd),
        "comparator": _whether(h / sd),
    }
    samples = RATE / axis.resonance
    return {name: float(np.rad2deg((samples * np.mean(each * share)) ** -0.5)) for name, share in shares.items()}


def _inside(z: NDArray[np.float64]) -> NDArray[np.float64]:
    return norm.cdf(z) - z * norm.pdf(z) - np.exp(2.0 * norm.logpdf(z) - norm.logcdf(z))


def _whether(z: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.exp(2.0 * norm.logpdf(z) - norm.logcdf(z) - norm.logsf(z))


def main() -> None:
    print(json.dumps({f"noise x {n:g}": {f"{r:g}": phase_sds(r, n) for r in RAILS} for n in NOISES}, indent=1))


if __name__ == "__main__":
    main()
