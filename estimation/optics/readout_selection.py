"""Which effect of the readout explains the phase error that a picture shows in the motion from the sense signal.

The self-crossings of a scan measure the phase of the mirror without the readout. The errors of the estimated motion,
y = (β_x, β_y), are averages over the scan. They are modelled as

    y = Σ f_i(x_i) + e,   x_i ~ N(0, 1),   e ~ N(0, C),

where f_i is the change of the estimated phase by a term of the catalogue of size x_i. It is found by estimating the
motion with that term in the device, so that any readout and any estimator is handled alike. C contains the uncertainty
of the picture and that of the estimator. The corner frequencies of the readout are in every set of effects, with their
tolerance: a value within its tolerance is calibration. Sets of effects are compared by their evidence. The two axes
have different frequencies, which distinguishes effects that grow with the frequency from feedthrough of one drive.
Effects that act alike at both frequencies, as a delay and a lag far above them do, are rivals. Sets of effects that the
picture alone does not tell apart are compared by the evidence of the sense signal too: its harmonics may.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from estimation.candidate_terms.significance import DETECTION_THRESHOLD
from estimation.diagnosis.finding import Finding, ParameterEstimate
from estimation.least_squares import Z_95, eliminate_backward
from estimation.optics.readout_effects import (
    ReadoutEffect,
    ReferencePhase,
    calibrations_of,
    candidate_terms,
    effects_beside_the_readout,
    estimator_variance,
    natural_scales,
    phase_change,
    term_values,
    with_readout_effects,
)
from estimation.optics.reporting import EffectDescription, build_finding
from scanner.arrays import Array
from scanner.device import AXES, Device
from scanner.terms import NaturalScales, Term

TRIAL_SIZE = 0.1
"""Size of an effect, in natural sizes, at which its sensitivity is evaluated: phases of a tenth of a degree to a
degree."""

MAX_SIZE = 4.0
"""Largest size that is tried, in natural sizes."""

MAX_EFFECTS = 2
"""Effects that two phase errors can determine."""

UNDETERMINED_SD_RAD = math.pi
"""Standard deviation of a phase error that the picture does not determine."""

SenseEvidence = Callable[[Device], float]
"""-2 log evidence of the sense signal under a device, up to a constant."""

HELDOUT_METRIC = (
    "mean squared phase error of forward against backward half-periods, in standard errors, in every second part of "
    "the scan; the effects were fitted to the other parts"
)


@dataclass(frozen=True)
class _Posterior:
    """Sizes of each effect, their standard deviations, what the priors leave of the phase errors (chi-square), and
    -2 log evidence (infinite if a sign is impossible)."""

    sizes: list[Array]
    sds: list[Array]
    chi2: float
    neg2_log_evidence: float


@dataclass(frozen=True)
class _Data:
    """The data that effects are compared by.

    Attributes:
        value: phase errors y, shape (2,) [rad].
        covariance: C, shape (2, 2) [rad²].
        calibrations: effects that every set of effects has.
        sense: -2 log evidence of the sense signal, by the sets for which it was evaluated.
    """

    value: Array
    covariance: Array
    calibrations: list[ReadoutEffect]
    sense: Mapping[frozenset[ReadoutEffect], float] = field(default_factory=dict)

    def posterior(self, effects: Sequence[ReadoutEffect]) -> _Posterior:
        """Posterior of the sizes of the calibrations and ``effects``."""
        everything = [*self.calibrations, *effects]
        residual = self.value - sum((e.change(np.zeros_like(e.anchor)) for e in everything), np.zeros(2))
        slope = np.hstack([np.zeros((2, 0)), *(effect.slope for effect in everything)])
        total = self.covariance + slope @ slope.T
        mean = slope.T @ np.linalg.solve(total, residual)
        covariance = np.eye(slope.shape[1]) - slope.T @ np.linalg.solve(total, slope)
        chi2 = float(residual @ np.linalg.solve(total, residual))
        neg2 = chi2 + float(np.linalg.slogdet(total)[1])
        ends = np.cumsum([effect.anchor.size for effect in everything], dtype=int)
        sizes, sds = (np.split(each, ends)[: ends.size] for each in (mean, np.sqrt(np.diag(covariance))))
        impossible = any(effect.has_wrong_sign(size) for effect, size in zip(everything, sizes, strict=True))
        return _Posterior(sizes, sds, chi2, math.inf if impossible else neg2)

    def neg2_log_evidence(self, effects: Sequence[ReadoutEffect]) -> float:
        """-2 log evidence of the calibrations and ``effects``, up to a constant.

        Sets for which the sense signal was not evaluated have the best evidence of those for which it was.
        """
        of_sense = self.sense.get(frozenset(effects), min(self.sense.values(), default=0.0))
        return self.posterior(effects).neg2_log_evidence + of_sense


def diagnose_readout(
    reference: ReferencePhase, sense_evidence: SenseEvidence = lambda device: 0.0
) -> tuple[tuple[Finding, ...], Device]:
    """Find the effects of the readout that the phase errors of a motion demand.

    Args:
        reference: the phase errors.
        sense_evidence: compares devices that the picture does not tell apart.

    Returns:
        Findings in order of evidence, and the improved device, with their terms and calibrated corner frequencies;
        without a finding the device is unchanged.
    """
    if not demands_an_effect(reference):
        return (), reference.device
    data = _measured(reference)
    scales = {axis: natural_scales(reference, axis) for axis in AXES}
    candidates = [_linearise(reference, each, scales, data) for each in candidate_terms(reference, scales)]
    candidates += effects_beside_the_readout(scales)
    selected = _select(data, candidates)
    if not any(effect.is_readout for effect in selected):  # calibration or the optics explain the phase errors
        return (), reference.device
    near = {frozenset(one): one for one in (selected, *_near_exchanges(data, selected, candidates))}
    if len(near) > 1:
        sized = {key: _size_together(reference, data, one, scales)[1] for key, one in near.items()}
        data = replace(data, sense={key: sense_evidence(device) for key, device in sized.items()})
        selected = min(near.values(), key=data.neg2_log_evidence)
    return _report(reference, data, selected, candidates, scales)


def demands_an_effect(reference: ReferencePhase) -> bool:
    """Whether phase errors exceed what their uncertainty and the tolerance of the corner frequencies explain.

    No effect can gain more evidence than the chi-square that these leave.
    """
    return _measured(reference).posterior([]).chi2 > DETECTION_THRESHOLD


def _measured(reference: ReferencePhase) -> _Data:
    """The phase errors with their covariance; those that the picture does not determine are zero."""
    value = np.where(np.isfinite(reference.sd), np.nan_to_num(reference.value), 0.0)
    picture_sd = np.minimum(reference.sd, UNDETERMINED_SD_RAD)
    covariance = np.diag(picture_sd**2 + estimator_variance(reference.motion))
    return _Data(value, covariance, calibrations_of(reference))


def _near_exchanges(
    data: _Data, selected: Sequence[ReadoutEffect], candidates: Sequence[ReadoutEffect]
) -> list[list[ReadoutEffect]]:
    """Sets with one effect exchanged for another of the readout, which the picture does not exclude."""
    limit = data.neg2_log_evidence(selected) + DETECTION_THRESHOLD
    others = [each for each in candidates if each.is_readout and each not in selected]
    sets = [[*(e for e in selected if e is not removed), other] for removed in selected for other in others]
    return [one for one in sets if data.neg2_log_evidence(one) < limit]


def _linearise(
    reference: ReferencePhase, which: tuple[str, Term], scales: Mapping[str, NaturalScales], data: _Data
) -> ReadoutEffect:
    """The effect of a term, linear about the size at which it explains the phase errors best by itself."""
    axis, term = which
    k = len(term.free_parameters)

    def response(x: Array) -> Array:
        values = term_values(term, x, scales[axis])
        return phase_change(reference, reference.device.with_terms({axis: {term.effect: values}}))

    slope = np.stack([response(TRIAL_SIZE * row) for row in np.eye(k)], axis=1) / TRIAL_SIZE
    effect = ReadoutEffect(term, term.effect, axis, np.zeros(k), np.zeros(2), slope)
    size = data.posterior([effect]).sizes[-1]
    if k > 1 or not TRIAL_SIZE < np.abs(size[0]) < MAX_SIZE or effect.has_wrong_sign(size):
        return effect
    at_size = response(size)
    return replace(effect, anchor=size, response=at_size, slope=at_size[:, None] / size)


def _select(data: _Data, candidates: Sequence[ReadoutEffect]) -> list[ReadoutEffect]:
    """Select effects stepwise by evidence, as for the optics."""
    selected: list[ReadoutEffect] = []
    best = data.neg2_log_evidence(selected)
    while len(selected) < MAX_EFFECTS:
        rest = [each for each in candidates if each not in selected]
        scores = [data.neg2_log_evidence([*selected, each]) for each in rest]
        if best - min(scores) < DETECTION_THRESHOLD:
            break
        together = [*selected, rest[int(np.argmin(scores))]]
        selected, best = eliminate_backward(
            together, data.neg2_log_evidence, range(len(selected)), max_increase=DETECTION_THRESHOLD
        )
    return selected


def _size_together(
    reference: ReferencePhase,
    data: _Data,
    selected: Sequence[ReadoutEffect],
    scales: Mapping[str, NaturalScales],
) -> tuple[_Data, Device]:
    """The data corrected for what effects change together beyond the sum of each, and the device with their sizes."""
    everything = [*data.calibrations, *selected]
    sizes = data.posterior(selected).sizes
    changed = with_readout_effects(reference.device, everything, sizes, scales)
    predicted = sum((e.change(x) for e, x in zip(everything, sizes, strict=True) if e.is_in_device), np.zeros(2))
    joint = replace(data, value=data.value - (phase_change(reference, changed) - predicted))
    return joint, with_readout_effects(reference.device, everything, joint.posterior(selected).sizes, scales)


def _report(
    reference: ReferencePhase,
    data: _Data,
    selected: list[ReadoutEffect],
    candidates: Sequence[ReadoutEffect],
    scales: Mapping[str, NaturalScales],
) -> tuple[tuple[Finding, ...], Device]:
    """Findings of the selected effects of the readout, and the improved device."""
    everything = [*data.calibrations, *selected]
    joint, device = _size_together(reference, data, selected, scales)
    posterior = joint.posterior(selected)
    heldout = _heldout(reference, joint, selected)
    explained = [e.change(x) for e, x in zip(everything, posterior.sizes, strict=True)]
    left = joint.value - sum(explained, np.zeros(2))
    nominal, complete = float(data.value @ data.value), float(left @ left)
    evidence = data.neg2_log_evidence(selected)
    findings = []
    for effect, size, sd, part in zip(everything, posterior.sizes, posterior.sds, explained, strict=True):
        if effect.term is None or not effect.is_readout:
            continue
        others = [each for each in selected if each is not effect]
        replaced = [(data.neg2_log_evidence([*others, each]), each.name) for each in candidates if each not in selected]
        rivals = [(other - evidence, name) for other, name in replaced if math.isfinite(other)]
        gain = data.neg2_log_evidence(others) - evidence
        description = EffectDescription(
            effect.axis,
            effect.term.stage,
            effect.name,
            effect.term.equation,
            effect.term.source,
            _parameter_estimates(effect.term, size, sd, scales[effect.axis]),
            _where(reference, part),
        )
        share = min((float((left + part) @ (left + part)) - complete) / (nominal - complete), 1.0)
        findings.append((gain, replace(build_finding(description, gain, rivals, heldout), share=share)))
    findings.sort(key=lambda pair: -pair[0])
    return tuple(finding for _, finding in findings), device


def _where(reference: ReferencePhase, part: Array) -> str:
    """The phase errors in words, with the part that one effect explains."""
    shown = "; ".join(
        f"{axis} {np.degrees(error):.3g}° ± {np.degrees(sd):.1g}°, of which this effect explains {explained:.3g}°"
        for axis, error, sd, explained in zip(AXES, reference.value, reference.sd, np.degrees(part), strict=True)
        if np.isfinite(sd)
    )
    return f"the picture shows the mirror ahead of the motion that the sense signal gives: {shown}"


def _parameter_estimates(term: Term, size: Array, sd: Array, scales: NaturalScales) -> tuple[ParameterEstimate, ...]:
    """Physical values of the free parameters with their 95 % intervals."""
    found = []
    for parameter, x, x_sd in zip(term.free_parameters, size, sd, strict=True):
        ends = [x - Z_95 * x_sd, x + Z_95 * x_sd]
        if parameter.sign * ends[0] < 0.0:
            ends[0] = 1e-3 * x
        low, high = sorted(float(parameter.value(end, scales)) for end in ends)
        found.append(ParameterEstimate(parameter.name, float(parameter.value(x, scales)), (low, high), parameter.unit))
    return tuple(found)


def _heldout(reference: ReferencePhase, data: _Data, effects: list[ReadoutEffect]) -> dict[str, object]:
    """Mean squared phase error of every second part before and after the effects, fitted to the other parts."""
    weight = 1.0 / (reference.part_sd**2 + estimator_variance(reference.motion))
    parts = np.where(weight > 0.0, np.nan_to_num(reference.part_value), 0.0)
    fitted, used = parts[0::2], weight[0::2]
    value = (used * fitted).sum(axis=0) / np.maximum(used.sum(axis=0), np.finfo(float).tiny)
    joint_change = reference.value - data.value
    sizes = replace(data, value=value - np.nan_to_num(joint_change)).posterior(effects).sizes
    everything = [*data.calibrations, *effects]
    predicted = sum((e.change(x) for e, x in zip(everything, sizes, strict=True)), np.nan_to_num(joint_change))
    before, after = (float(np.mean((weight * (parts - model) ** 2)[1::2])) for model in (np.zeros(2), predicted))
    return {"metric": HELDOUT_METRIC, "before": before, "after": after}
