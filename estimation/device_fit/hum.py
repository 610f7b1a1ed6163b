"""Mains hum: selected anew for every fit, because in a short recording it resembles a drift."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from estimation.device_fit.fit import Fit, Likelihood, fit_model, fit_models
from estimation.device_fit.initial import estimate_whiteners
from estimation.device_fit.mains import (
    FEW_HARMONICS,
    NOMINAL_MAINS,
    STRONG_HUM_RELATIVE_SD,
    WEAK_HUM_RELATIVE_SD,
    Mains,
    is_hum,
)
from estimation.device_fit.model import Model
from estimation.device_fit.noise import Whitener
from estimation.least_squares import regress
from scanner.arrays import Array

MANY_HARMONICS = 7
"""Number of harmonics of hum from a rectifier. The eighth is an even one, which rectifiers hardly cause, and has an
eighth of the amplitude of the first."""

WEAK_HUM = tuple((harmonics, WEAK_HUM_RELATIVE_SD) for harmonics in (FEW_HARMONICS, MANY_HARMONICS))
STRONG_HUM = tuple((harmonics, STRONG_HUM_RELATIVE_SD) for harmonics in (FEW_HARMONICS, MANY_HARMONICS))
"""Numbers of harmonics and relative standard deviations of hum below, and of hum above the noise."""

TONE = (1, STRONG_HUM_RELATIVE_SD)
"""A tone at the frequency of the mains without harmonics. It is no hum, but interference."""

MAINS_RELATIVE_SD = 5e-4
"""Prior standard deviation of the mains frequency, relative: grids keep it within 0.02 to 0.03 Hz for most of a day."""

FREQUENCY_ITERATIONS = 3
"""Gauss-Newton steps of the mains frequency. In simulated recordings of a second they find deviations of up to four
prior standard deviations to a few millihertz."""

FREQUENCY_STEP = 0.01
"""Difference step of the mains frequency in prior standard deviations."""


def select_mains_hum(likelihood: Likelihood, fit: Fit, kinds: Sequence[tuple[int, float]] = WEAK_HUM) -> Fit:
    """The fit with hum of the one mains frequency that the recordings show, or of none.

    Where there is hum, the evidence also chooses between few and many harmonics, and between the nominal and the fitted
    frequency. Hum before a clip level is not linear: there fits choose between the nominal frequencies and none.

    Args:
        kinds: numbers of harmonics and standard deviations relative to the noise between which the evidence chooses.
    """
    columns = {mains: _hum_columns(likelihood, fit, mains) for mains in NOMINAL_MAINS}
    if not any(each.size for each in columns.values()):
        return min(fit_hum_variants(likelihood, fit), key=lambda variant: variant.neg2_log_evidence)
    beside = _beside_hum(fit)
    without = beside.evaluate(np.zeros((np.count_nonzero(fit.rows), 0)))[0]
    lowest, strongest = min((beside.evaluate(each)[0], mains) for mains, each in columns.items())
    selected = min(_refined_mains(likelihood, fit, beside, strongest, kinds))[1:] if lowest < without else ()
    if selected == fit.model.mains:
        return fit
    model = _with_mains(fit.model, *selected)
    other = fit_model(likelihood, model, model.map_parameters_from(fit.model, fit.x), max_iterations=3)
    is_possible = len(fit.model.mains) < len(NOMINAL_MAINS)
    return fit if is_possible and fit.neg2_log_evidence < other.neg2_log_evidence else other


def describe_strong_hum(fit: Fit) -> dict[str, dict[str, float]]:
    """By sense channel whose hum is stronger than the noise: ``frequency`` [Hz] of the mains, ``rms`` of the hum [V],
    and ``relative``, its ratio to the standard deviation of the noise; of the recording with the strongest."""
    strong: dict[str, dict[str, float]] = {}
    model = fit.model
    for r, run in enumerate(model.runs):
        for output in run.outputs:
            lines = [(i, wave) for i, wave in zip(*model.basis[r, output.name], strict=True) if _is_hum(model, i)]
            if not lines or not output.noise_sd:
                continue
            rms = float(np.std(sum(fit.x[i] * wave for i, wave in lines)))
            relative = rms / output.noise_sd
            if relative > max(1.0, strong.get(output.name, {}).get("relative", 0.0)):
                strong[output.name] = {"frequency": model.mains[0].frequency, "rms": rms, "relative": relative}
    return strong


def _is_hum(model: Model, i: int) -> bool:
    """Whether a parameter of the model is a quadrature of hum."""
    return model.parameters[i].kind == "additive" and is_hum(model.parameters[i].name)


def fit_hum_variants(likelihood: Likelihood, fit: Fit) -> list[Fit]:
    """The fit without hum, and with hum of each mains at its nominal frequency alone."""
    models = [_with_mains(fit.model, *mains) for mains in ((), *((mains,) for mains in NOMINAL_MAINS))]
    return fit_models(
        likelihood, [(model, model.map_parameters_from(fit.model, fit.x)) for model in models], max_iterations=3
    )


def min_entropy_whiteners(fits: Iterable[Fit]) -> list[list[Whitener]]:
    """The whiteners with the lowest noise entropy among those of the fits.

    Hum of both mains frequencies together resembles a drift of the baseline and would raise the estimate of slow noise.
    """
    whiteners = [estimate_whiteners(fit.model, fit.x) for fit in fits]
    return min(whiteners, key=lambda noise: sum(float(np.log(whitener.psd).sum()) for row in noise for whitener in row))


def _with_mains(model: Model, *mains: Mains) -> Model:
    return Model(model.runs, model.device, model.candidates, mains)


def _refined_mains(
    likelihood: Likelihood, fit: Fit, beside: _BesideHum, nominal: Mains, kinds: Sequence[tuple[int, float]]
) -> list[tuple[float, Mains]]:
    """Hum of each kind, at the nominal and at the fitted frequency, with -2 log evidence of each.

    All but the frequency is linear around the fit.
    """
    refined = []
    for harmonics, relative_sd in kinds:
        stated = Mains(nominal.frequency, harmonics, relative_sd)
        refined += [
            (beside.evaluate(_hum_columns(likelihood, fit, stated))[0], stated),
            _with_fitted_frequency(likelihood, fit, beside, stated),
        ]
    return refined


def _with_fitted_frequency(likelihood: Likelihood, fit: Fit, beside: _BesideHum, nominal: Mains) -> tuple[float, Mains]:
    """-2 log evidence of hum at the fitted mains frequency, and that mains.

    All harmonics, channels and recordings share one deviation of the frequency: one nonlinear parameter, fitted by
    Gauss-Newton steps with the amplitudes.
    """
    deviation = 0.0  # in prior standard deviations
    columns = _hum_columns(likelihood, fit, nominal)
    for _ in range(FREQUENCY_ITERATIONS):
        _, amplitudes = beside.evaluate(columns)
        moved = _hum_columns(likelihood, fit, _deviating(nominal, deviation + FREQUENCY_STEP))
        slope = (moved - columns) @ amplitudes / FREQUENCY_STEP
        value, estimate = beside.evaluate(np.column_stack([columns, slope]), -deviation * slope)
        deviation = float(estimate[-1])
        columns = _hum_columns(likelihood, fit, _deviating(nominal, deviation))
    given_frequency, _ = beside.evaluate(columns)
    return value, _deviating(nominal, deviation)._replace(cost=value - given_frequency)


class _BesideHum(NamedTuple):
    """A linearised fit without its hum, for many columns of hum beside the same parameters.

    Attributes:
        residual: whitened fitted samples with all parameters at zero, and as many zeros as parameters, shape (n + p,).
        basis: orthonormal columns that span the sensitivities to all parameters but the hum, with one more row for the
            prior of each, shape (n + p, p).
    """

    residual: Array
    basis: Array

    def evaluate(self, hum: Array, offset: Array | float = 0.0) -> tuple[float, Array]:
        """-2 log evidence with columns of hum (n, q), up to a constant of the fit, and their estimates (q,).

        Args:
            offset: added to the residual, shape (n,).
        """
        n, q = hum.shape
        both = np.zeros((self.residual.size, q + 1))
        both[:n, :q], both[:, q] = hum, self.residual
        both[:n, q] += offset
        both -= self.basis @ (self.basis.T @ both)
        result = regress(both[:, :q], both[:, q:], np.ones(q))
        estimates = -np.linalg.solve(result.factor, result.projected[:, 0])
        return float(np.sum(result.remainder**2)) + result.log_determinant, np.asarray(estimates)


def _beside_hum(fit: Fit) -> _BesideHum:
    """The linearisation of a fit without its hum."""
    others = [i for i in range(fit.x.size) if not _is_hum(fit.model, i)]
    residual = fit.residual - fit.jacobian @ fit.x
    priors = np.diag(np.sqrt(fit.model.precision[others]))
    basis = np.linalg.qr(np.vstack([fit.jacobian[fit.rows][:, others], priors]))[0]
    return _BesideHum(np.append(residual[fit.rows], np.zeros(len(others))), basis)


def _deviating(nominal: Mains, deviation: float) -> Mains:
    """Mains whose frequency deviates by a number of prior standard deviations."""
    return nominal._replace(frequency=nominal.frequency * (1.0 + deviation * MAINS_RELATIVE_SD))


def _hum_columns(likelihood: Likelihood, fit: Fit, mains: Mains) -> Array:
    """Sensitivities of the fitted whitened samples to the amplitudes of hum, shape (n, q)."""
    model = _with_mains(fit.model, mains)
    columns, first = [], 0
    for r, (run, whiteners) in enumerate(zip(model.runs, likelihood.whiteners, strict=True)):
        for output, whitener in zip(run.outputs, whiteners, strict=True):
            for i, waveform in zip(*model.basis[r, output.name], strict=True):
                if _is_hum(model, i):
                    column = np.zeros(likelihood.time.size)
                    column[first : first + whitener.samples] = whitener(-waveform)
                    columns.append(column[fit.rows])
            first += whitener.samples
    return np.column_stack(columns) if columns else np.zeros((0, 0))
