"""One finding of a diagnosis: an effect that the nominal device omits, its evidence and its rivals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from estimation.candidate_terms.discrepancy import is_discrepancy
from estimation.candidate_terms.screening import ScoreTest
from estimation.candidate_terms.significance import MIN_RIVAL_PROBABILITY, UNIQUE_NAME_THRESHOLD
from estimation.device_fit.fit import Fit, Likelihood
from estimation.device_fit.parameters import Candidate
from estimation.device_fit.profile_likelihood import profile_interval
from estimation.diagnosis.clipping import rail_resolution
from estimation.diagnosis.corrected_parameters import CorrectedParameters
from estimation.diagnosis.discrepancy_law import correction_curve
from estimation.diagnosis.experiment_design import discrimination_advice, distances_to_rivals
from estimation.diagnosis.free_decay import decay_advice, decay_confounders
from estimation.diagnosis.identifiability import DISCRIMINATION_SIGMA, determined_parameters
from estimation.diagnosis.localisation import describe_localisation
from estimation.diagnosis.selection import SelectionResult, SelectionStep
from estimation.diagnosis.shares import MIN_SHARE, share_of_finding

IMPERFECTION_SHARE = 0.0033
"""Share of the misfit, over that of the largest finding, at which a further law and an imperfection that no law
describes are equally probable. Models of real recordings leave out 0.3 to 3 % of a misfit: at 3 % a law has a
probability of 0.9."""

METRIC = "reduced chi-square of the whitened residual on samples not used in the fit"


@dataclass(frozen=True)
class ParameterEstimate:
    """One parameter of a term with its 95 % interval."""

    name: str
    value: float
    ci95: tuple[float, float]
    unit: str


@dataclass(frozen=True)
class Rival:
    """Another effect that may explain the data in place of a finding.

    Attributes:
        effect: its name.
        probability: posterior probability that it is the true effect; 0 for a confounder that was not compared.
        distance: norm of the finding's signal that remains if the rival is fitted to it [sigma]; None for an effect
            without a law and for the optics, where it is not computed.
        stage: of an ``unknown`` rival of an ``unknown`` finding; None for others.
    """

    effect: str
    probability: float
    distance: float | None = None
    stage: str | None = None


@dataclass(frozen=True)
class Finding:
    """One effect that the nominal device omits, with the keys of diagnosis.json (docs/reference/outputs.md)."""

    axis: str
    stage: str
    effect: str
    equation: str
    parameters: tuple[ParameterEstimate, ...]
    where: str
    probability: float
    rivals: tuple[Rival, ...]
    heldout: Mapping[str, Any]
    channel: str
    source: str
    share: float | None = None
    advice: str | None = None
    curve: Mapping[str, Any] | None = None


def find_effect(
    result: SelectionResult,
    step: SelectionStep,
    correction: ScoreTest | None,
    corrected: CorrectedParameters | None,
) -> Finding:
    """The finding of one step of a selection, with its probability, its rivals and the values of its parameters.

    Args:
        correction: of what the final fit leaves, see ``best_correction``.
        corrected: parameters of the final fit beside corrections, if it leaves more than noise.
    """
    candidate = step.candidate
    has_law = not is_discrepancy(candidate)
    effect = _name(candidate)
    probabilities = find_probabilities(step, correction.predicted_gain if correction else 0.0)
    elsewhere = () if has_law else _in_other_stages(step)
    distance = _distances(result, step) if has_law else {}
    comparable = [rival for rival in step.rivals if rival.candidate.key in distance]
    distance_of = {_name(rival.candidate): distance[rival.candidate.key] for rival in reversed(comparable)}
    fits_as_well = {_name(rival.candidate) for rival in comparable if rival.misfit_gap < DISCRIMINATION_SIGMA**2}
    rivals = tuple(
        Rival(name, probability, distance_of.get(name))
        for name, probability in sorted(probabilities.items(), key=lambda item: -item[1])
        # a rival that fits as well with more parameters is improbable, but the data do not exclude it
        if name != effect and (probability > MIN_RIVAL_PROBABILITY or name in fits_as_well)
    )
    advice = _advice(result, step, distance)
    known = {rival.effect for rival in rivals}
    confounders = decay_confounders(result.likelihood.runs, result.final.model.device, candidate)
    if unlisted := [confounder for confounder in confounders if confounder not in known]:
        rivals += tuple(Rival(confounder, probabilities.get(confounder, 0.0)) for confounder in unlisted)
        advice = "; ".join(filter(None, (advice, decay_advice(unlisted))))
    return Finding(
        axis=candidate.axis,
        stage=candidate.term.stage,
        effect=effect,
        equation=candidate.term.equation,
        parameters=parameter_estimates(result.likelihood, result.final, candidate, corrected) if has_law else (),
        where=describe_localisation(result.likelihood, candidate, step.before, step.after),
        probability=probabilities[effect] * (1.0 - sum(rival.probability for rival in elsewhere)),
        share=share_of_finding(result, step),
        rivals=(*(rival for rival in elsewhere if rival.probability > MIN_RIVAL_PROBABILITY), *rivals),
        heldout={"metric": METRIC, "before": step.before.validation_chi2, "after": result.final.validation_chi2},
        channel=candidate.channel,
        source=candidate.term.source,
        advice=advice,
        curve=None if has_law else correction_curve(step.after),
    )


def _in_other_stages(step: SelectionStep) -> tuple[Rival, ...]:
    """The rival of an ``unknown`` finding: the corrections of all other stages together, in its place.

    It has the stage of the one among them that is needed most.
    """
    return tuple(
        Rival("unknown", 1.0 / (1.0 + float(np.exp(0.5 * np.clip(rival.evidence_gap, -1400.0, 1400.0)))), stage=stage)
        for rival in step.rivals
        if is_discrepancy(rival.candidate) and (stage := rival.candidate.term.stage)
    )


def find_probabilities(step: SelectionStep, left: float) -> dict[str, float]:
    """Posterior probability of a finding's effect and of its rivals, by name; the rest is that of no effect.

    A law that is fitted beside a residual above the noise may only imitate a part of the effect behind that residual.
    The probability of this is taken as the part of the evidence that the law does not explain.

    Args:
        left: fall of -2 log evidence by a free correction of what all findings leave.
    """
    candidate = step.candidate
    fitted = bool(candidate.term.free_parameters)  # else detected in the samples
    weights = {_name(candidate): 1.0}  # evidence relative to that of the finding
    for rival in step.rivals:
        name = _name(rival.candidate)
        weights[name] = max(weights.get(name, 0.0), _evidence_ratio(rival.evidence_gap))
    total, explained = sum(weights.values()), step.before.neg2_log_evidence - step.after.neg2_log_evidence
    imitates = 0.0
    if fitted:
        total += _evidence_ratio(explained)
    if fitted and left > 0.0 and not is_discrepancy(candidate):
        imitates = left / (max(explained, 0.0) + left)
    probabilities = {name: (1.0 - imitates) * weight / total for name, weight in weights.items()}
    if imitates:
        probabilities["unknown"] = probabilities.get("unknown", 0.0) + imitates
    return probabilities


def beside_imperfections(findings: Sequence[Finding], fitted: Sequence[bool]) -> list[Finding]:
    """The findings, the largest share first, with the probability that a small one imitates an imperfection.

    No model of a real recording is exact. What an unlisted effect changes is small beside the largest finding, and the
    law that resembles it most fits it better than free corrections do, whatever the evidence: the smaller the share,
    the less it names the effect. Below ``MIN_SHARE`` the share is not determined.

    Args:
        fitted: of each finding, whether it was fitted and not recognised in the samples.
    """
    shares = [max(finding.share or 0.0, MIN_SHARE) for finding in findings]
    largest, result = max(shares, default=0.0), []
    for finding, share, is_fitted in zip(findings, shares, fitted, strict=True):
        imitates = IMPERFECTION_SHARE * largest / (share + IMPERFECTION_SHARE * largest) if share < largest else 0.0
        is_law = is_fitted and finding.effect != "unknown"
        result.append(_with_unknown_rival(finding, imitates) if is_law and imitates else finding)
    return sorted(result, key=lambda finding: -(finding.share or 0.0))


def _with_unknown_rival(finding: Finding, probability: float) -> Finding:
    """The finding with the probability that an unlisted effect is behind it, in addition to that of its rivals."""
    left = 1.0 - probability
    known = {rival.effect: replace(rival, probability=left * rival.probability) for rival in finding.rivals}
    unknown = known.get("unknown", Rival("unknown", 0.0))
    known["unknown"] = replace(unknown, probability=unknown.probability + probability)
    rivals = tuple(sorted(known.values(), key=lambda rival: -rival.probability))
    return replace(finding, probability=left * finding.probability, rivals=rivals)


def _evidence_ratio(gap: float) -> float:
    """Ratio of two evidences whose -2 logarithms differ by ``gap``; at most 1, without underflow."""
    return float(np.exp(-0.5 * np.clip(gap, 0.0, 1400.0)))


def _distances(result: SelectionResult, step: SelectionStep) -> dict[str, float]:
    """Distance of every named rival from the finding, by key of the candidate [sigma].

    It is computed from the rival's sensitivities, to first order, or from the misfit of the fitted rival if that is
    smaller.
    """
    present = {other.key for other in result.final.model.candidates}
    rival_fits = [
        rival for rival in step.rivals if not is_discrepancy(rival.candidate) and rival.candidate.key not in present
    ]
    rivals = [rival.candidate for rival in rival_fits]
    first_order = distances_to_rivals(result.likelihood, result.final, step.candidate, rivals)
    return {
        rival.candidate.key: min(distance, float(np.sqrt(max(rival.misfit_gap, 0.0))))
        for rival, distance in zip(rival_fits, first_order, strict=True)
    }


def _advice(result: SelectionResult, step: SelectionStep, distance: Mapping[str, float]) -> str | None:
    """What would distinguish the finding from its rivals: computed for the nearest, general advice for the others."""
    candidate = step.candidate
    effect = candidate.term.effect
    confusable = {
        rival.candidate.key: rival.candidate
        for rival in step.rivals
        if rival.candidate.term.effect != effect
        and (
            rival.evidence_gap < UNIQUE_NAME_THRESHOLD
            or distance.get(rival.candidate.key, np.inf) < DISCRIMINATION_SIGMA
        )
    }
    parts = []
    nearest = min(confusable, key=lambda key: distance.get(key, np.inf), default=None)
    if nearest is not None and distance.get(nearest, np.inf) < DISCRIMINATION_SIGMA:
        rival = confusable[nearest]
        parts.append(discrimination_advice(result.likelihood, result.final, candidate, rival, distance[nearest]))
        confusable = {key: other for key, other in confusable.items() if other.term.effect != rival.term.effect}
    for other in confusable.values():
        text = candidate.term.confounders.get(other.term.effect) or other.term.confounders.get(effect)
        parts += [f"{other.term.effect}: {text}"] if text else []
    return "; ".join(dict.fromkeys(parts)) or None  # a rival on several axes or channels once


def _name(candidate: Candidate) -> str:
    """Name of the effect in the findings; a discrepancy term is ``unknown``."""
    return "unknown" if is_discrepancy(candidate) else candidate.term.effect


def parameter_estimates(
    likelihood: Likelihood, fit: Fit, candidate: Candidate, corrected: CorrectedParameters | None
) -> tuple[ParameterEstimate, ...]:
    """Physical values of a candidate's parameters with their 95 % intervals, by profile likelihood.

    The values are those of the improved device; nominal values that the recording does not determine are as stated.
    If the fit leaves more than noise, the intervals are extended to those beside corrections of all stages.
    """
    scales = fit.model.scales(candidate.axis)
    values = fit.model.values(candidate, determined_parameters(fit))
    resolution = rail_resolution(likelihood.runs, candidate)
    estimates = []
    for parameter, value in zip(candidate.term.parameters, values, strict=True):
        index = fit.model.index("term", candidate.key, parameter.name)
        ends = [value - resolution, value + resolution]
        if index is not None:
            interval = profile_interval(likelihood, fit, index)
            interval = corrected.widen(index, interval) if corrected else interval
            # along nominal values that the recording does not determine, the value may leave the interval of the fit
            ends = [value, *(parameter.value(parameter.possible(end), scales) for end in interval)]
        estimates.append(
            ParameterEstimate(parameter.name, float(value), (float(min(ends)), float(max(ends))), parameter.unit)
        )
    return tuple(estimates)
