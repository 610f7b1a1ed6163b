"""Division of a channel's misfit among the findings, and what no finding explains.

Misfits are mean squares on held-out samples in the unit of the channel, not whitened, as a user measures them.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from estimation.candidate_terms.discrepancy import is_discrepancy
from estimation.candidate_terms.linear_model import LinearModel
from estimation.candidate_terms.linearisation import linear_model_of_corrections
from estimation.candidate_terms.screening import ScoreTest
from estimation.candidate_terms.significance import DETECTION_THRESHOLD, residual_is_noise
from estimation.device_fit.fit import Fit, Likelihood, held_out_samples, misfit
from estimation.diagnosis.localisation import chi2_reduction_by_channel
from estimation.diagnosis.pruning import refit_without
from estimation.diagnosis.selection import SelectionResult, SelectionStep

MAX_UNEXPLAINED_SHARE = 0.1
"""Largest residual, without the noise and as a share of a channel's standard deviation, of a fit that is called
consistent: a tenth of the signal is visible in a plot whatever its chi-square."""

MAX_NOISE_RATIO = 10.0
"""Noise over the stated one up to which a residual that is visible in a plot may be noise. Flicker noise, hum or a data
sheet account for some times the stated noise; the residual of a broad drive may resemble noise at any size."""

MIN_SHARE = 1e-3
"""Smallest share of the misfit that is determined, and stated as a remainder: held-out samples scatter by as much."""


def explained_share(without: float, complete: float, nominal: float, noise: float) -> float:
    """Share of the nominal misfit by which the misfit rises if one finding is removed from the complete model.

    Without it the others may follow the motion worse than the nominal model; that counts as the nominal misfit, so that
    no finding explains more than all together do.

    Args:
        without: mean square misfit of the complete model without the finding.
        complete, nominal: of the complete and of the nominal model.
        noise: variance of the noise.
    """
    return float(np.clip((min(without, nominal) - complete) / max(nominal - noise, 1e-300), 0.0, 1.0))


def remaining_share(complete: float, nominal: float, noise: float) -> float:
    """Share of the nominal misfit that the complete model does not explain; see :func:`explained_share`."""
    return float(np.clip((complete - noise) / max(nominal - noise, 1e-300), 0.0, 1.0))


def misfit_by_channel(fit: Fit) -> dict[str, float]:
    """Mean square residual of every channel on held-out samples, averaged over its runs."""
    values: dict[str, list[float]] = {}
    for run, signals in zip(fit.model.runs, fit.model.outputs(fit.x), strict=True):
        for output, signal in zip(run.outputs, signals, strict=True):
            rows = held_out_samples(output.data.size, output.guard)
            values.setdefault(output.name, []).append(float(np.mean((output.data - signal)[rows] ** 2)))
    return {name: float(np.mean(runs)) for name, runs in values.items()}


def noise_by_channel(likelihood: Likelihood) -> dict[str, float]:
    """Variance of every channel's noise on held-out samples, averaged over its runs."""
    values: dict[str, list[float]] = {}
    for run, whiteners in zip(likelihood.runs, likelihood.whiteners, strict=True):
        for output, whitener in zip(run.outputs, whiteners, strict=True):
            noisy_share = float(whitener.noisy_share[held_out_samples(whitener.samples)].mean())
            values.setdefault(output.name, []).append(noisy_share * whitener.measured_noise_variance)
    return {name: float(np.mean(runs)) for name, runs in values.items()}


def channel_of_share(result: SelectionResult, step: SelectionStep) -> str:
    """Name of the channel whose whitened misfit a finding lowers most."""
    reduction = chi2_reduction_by_channel(result.likelihood, step.before, result.final)
    return max(reduction, key=lambda key: reduction[key])


def share_of_finding(result: SelectionResult, step: SelectionStep) -> float:
    """Share that a finding alone explains of the misfit of :func:`channel_of_share`."""
    name, noise = channel_of_share(result, step), noise_by_channel(result.likelihood)
    fits = (step.before, result.final, result.nominal)
    if _is_rail(result, step):
        fits = (*_fits_of_named_laws(result, step), result.without_rails)
    without, complete, nominal = (misfit_by_channel(fit)[name] for fit in fits)
    return explained_share(without, complete, nominal, noise[name])


def _is_rail(result: SelectionResult, step: SelectionStep) -> bool:
    """Whether a finding is a rail at which samples stand. The nominal fit has it; its share is of the fit without."""
    return step.candidate in result.nominal.model.candidates


def _fits_of_named_laws(result: SelectionResult, step: SelectionStep) -> tuple[Fit, Fit]:
    """The fits without and with a rail beside the named laws; a free curve of the readout would take its place."""
    free = [candidate for candidate in result.final.model.candidates if is_discrepancy(candidate)]
    if not free:
        return step.before, result.final
    named = result.final
    for candidate in free:
        named = refit_without(result.likelihood, named, candidate)
    return refit_without(result.likelihood, named, step.candidate), named


def leaves_noise_alone(result: SelectionResult) -> bool:
    """Whether the residual of the final fit is called noise and no free correction beside named laws is detected."""
    is_detected = bool(result.steps) and result.remaining > DETECTION_THRESHOLD
    return residual_is_noise(result.final) and not is_detected


def find_corrections(result: SelectionResult) -> LinearModel | None:
    """Corrections of all stages beside the final fit; None if nothing but noise is left, or if it contains all."""
    if leaves_noise_alone(result):
        return None
    linear = linear_model_of_corrections(result.likelihood, result.final)
    return linear if linear.discrepancies else None


def best_correction(corrections: LinearModel) -> ScoreTest:
    """Score test of the correction that would explain most of what a fit leaves."""
    tests = [term.test for term in corrections.discrepancies if term.test is not None]
    return max(tests, key=lambda test: test.predicted_gain)


def find_remainder(
    result: SelectionResult, correction: ScoreTest | None, in_device: bool = False
) -> dict[str, Any] | None:
    """The unexplained share of a channel's misfit, and the stage of the correction that would reduce it most.

    The channel is the one whose residual exceeds its noise most. Near the noise a mean square does not determine the
    share: there it is that of the correction in the fall of the whitened misfit.

    Args:
        in_device: whether the improved device holds a measured law of it.

    Returns:
        ``share``, ``stage``, ``channel`` and ``in_device``; None if nothing but noise is left.
    """
    if leaves_noise_alone(result):
        return None
    noise = noise_by_channel(result.likelihood)
    only_rails = all(_is_rail(result, step) for step in result.steps)
    reference = result.without_rails if only_rails else result.nominal
    complete, nominal = misfit_by_channel(result.final), misfit_by_channel(reference)
    name = max(complete, key=lambda key: complete[key] / max(noise[key], 1e-300))
    share = remaining_share(complete[name], nominal[name], noise[name])
    if residual_is_noise(result.final):
        explained = max(misfit(result.nominal) - misfit(result.final), 0.0)
        left = correction.predicted_gain if correction else 0.0
        share = left / max(explained + left, 1e-300)
    if share < MIN_SHARE:
        return None
    stage = correction.candidate.term.stage if correction else "readout"
    return {"share": share, "stage": stage, "channel": name, "in_device": in_device}


def describe_unexplained(result: SelectionResult) -> str | None:
    """The unexplained misfit in words; None if the final fit is consistent with the noise."""
    is_noise, chi2 = residual_is_noise(result.final), result.final.validation_chi2
    parts = []
    if not is_noise:
        parts.append(
            f"samples not used in the fit are missed by {chi2**0.5:.3g} times the noise (chi-square {chi2:.3g})"
        )
    noise = noise_by_channel(result.likelihood)
    for name, mean_square in misfit_by_channel(result.final).items():
        outputs = [output for run in result.likelihood.runs for output in run.outputs if output.name == name]
        deviation = float(np.sqrt(np.mean([output.data.var() for output in outputs])))
        residual = float(np.sqrt(max(0.0, mean_square - noise[name])))
        if not is_noise and residual > MAX_UNEXPLAINED_SHARE * deviation:
            parts.append(_describe_residual(name, residual / deviation))
        as_noise = float(np.sqrt(min(noise[name], mean_square)))
        stated = max(output.noise_sd or np.inf for output in outputs)
        if as_noise > max(MAX_UNEXPLAINED_SHARE * deviation, MAX_NOISE_RATIO * stated):
            share, ratio = as_noise / deviation, as_noise / stated
            parts.append(f"{share:.0%} of {name} (rms) counts as noise, {ratio:.0f} times the stated noise")
    return "; ".join(parts) or None


def _describe_residual(channel: str, ratio: float) -> str:
    """The residual of a channel over its standard deviation, in words."""
    if ratio >= 1.0:
        return f"the residual of {channel} is {ratio:.2g} times the signal"
    return f"{ratio:.0%} of {channel} is not explained"
