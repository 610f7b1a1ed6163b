"""Information that threshold crossings can add to the samples of a clipped transimpedance signal.

The Fisher information of a sample about the phase is stated in units of (h' / s)^2, for a signal h with noise of
standard deviation s. It is 1 without clipping. With a rail at c, let z = (c - |h|) / s, P and Q the probabilities that
the sample is inside and beyond the rail, and g the normal density. The values inside the rail have the information
P - z g - g^2 / P. Whether a sample is inside has the information g^2 / (P Q), which is all that the times of the rail's
crossings contain. The bound counts the sum of both. docs/explanation/tracker.md has the results.
Run: python -m benchmarks.crossings

Source: Tobin, Econometrica 26, 24 (1958).
"""

from __future__ import annotations

import json

import numpy as np
from scipy.stats import norm

from estimation.tracker.cramer_rao import censored_information_fraction
from scanner import devices
from scanner.arrays import Array
from scanner.laws import capacitance_slope, transimpedance_voltage
from scanner.stages import Transimpedance

AMPLITUDE_RAD, SAMPLE_RATE_HZ = 0.15, 5e5
"""Amplitude and sample rate of chen2019 [rad, Hz]."""

RAIL_FRACTIONS = (1.0, 0.5, 0.2, 0.1, 0.05, 0.02, 0.01)
"""Rails, as fractions of the signal's peak."""

NOISE_FACTORS = (0.1, 1.0, 10.0)
"""Noise in units of that of chen2019."""

POINTS_PER_CYCLE = 20000
"""Points at which a cycle is evaluated: their mean is the mean over the position of the samples in the cycle."""


def phase_sds(rail: float, noise: float) -> dict[str, float]:
    """Least standard deviation of the motion's phase from one cycle [deg], by the information that is used.

    Args:
        rail: as a fraction of the signal's peak.
        noise: in units of that of chen2019.

    Returns:
        For the whole signal, the samples between the rails, these with the crossings of the rails, and a comparator at
        zero alone.
    """
    axis = devices.load("chen2019").axis("x")
    comb, readout = axis.require_capacitance(), axis.require_readout()
    assert isinstance(readout, Transimpedance)
    u, w = 2 * np.pi * np.arange(POINTS_PER_CYCLE) / POINTS_PER_CYCLE, 2 * np.pi * axis.resonance
    slope = capacitance_slope(AMPLITUDE_RAD * np.sin(u), comb.C0, comb.theta0, comb.theta_th)
    h = transimpedance_voltage(slope, AMPLITUDE_RAD * w * np.cos(u), readout.R_s, readout.V_bias)
    sd = noise * readout.noise_sd
    information = (np.gradient(h, u) / sd) ** 2
    limit = rail * np.abs(h).max()
    fractions = {
        "whole": 1.0,
        "between_rails": _information_inside_rails((limit - np.abs(h)) / sd),
        "with_crossings": censored_information_fraction(np.abs(h), (-np.inf, limit), sd),
        "comparator": _information_of_side(h / sd),
    }
    samples = SAMPLE_RATE_HZ / axis.resonance
    return {
        name: float(np.rad2deg((samples * np.mean(information * fraction)) ** -0.5))
        for name, fraction in fractions.items()
    }


def _information_inside_rails(z: Array) -> Array:
    """Information of the values inside a rail at the distance ``z`` [sd], as a fraction of that without rails."""
    return norm.cdf(z) - z * norm.pdf(z) - np.exp(2.0 * norm.logpdf(z) - norm.logcdf(z))


def _information_of_side(z: Array) -> Array:
    """Information of the side of a threshold at the distance ``z`` [sd], as a fraction of that of the sample."""
    return np.exp(2.0 * norm.logpdf(z) - norm.logcdf(z) - norm.logsf(z))


def main() -> None:
    print(
        json.dumps(
            {f"noise x {n:g}": {f"{r:g}": phase_sds(r, n) for r in RAIL_FRACTIONS} for n in NOISE_FACTORS}, indent=1
        )
    )


if __name__ == "__main__":
    main()
