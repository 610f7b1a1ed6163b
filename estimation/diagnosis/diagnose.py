"""The diagnosis: verdict, findings with their evidence, and the device that keeps what was found."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from estimation.diagnosis.clipping import rail_resolution
from estimation.diagnosis.data import prepare_run
from estimation.diagnosis.decomposition import remainder, share, unexplained
from estimation.diagnosis.discrepancy import DISCREPANCY_TERMS
from estimation.diagnosis.discrepancy_law import correction_curve
from estimation.diagnosis.experiment_design import discrimination_advice, distances_to_rivals
from estimation.diagnosis.fit import Fit, Likelihood
from estimation.diagnosis.identifiability import DISCRIMINATION_SIGMA, determined_only
from estimation.diagnosis.improvement import improve
from estimation.diagnosis.localisation import describe_localisation
from estimation.diagnosis.model import Candidate
from estimation.diagnosis.profile_likelihood import profile_interval
from estimation.diagnosis.progressive_fit import UNIQUE_NAME_THRESHOLD
from estimation.diagnosis.selection import Progress, SelectionResult, SelectionStep, select_terms
from scanner.device import Device
from scanner.errors import BadInput
from scanner.recording import Recording
from scanner.terms import catalogue

SCHEMA = "lissajous-diagnosis/1"
METRIC = "reduced chi-square of the whitened residual on samples not used in the fit"

PULL_LIMIT = 1e-3
"""Probability of pulls on the nominal values as large as these, below which they are a mismatch by themselves."""


@dataclass(frozen=True)
class ParameterEstimate:
    """One parameter of a term with its 95 % interval."""

    name: str
    value: float
    ci95: tuple[float, float]
    unit: str


@dataclass(frozen=True)
class Rival:
    """Another effect in the finding's place: how probable it is, and what of the finding it cannot imitate [sigma].

    The distance is None where it was not worked out: for an effect without a law, and for the optics.
    """

    effect: str
    probability: float
    distance: float | None = None


@dataclass(frozen=True)
class Finding:
    """One effect that the nominal device leaves out, in the form of diagnosis.json."""

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


@dataclass(frozen=True)
class Diagnosis:
    """What came out.

    Attributes:
        verdict: ``"consistent"`` or ``"mismatch"``.
        findings: in order of weight.
        unexplained: what is left in words, None where nothing is.
        device: improved: nominal values as fitted, terms added.
        search: all fits behind it; None where the device states no mechanics that could be predicted.
        optics: what the recordings with an intensity can tell of the optics, a table of each.
    """

    verdict: str
    findings: tuple[Finding, ...]
    unexplained: str | None
    device: Device
    search: SelectionResult | None
    nominal: Mapping[str, Any] = field(default_factory=dict)
    remainder: Mapping[str, Any] | None = None
    open_loop: Mapping[str, Any] = field(default_factory=dict)
    optics: tuple[Mapping[str, Any], ...] = ()

    def __repr__(self) -> str:
        lines = [f"Diagnosis of {self.device.name!r}: {self.verdict}"]
        for finding in self.findings:
            values = ", ".join(f"{p.name} = {p.value:.4g} {p.unit}" for p in finding.parameters)
            lines.append(f"  {finding.axis} {finding.stage}: {finding.effect} ({finding.probability:.1%}), {values}")
        return "\n".join([*lines, *([f"  unexplained: {self.unexplained}"] if self.unexplained else [])])

    def to_json(self) -> dict[str, Any]:
        """The content of diagnosis.json."""
        return {
            "schema": SCHEMA,
            "verdict": self.verdict,
            "findings": [
                {key: value for key, value in asdict(finding).items() if value is not None or key == "rivals"}
                for finding in self.findings
            ],
            "unexplained": self.unexplained,
            "nominal": dict(self.nominal),
            "remainder": None if self.remainder is None else dict(self.remainder),
            "open_loop": dict(self.open_loop),
            "optics": list(self.optics),
        }


def diagnose(
    recordings: Sequence[Recording], device: Device | None = None, progress: Progress = lambda text: None
) -> Diagnosis:
    """Diagnose which effects on drive, mechanics, readout and timing the nominal device omits.

    Args:
        recordings: of one device; all are fitted together.
        device: the nominal one; None takes that of the first recording.
        progress: called with one line of text at every step.

    Raises:
        BadInput: no device, or a recording that cannot be compared with it.
    """
    nominal = nominal_device(recordings, device)
    runs = [prepare_run(recording, nominal) for recording in recordings]
    return build_diagnosis(select_terms(runs, nominal, catalogue(), progress))


def nominal_device(recordings: Sequence[Recording], device: Device | None) -> Device:
    """The stated device, or else that of the first recording.

    Raises:
        BadInput: neither is given.
    """
    nominal = device or recordings[0].device
    if nominal is None:
        hint = "give one with --device, or record it under /device"
        raise BadInput("states no device", file=recordings[0].path, hint=hint)
    return nominal


def build_diagnosis(found: SelectionResult) -> Diagnosis:
    """The statement that a search supports."""
    improvement = improve(found)
    found = improvement.search
    findings = [replace(_finding(found, each), share=share(found, each)) for each in found.steps]
    findings.sort(key=lambda each: -(each.share or 0.0))
    pulled = None if findings else _prior_tension_finding(found.final)
    if pulled is not None:
        findings.append(pulled)
    left = remainder(found)
    return Diagnosis(
        "mismatch" if findings or unexplained(found) else "consistent",
        tuple(findings),
        unexplained(found),
        improvement.device,
        found,
        _nominal(found.final),
        left,
        improvement.to_json(),
    )


def _finding(found: SelectionResult, each: SelectionStep) -> Finding:
    candidate = each.candidate
    unknown = candidate.term.effect in DISCREPANCY_TERMS
    effect = _name(candidate)
    options = {effect: 1.0}
    for lead in each.rivals:
        name = _name(lead.candidate)
        options[name] = max(options.get(name, 0.0), float(np.exp(-0.5 * np.clip(lead.evidence_gap, 0.0, 1400.0))))
    nothing = float(np.exp(-0.5 * np.clip(each.before.neg2_log_evidence - each.after.neg2_log_evidence, 0.0, 1400.0)))
    if not candidate.term.free_parameters:
        nothing = 0.0  # recognised in the samples, not by a fit
    total = sum(options.values()) + nothing
    distance = {} if unknown else _distances(found, each)
    named = [lead for lead in each.rivals if lead.candidate.key in distance]
    near = {_name(lead.candidate): distance[lead.candidate.key] for lead in reversed(named)}
    as_good = {_name(lead.candidate) for lead in named if lead.misfit_gap < DISCRIMINATION_SIGMA**2}
    rivals = tuple(
        Rival(name, weight / total, near.get(name))
        for name, weight in sorted(options.items(), key=lambda item: -item[1])
        # what fits as well, with more numbers, is improbable and yet not told apart
        if name != effect and (weight / total > 1e-4 or name in as_good)
    )
    return Finding(
        axis=candidate.axis,
        stage=candidate.term.stage,
        effect=effect,
        equation=candidate.term.equation,
        parameters=() if unknown else parameter_estimates(found.likelihood, found.final, candidate),
        where=describe_localisation(found.likelihood, candidate, each.before, each.after),
        probability=options[effect] / total,
        rivals=rivals,
        heldout={"metric": METRIC, "before": each.before.validation_chi2, "after": found.final.validation_chi2},
        channel=candidate.channel,
        source=candidate.term.source,
        advice=_advice(found, each, distance),
        curve=correction_curve(each.after) if unknown else None,
    )


def _distances(found: SelectionResult, each: SelectionStep) -> dict[str, float]:
    """How far each named rival stands from what was found, by key [sigma].

    By first order at the rival's usual shape, or by what its own best fit leaves, where that found a nearer one.
    """
    taken = {other.key for other in found.final.model.candidates}
    leads = [
        lead
        for lead in each.rivals
        if lead.candidate.term.effect not in DISCREPANCY_TERMS and lead.candidate.key not in taken
    ]
    rivals = [lead.candidate for lead in leads]
    first_order = distances_to_rivals(found.likelihood, found.final, each.candidate, rivals)
    return {
        lead.candidate.key: min(distance, float(np.sqrt(max(lead.misfit_gap, 0.0))))
        for lead, distance in zip(leads, first_order, strict=True)
    }


def _advice(found: SelectionResult, each: SelectionStep, distance: Mapping[str, float]) -> str | None:
    """What would tell the finding from the rivals that it cannot be told from: worked out for the nearest of them."""
    candidate = each.candidate
    effect = candidate.term.effect
    close = {
        lead.candidate.key: lead.candidate
        for lead in each.rivals
        if lead.candidate.term.effect != effect
        and (
            lead.evidence_gap < UNIQUE_NAME_THRESHOLD or distance.get(lead.candidate.key, np.inf) < DISCRIMINATION_SIGMA
        )
    }
    said = []
    nearest = min(close, key=lambda key: distance.get(key, np.inf), default=None)
    if nearest is not None and distance.get(nearest, np.inf) < DISCRIMINATION_SIGMA:
        said.append(
            discrimination_advice(found.likelihood, found.final, candidate, close.pop(nearest), distance[nearest])
        )
    for other in close.values():
        text = candidate.term.confounders.get(other.term.effect) or other.term.confounders.get(effect)
        said += [f"{other.term.effect}: {text}"] if text else []
    return "; ".join(said) or None


def _name(candidate: Candidate) -> str:
    return "unknown" if candidate.term.effect in DISCREPANCY_TERMS else candidate.term.effect


def parameter_estimates(likelihood: Likelihood, fit: Fit, candidate: Candidate) -> tuple[ParameterEstimate, ...]:
    """Physical values of a candidate's parameters with their 95 % intervals, by profile likelihood.

    The values are those of the improved device, whose undetermined nominal values are as stated.
    """
    scales = fit.model.scales(candidate.axis)
    values = fit.model.values(candidate, determined_only(fit))
    resolution = rail_resolution(likelihood.runs, candidate)
    found = []
    for parameter, value in zip(candidate.term.parameters, values, strict=True):
        at = fit.model.index("term", candidate.key, parameter.name)
        ends = [value - resolution, value + resolution]
        if at is not None:
            ends = [parameter.value(end, scales) for end in profile_interval(likelihood, fit, at)]
        found.append(
            ParameterEstimate(parameter.name, float(value), (float(min(ends)), float(max(ends))), parameter.unit)
        )
    return tuple(found)


def _pulls(fit: Fit) -> list[tuple[float, str, str]]:
    """(pull in tolerances, axis, ``stage.key``) of every nominal value, largest first."""
    pulls = [(float(fit.x[i]), f.owner, f.name) for i, f in enumerate(fit.model.parameters) if f.kind == "nominal"]
    return sorted(pulls, key=lambda pull: -abs(pull[0]))


def _prior_tension_finding(fit: Fit) -> Finding | None:
    """Nominal values that would have to lie further off than their tolerances allow, though no term explains it."""
    from scipy.stats import chi2

    pulls = _pulls(fit)
    if chi2.sf(sum(pull**2 for pull, _, _ in pulls), len(pulls)) > PULL_LIMIT:
        return None
    size, axis, name = pulls[0]
    return Finding(
        axis=axis,
        stage=name.partition(".")[0],
        effect="unknown",
        equation=f"{name} off by {size:+.1f} tolerances",
        parameters=(),
        where=f"{name} must lie {size:+.1f} of its tolerances off to explain the recording; the residual is clean",
        probability=1.0,
        rivals=(),
        heldout={"metric": METRIC, "before": fit.validation_chi2, "after": fit.validation_chi2},
        channel="sense",
        source="pull on a prior",
        curve={"x": "nominal value", "y": "pull / tolerance", "points": [[n, p] for p, _, n in pulls]},
    )


def _nominal(fit: Fit) -> dict[str, Any]:
    return {f"{axis}.{name}": {"pull": size} for size, axis, name in _pulls(fit)}
