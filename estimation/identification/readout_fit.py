"""Gain and offset of an AMDM readout against a reference angle, with corrections to its law."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from estimation.identification.agreement import IdentifiedValue
from estimation.identification.fits import SETTLE_TIME_S, DrivenRecord
from estimation.least_squares import fit_linear
from scanner.arrays import Array
from scanner.laws import capacitance
from scanner.lowpass import run_section, section_coefficients
from scanner.stages import Capacitance


@dataclass(frozen=True)
class ReadoutFit:
    """An AMDM readout fitted to a reference angle.

    Attributes:
        values: ``a_cir`` [V/F], ``b_cir`` [V], ``delay`` [s] beyond the sections, ``square`` [V/F^2] of the squared
            capacitance, ``feed`` [1] and ``feed_rate`` [s] of the drive that leaks through.
        coefficients: of all ``readout_features``, 0 for a term left out, shape (6,).
        noise_sd: of the residual [V].
    """

    values: Mapping[str, IdentifiedValue]
    coefficients: Array
    noise_sd: float


def readout_features(comb: Capacitance, angle: Array, voltage: Array, rate: float, sections: Sequence[float]) -> Array:
    """Regressors of an AMDM output: C, 1, C' and C^2 after the sections, the drive and its rate; shape (n, 6)."""
    C = capacitance(angle, comb.C0, comb.Cb, comb.theta0, comb.theta_th)
    square = C * C
    for cutoff in sections:
        coefficients = section_coefficients(cutoff, 1.0 / rate)
        run_section(C, *coefficients, C[0], C[0])
        run_section(square, *coefficients, square[0], square[0])
    one = np.ones_like(C)
    swing = voltage - voltage.mean()
    return np.stack([C, one, np.gradient(C, 1 / rate), square, swing, np.gradient(voltage, 1 / rate)], axis=1)


READOUT_FEATURES = ("a_cir", "b_cir", "delay", "square", "feed", "feed_rate")


def fit_readout(
    comb: Capacitance,
    records: Sequence[DrivenRecord],
    senses: Sequence[Array],
    sections: Sequence[float],
    terms: Sequence[str] = READOUT_FEATURES,
) -> ReadoutFit:
    """Gain and offset of an AMDM readout, with corrections to the formula a_cir C + b_cir, by least squares.

    Args:
        records: with the reference angle. senses: the output at the same samples [V].
        sections: corner of every low-pass section [Hz].
        terms: which of ``READOUT_FEATURES``; the paper's own fit is ``("a_cir", "b_cir")`` and no sections.
    """
    columns = [READOUT_FEATURES.index(term) for term in terms]
    basis, target = [], []
    for record, sense in zip(records, senses, strict=True):
        first = round(SETTLE_TIME_S * record.rate)
        features = readout_features(comb, record.angle, record.voltage, record.rate, sections)
        basis.append(features[first:, columns])
        target.append(sense[first:])
    stacked, y = np.concatenate(basis), np.concatenate(target)
    fitted, covariance = fit_linear(stacked, y)
    values = {term: IdentifiedValue(float(fitted[i]), float(np.sqrt(covariance[i, i]))) for i, term in enumerate(terms)}
    coefficients = np.zeros(len(READOUT_FEATURES))
    coefficients[columns] = fitted
    if "delay" in values:  # C(t - delay) = C - delay C'
        slope, a_cir = values["delay"], values["a_cir"].value
        values["delay"] = IdentifiedValue(-slope.value / a_cir, slope.sd / abs(a_cir))
    return ReadoutFit(values, coefficients, float(np.std(y - stacked @ fitted)))
