"""The diagnosis: verdict, findings with their evidence, and the device that keeps what was found."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimation.mismatch.advice import advice, distances_from
from estimation.mismatch.experiment import experiment
from estimation.mismatch.fit import Comparison, Fit
from estimation.mismatch.free import FREE
from estimation.mismatch.intervals import profile_interval
from estimation.mismatch.law import correction_curve
from estimation.mismatch.model import Candidate
from estimation.mismatch.naming import LEAD_OVER_NEXT
from estimation.mismatch.search import Round, Search, search
from estimation.mismatch.sensitivity import APART
from estimation.mismatch.where import where
from scanner.device import Axis, Device
from scanner.errors import BadInput
from scanner.recording import Recording
from scanner.terms import catalogue

Array = NDArray[np.float64]

SCHEMA = "lissajous-diagnosis/1"
METRIC = "reduced chi-square of the whitened residual on samples not used in the fit"

PULL_LIMIT = 1e-3
"""Probability of pulls on the nominal values as large as these, below which they are a mismatch by themselves."""


@dataclass(frozen=True)
class Estimate:
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
    parameters: tuple[Estimate, ...]
    where: str
    probability: float
    rivals: tuple[Rival, ...]
    heldout: Mapping[str, Any]
    channel: str
    source: str
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
    search: Search | None
    nominal: Mapping[str, Any] = field(default_factory=dict)
    optics: tuple[Mapping[str, Any], ...] = ()

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
            "optics": list(self.optics),
        }


def diagnose(
    recordings: Sequence[Recording], device: Device | None = None, say: Callable[[str], None] = lambda text: None
) -> Diagnosis:
    """Hold recordings of one device against it.

    Args:
        device: nominal; by default that of the first recording.
        say: told what is being done.

    Raises:
        BadInput: no device, or a recording that cannot be compared with it.
    """
    device = device or recordings[0].device
    if device is None:
        hint = "give one with --device, or record it under /device"
        raise BadInput("states no device", file=recordings[0].path, hint=hint)
    runs = [experiment(recording, device) for recording in recordings]
    return judged(search(runs, device, catalogue(), say))


def judged(found: Search) -> Diagnosis:
    """The statement that a search supports."""
    findings = [_finding(found, each) for each in found.rounds]
    pulled = None if findings else _pulled(found.final)
    if pulled is not None:
        findings.append(pulled)
    order = sorted(
        range(len(findings)),
        key=lambda i: (
            -(found.rounds[i].before.evidence - found.rounds[i].after.evidence) if i < len(found.rounds) else 0.0
        ),
    )
    unexplained = None
    level = found.final.held_chi2
    if level > 1.3:
        unexplained = f"held-out reduced chi-square is still {level:.2f}"
    return Diagnosis(
        "mismatch" if findings else "consistent",
        tuple(findings[i] for i in order),
        unexplained,
        improved_device(found.final),
        found,
        _nominal(found.final),
    )


def _finding(found: Search, each: Round) -> Finding:
    candidate = each.candidate
    unknown = candidate.term.effect in FREE
    effect = _name(candidate)
    options = {effect: 1.0}
    for lead in each.leads:
        name = _name(lead.candidate)
        options[name] = max(options.get(name, 0.0), float(np.exp(-0.5 * np.clip(lead.behind, 0.0, 1400.0))))
    nothing = float(np.exp(-0.5 * np.clip(each.before.evidence - each.after.evidence, 0.0, 1400.0)))
    total = sum(options.values()) + nothing
    distance = {} if unknown else _distances(found, each)
    named = [lead for lead in each.leads if lead.candidate.key in distance]
    near = {_name(lead.candidate): distance[lead.candidate.key] for lead in reversed(named)}
    as_good = {_name(lead.candidate) for lead in named if lead.worse < APART**2}
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
        parameters=() if unknown else estimates(found.comparison, found.final, candidate),
        where=where(found.comparison, candidate, each.before, each.after),
        probability=options[effect] / total,
        rivals=rivals,
        heldout={"metric": METRIC, "before": each.before.held_chi2, "after": found.final.held_chi2},
        channel=candidate.channel,
        source=candidate.term.source,
        advice=_advice(found, each, distance),
        curve=correction_curve(each.after) if unknown else None,
    )


def _distances(found: Search, each: Round) -> dict[str, float]:
    """How far each named rival stands from what was found, by key [sigma].

    By first order at the rival's usual shape, or by what its own best fit leaves, where that found a nearer one.
    """
    taken = {other.key for other in found.final.model.candidates}
    leads = [lead for lead in each.leads if lead.candidate.term.effect not in FREE and lead.candidate.key not in taken]
    rivals = [lead.candidate for lead in leads]
    first_order = distances_from(found.comparison, found.final, each.candidate, rivals)
    return {
        lead.candidate.key: min(distance, float(np.sqrt(max(lead.worse, 0.0))))
        for lead, distance in zip(leads, first_order, strict=True)
    }


def _advice(found: Search, each: Round, distance: Mapping[str, float]) -> str | None:
    """What would tell the finding from the rivals that it cannot be told from: worked out for the nearest of them."""
    candidate = each.candidate
    effect = candidate.term.effect
    close = {
        lead.candidate.key: lead.candidate
        for lead in each.leads
        if lead.candidate.term.effect != effect
        and (lead.behind < LEAD_OVER_NEXT or distance.get(lead.candidate.key, np.inf) < APART)
    }
    said = []
    nearest = min(close, key=lambda key: distance.get(key, np.inf), default=None)
    if nearest is not None and distance.get(nearest, np.inf) < APART:
        said.append(advice(found.comparison, found.final, candidate, close.pop(nearest), distance[nearest]))
    for other in close.values():
        text = candidate.term.lookalikes.get(other.term.effect) or other.term.lookalikes.get(effect)
        said += [f"{other.term.effect}: {text}"] if text else []
    return "; ".join(said) or None


def _name(candidate: Candidate) -> str:
    return "unknown" if candidate.term.effect in FREE else candidate.term.effect


def estimates(comparison: Comparison, fit: Fit, candidate: Candidate) -> tuple[Estimate, ...]:
    """Physical values of a candidate's parameters with their 95 % intervals, by profile likelihood."""
    scales = fit.model.scales(candidate.axis)
    values = fit.model.values(candidate, fit.x)
    found = []
    for parameter, value in zip(candidate.term.parameters, values, strict=True):
        at = fit.model.index("term", candidate.key, parameter.name)
        ends = [value, value]
        if at is not None:
            ends = [parameter.value(end, scales) for end in profile_interval(comparison, fit, at)]
        found.append(Estimate(parameter.name, float(value), (float(min(ends)), float(max(ends))), parameter.unit))
    return tuple(found)


def _pulls(fit: Fit) -> list[tuple[float, str, str]]:
    """(pull in tolerances, axis, ``stage.key``) of every nominal value, largest first."""
    pulls = [(float(fit.x[i]), f.owner, f.name) for i, f in enumerate(fit.model.free) if f.kind == "nominal"]
    return sorted(pulls, key=lambda pull: -abs(pull[0]))


def _pulled(fit: Fit) -> Finding | None:
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
        heldout={"metric": METRIC, "before": fit.held_chi2, "after": fit.held_chi2},
        channel="sense",
        source="pull on a prior",
        curve={"x": "nominal value", "y": "pull / tolerance", "points": [[n, p] for p, _, n in pulls]},
    )


def _nominal(fit: Fit) -> dict[str, Any]:
    return {f"{axis}.{name}": {"pull": size} for size, axis, name in _pulls(fit)}


def improved_device(fit: Fit) -> Device:
    """The device with its nominal values as fitted, and the terms that were found under ``[x.terms.<effect>]``."""
    device = fit.model.device
    axes: dict[str, Axis] = dict(device.axes)
    shared = device.readout
    for name in fit.model.axes:
        made = fit.model.nominal(name, fit.x)
        if shared is not None:
            shared = made.readout if name == next(iter(device.axes)) else shared
            made = replace(made, readout=None)
        terms = {effect: dict(values) for effect, values in device.axis(name).terms.items()}
        for each in fit.model.candidates:
            if each.axis == name and each.term.effect not in FREE:
                values = fit.model.values(each, fit.x)
                terms[each.term.effect] = {p.name: float(v) for p, v in zip(each.term.parameters, values, strict=True)}
                if variant := each.term.channels.index(each.channel):
                    terms[each.term.effect]["variant"] = variant
        axes[name] = replace(made, terms=terms)
    return replace(device, axes=axes, readout=shared)
