"""The diagnosis: verdict, findings with their evidence, and the improved device."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from estimation.device_fit.data import prepare_run
from estimation.device_fit.fit import Fit, Likelihood, nominal_values_are_improbable
from estimation.device_fit.open_loop import open_loop
from estimation.device_fit.parameters import Candidate
from estimation.device_fit.profile_likelihood import profile_interval
from estimation.diagnosis.clipping import rail_resolution
from estimation.diagnosis.discrepancy import is_discrepancy
from estimation.diagnosis.discrepancy_law import correction_curve
from estimation.diagnosis.experiment_design import discrimination_advice, distances_to_rivals
from estimation.diagnosis.gain_drift import GAIN_DRIFT_ADVICE, may_be_gain_drift
from estimation.diagnosis.identifiability import DISCRIMINATION_SIGMA, determined_parameters
from estimation.diagnosis.improvement import improve
from estimation.diagnosis.localisation import describe_localisation
from estimation.diagnosis.selection import Progress, SelectionResult, SelectionStep, select_terms
from estimation.diagnosis.shares import describe_unexplained, find_remainder, share_of_finding
from estimation.diagnosis.significance import UNIQUE_NAME_THRESHOLD
from estimation.diagnosis.structure import describe_modes, with_driven_modes
from scanner.device import Device
from scanner.errors import BadInput
from scanner.recording import Recording
from scanner.terms import catalogue

SCHEMA = "lissajous-diagnosis/1"
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
        probability: posterior probability that it is the true effect.
        distance: norm of the finding's signal that remains if the rival is fitted to it [sigma]; None for an effect
            without a law and for the optics, where it is not computed.
    """

    effect: str
    probability: float
    distance: float | None = None


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


@dataclass(frozen=True)
class Diagnosis:
    """Result of a diagnosis.

    Attributes:
        verdict: ``"consistent"`` or ``"mismatch"``.
        findings: the largest share of the misfit first.
        unexplained: the unexplained misfit in words, None if there is none.
        device: the improved device, with fitted nominal values and the terms of the findings.
        search: the fits of the selection; None if the device states no mechanics, so that no motion can be predicted.
        nominal: deviation of every nominal value from the stated one, in tolerances.
        remainder: share, stage and channel of the largest misfit that no finding explains, None if there is none.
        open_loop: prediction error of the nominal and the improved device, by channel.
        optics: effects on the picture, for every recording with an intensity.
        further_modes: see :func:`estimation.diagnosis.structure.describe_modes`.
        untested: what the recordings do not test, with the reason, in words; None if everything is tested.
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
    further_modes: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    untested: str | None = None

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
                {key: value for key, value in asdict(finding).items() if value is not None or key == "share"}
                for finding in self.findings
            ],
            "unexplained": self.unexplained,
            "nominal": dict(self.nominal),
            "remainder": None if self.remainder is None else dict(self.remainder),
            "open_loop": dict(self.open_loop),
            "optics": list(self.optics),
            "further_modes": {name: dict(modes) for name, modes in self.further_modes.items()},
            "untested": self.untested,
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
    extended = with_driven_modes(runs, nominal)
    diagnosis = build_diagnosis(select_terms(runs, extended, catalogue(), progress))
    if extended is nominal:
        return diagnosis
    nominal_loops = {name: loop.to_json() for name, loop in open_loop(runs, nominal).items()}
    loops = {name: {**both, "nominal": nominal_loops[name]} for name, both in diagnosis.open_loop.items()}
    modes = describe_modes(runs, nominal, extended)
    return replace(diagnosis, verdict="mismatch", open_loop=loops, further_modes=modes)


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


def build_diagnosis(result: SelectionResult) -> Diagnosis:
    """Verdict, findings and improved device from the result of a selection."""
    improvement = improve(result)
    result = improvement.search
    findings = [replace(_finding(result, step), share=share_of_finding(result, step)) for step in result.steps]
    findings.sort(key=lambda finding: -(finding.share or 0.0))
    tension = None if findings else _prior_tension_finding(result.final)
    if tension is not None:
        findings.append(tension)
    unexplained = describe_unexplained(result)
    return Diagnosis(
        "mismatch" if findings or unexplained else "consistent",
        tuple(findings),
        unexplained,
        improvement.device,
        result,
        {f"{axis}.{name}": {"pull": pull} for pull, axis, name in _pulls(result.final)},
        find_remainder(result),
        improvement.to_json(),
    )


def _finding(result: SelectionResult, step: SelectionStep) -> Finding:
    candidate = step.candidate
    has_law = not is_discrepancy(candidate)
    effect = _name(candidate)
    weights = {effect: 1.0}  # evidence relative to that of the finding
    for rival in step.rivals:
        name = _name(rival.candidate)
        weights[name] = max(weights.get(name, 0.0), _evidence_ratio(rival.evidence_gap))
    without_effect = _evidence_ratio(step.before.neg2_log_evidence - step.after.neg2_log_evidence)
    if not candidate.term.free_parameters:
        without_effect = 0.0  # detected in the samples, not by a fit
    total = sum(weights.values()) + without_effect
    distance = _distances(result, step) if has_law else {}
    comparable = [rival for rival in step.rivals if rival.candidate.key in distance]
    distance_of = {_name(rival.candidate): distance[rival.candidate.key] for rival in reversed(comparable)}
    fits_as_well = {_name(rival.candidate) for rival in comparable if rival.misfit_gap < DISCRIMINATION_SIGMA**2}
    rivals = tuple(
        Rival(name, weight / total, distance_of.get(name))
        for name, weight in sorted(weights.items(), key=lambda item: -item[1])
        # a rival that fits as well with more parameters is improbable, but the data do not exclude it
        if name != effect and (weight / total > 1e-4 or name in fits_as_well)
    )
    advice = _advice(result, step, distance)
    if may_be_gain_drift(result.likelihood.runs, result.final.model.device, candidate) and "gain-drift" not in {
        rival.effect for rival in rivals
    }:
        rivals, advice = (*rivals, Rival("gain-drift", 0.0)), "; ".join(filter(None, (advice, GAIN_DRIFT_ADVICE)))
    return Finding(
        axis=candidate.axis,
        stage=candidate.term.stage,
        effect=effect,
        equation=candidate.term.equation,
        parameters=parameter_estimates(result.likelihood, result.final, candidate) if has_law else (),
        where=describe_localisation(result.likelihood, candidate, step.before, step.after),
        probability=weights[effect] / total,
        rivals=rivals,
        heldout={"metric": METRIC, "before": step.before.validation_chi2, "after": result.final.validation_chi2},
        channel=candidate.channel,
        source=candidate.term.source,
        advice=advice,
        curve=None if has_law else correction_curve(step.after),
    )


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
        parts.append(
            discrimination_advice(
                result.likelihood, result.final, candidate, confusable.pop(nearest), distance[nearest]
            )
        )
    for other in confusable.values():
        text = candidate.term.confounders.get(other.term.effect) or other.term.confounders.get(effect)
        parts += [f"{other.term.effect}: {text}"] if text else []
    return "; ".join(parts) or None


def _name(candidate: Candidate) -> str:
    """Name of the effect in the findings; a discrepancy term is ``unknown``."""
    return "unknown" if is_discrepancy(candidate) else candidate.term.effect


def parameter_estimates(likelihood: Likelihood, fit: Fit, candidate: Candidate) -> tuple[ParameterEstimate, ...]:
    """Physical values of a candidate's parameters with their 95 % intervals, by profile likelihood.

    The values are those of the improved device; nominal values that the recording does not determine are as stated.
    """
    scales = fit.model.scales(candidate.axis)
    values = fit.model.values(candidate, determined_parameters(fit))
    resolution = rail_resolution(likelihood.runs, candidate)
    estimates = []
    for parameter, value in zip(candidate.term.parameters, values, strict=True):
        index = fit.model.index("term", candidate.key, parameter.name)
        ends = [value - resolution, value + resolution]
        if index is not None:
            ends = [parameter.value(end, scales) for end in profile_interval(likelihood, fit, index)]
        estimates.append(
            ParameterEstimate(parameter.name, float(value), (float(min(ends)), float(max(ends))), parameter.unit)
        )
    return tuple(estimates)


def _pulls(fit: Fit) -> list[tuple[float, str, str]]:
    """Pull, the deviation from the stated value in tolerances, with axis and ``stage.key`` of every nominal value.

    The largest comes first.
    """
    pulls = [(float(fit.x[i]), f.owner, f.name) for i, f in enumerate(fit.model.parameters) if f.kind == "nominal"]
    return sorted(pulls, key=lambda pull: -abs(pull[0]))


def _prior_tension_finding(fit: Fit) -> Finding | None:
    """A finding for nominal values that deviate from the stated ones by more than their tolerances allow.

    None if the deviations are probable.
    """
    if not nominal_values_are_improbable(fit):
        return None
    pulls = _pulls(fit)
    size, axis, name = pulls[0]
    return Finding(
        axis=axis,
        stage=name.partition(".")[0],
        effect="unknown",
        equation=f"{name} off by {size:+.1f} tolerances",
        parameters=(),
        where=f"{name} must deviate by {size:+.1f} tolerances to explain the recording; the residual is noise",
        probability=1.0,
        rivals=(),
        heldout={"metric": METRIC, "before": fit.validation_chi2, "after": fit.validation_chi2},
        channel="sense",
        source="pull on a prior",
        curve={"x": "nominal value", "y": "pull / tolerance", "points": [[n, p] for p, _, n in pulls]},
    )
