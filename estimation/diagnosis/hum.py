"""Mains hum: selected anew for every fit, because in a short recording it resembles a drift."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from estimation.diagnosis.fit import Fit, Likelihood, fit_models
from estimation.diagnosis.initial import estimate_whiteners
from estimation.diagnosis.model import MAINS_HZ, Model
from estimation.diagnosis.noise import Whitener


def select_mains_hum(likelihood: Likelihood, fit: Fit) -> Fit:
    """The fit with hum of the one mains frequency that the recordings show, or of none."""
    return min(fit_hum_variants(likelihood, fit), key=lambda variant: variant.neg2_log_evidence)


def fit_hum_variants(likelihood: Likelihood, fit: Fit) -> list[Fit]:
    """The fit without hum, and with hum of each mains frequency alone."""
    mains_variants = ((), *((frequency,) for frequency in MAINS_HZ))
    models = [Model(fit.model.runs, fit.model.device, fit.model.candidates, mains) for mains in mains_variants]
    return fit_models(
        likelihood, [(model, model.map_parameters_from(fit.model, fit.x)) for model in models], max_iterations=3
    )


def min_entropy_whiteners(fits: Iterable[Fit]) -> list[list[Whitener]]:
    """The whiteners with the lowest noise entropy among those of the fits.

    Hum of both mains frequencies together resembles a drift of the baseline and would raise the estimate of slow noise.
    """
    whiteners = [estimate_whiteners(fit.model, fit.x) for fit in fits]
    return min(whiteners, key=lambda noise: sum(float(np.log(whitener.psd).sum()) for row in noise for whitener in row))
