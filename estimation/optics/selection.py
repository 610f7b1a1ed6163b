"""Which optics effects the intensity samples of a scan demand: samples of one place must agree at all times.

The scene is unknown, so only the consistency of the samples is tested. One fit of all parameters that the samples
determine, with the scene unknown (``estimation.optics.fit``), gives a Gaussian likelihood of how far each axis's motion
lags, how the light decays and how the sample drifts. Each effect is a direction among those parameters, and sets of
effects are compared by their evidence:

* no effect: the parameters lie within the estimator's phase error, the tolerance of the readout's corner frequencies
  and the errors that detail below a cell causes;
* delayed intensity: both axes lag by one time;
* phase error of one axis: that axis alone lags, or the detector that measures its motion does;
* bleaching: the light decays;
* sample motion: half-periods of both directions are displaced equally along one axis.

A detector's lag delays and smooths; a second fit through the detector's low-pass distinguishes it from a delay. A
distorted field or a wrong amplitude changes all pictures of a scene in the same way and cannot be detected without a
known target.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from estimation.candidate_terms.significance import DETECTION_THRESHOLD
from estimation.diagnosis.finding import Finding
from estimation.diagnosis.identifiability import DISCRIMINATION_SIGMA
from estimation.least_squares import GaussianPosterior, eliminate_backward, gaussian_posterior
from estimation.optics.candidates import OpticsEffect, candidate_effects
from estimation.optics.fit import fit_optics
from estimation.optics.measurement import MEASURED_PARAMETERS, fit_from_best_start, nominal_covariance
from estimation.optics.reporting import (
    build_finding,
    catalogue_name,
    describe_effect,
    discriminate_delay_from_lag,
    has_permitted_sign,
)
from estimation.optics.samples import (
    NOMINAL,
    OpticsParameters,
    ScanSamples,
    read_scan,
)
from estimation.optics.scene import CellVariances
from scanner.arrays import Array
from scanner.channel import Channel
from scanner.device import AXES, Device
from scanner.motion import Motion
from scanner.terms import catalogue

VALIDATION_METRIC = "reduced chi-square of the intensity about the best picture, on blocks of time not used in the fit"

MAX_EFFECTS = 4
"""Largest number of effects reported; the nine fitted parameters do not determine more independent ones."""


MIN_SQUARED_CORRELATION = 0.99
"""Squared correlation of the signals of two effects from which they have the same direction: no sample distinguishes
them, and only the sign that their terms permit decides."""


@dataclass(frozen=True)
class OpticsDetectability:
    """Size of an effect of natural amplitude in this recording, in standard deviations of its estimate."""

    effect: str
    axis: str
    sigma: float


@dataclass(frozen=True)
class OpticsDiagnosis:
    """What the intensity says about the optics.

    Attributes:
        findings: in order of evidence.
        detectability: of each effect in this recording.
        terms: for the improved device: axis -> effect -> parameter -> value.
    """

    findings: tuple[Finding, ...]
    detectability: tuple[OpticsDetectability, ...]
    terms: Mapping[str, Mapping[str, Mapping[str, float]]]

    def to_json(self) -> list[dict[str, object]]:
        """Which effects this recording could show, for diagnosis.json."""
        return [
            {"effect": v.effect, "axis": v.axis, "sigma": v.sigma, "detectable": v.sigma >= DISCRIMINATION_SIGMA}
            for v in self.detectability
        ]


@dataclass(frozen=True)
class GaussianLikelihood:
    """The measured parameters p under the likelihood exp(-p' H p / 2 + s' p).

    Attributes:
        information: H, shape (m, m). score: s, shape (m,).
        prior: covariance of p without any effect, shape (m, m).
    """

    information: Array
    score: Array
    prior: Array

    def posterior(self, effects: list[OpticsEffect]) -> GaussianPosterior:
        """Posterior of (parameters, amplitudes of ``effects``), shape (m + e,), and its -2 log evidence."""
        m, e = len(MEASURED_PARAMETERS), len(effects)
        directions = np.array([_direction(effect) for effect in effects]).reshape(e, m)
        joint = np.vstack([np.eye(m), directions])
        prior = np.zeros((m + e, m + e))
        prior[:m, :m] = self.prior
        prior[range(m, m + e), range(m, m + e)] = [effect.size**2 for effect in effects]
        root = np.asarray(np.linalg.cholesky(prior), np.float64)
        return gaussian_posterior(joint @ self.information @ joint.T, joint @ self.score, root)

    def neg2_log_evidence(self, effects: list[OpticsEffect]) -> float:
        """-2 log evidence of a set of effects, up to a constant."""
        return self.posterior(effects).neg2_log_evidence


Rivals = dict[tuple[str, str], list[tuple[float, OpticsEffect]]]
"""(effect, axis) -> (difference in -2 log evidence, rival) of each effect that acts on the same parameters."""


def diagnose_optics(
    motion: Motion, intensity: Channel, device: Device, detectors: Mapping[str, str] = MappingProxyType({})
) -> OpticsDiagnosis:
    """Find the optics effects that the samples of a scan demand.

    Args:
        motion: of both axes, at the intensity's samples.
        device: nominal, for its tolerances.
        detectors: channel that measures the motion of an axis directly, by axis.
    """
    scan = read_scan({axis: motion.axes[axis].angle for axis in AXES}, intensity)
    rates = {axis: 2 * np.pi * float(np.median(motion.axes[axis].frequency)) for axis in AXES}
    variances, fit = fit_from_best_start(scan, rates)
    parameters = np.array([fit.parameters[name] for name in MEASURED_PARAMETERS])
    score = fit.information @ parameters + parameters / fit.prior_sd**2
    likelihood = GaussianLikelihood(fit.information, score, nominal_covariance(motion, device, rates, scan, variances))
    candidates = candidate_effects(scan, rates, detectors)
    selected, rivals = select_effects(likelihood, [effect for effect in candidates if effect.direction])
    selected = _validated(scan, variances, likelihood, selected)
    detectability = tuple(
        OpticsDetectability(effect.name, effect.axis, _sigma(likelihood, effect)) for effect in candidates
    )
    if not selected:
        return OpticsDiagnosis((), detectability, {})
    findings, terms = _report(scan, variances, likelihood, selected, rivals, rates, detectors)
    return OpticsDiagnosis(findings, detectability, terms)


def _report(
    scan: ScanSamples,
    variances: CellVariances,
    likelihood: GaussianLikelihood,
    selected: list[OpticsEffect],
    rivals: Rivals,
    rates: Mapping[str, float],
    detectors: Mapping[str, str],
) -> tuple[tuple[Finding, ...], dict[str, dict[str, dict[str, float]]]]:
    """Findings in order of evidence, and the terms that they add to the device."""
    mean, covariance, evidence = likelihood.posterior(selected)
    improved = _total_parameters(mean, selected)
    heldout = {
        "metric": VALIDATION_METRIC,
        "before": fit_optics(scan, {}, NOMINAL, variances, scan.finest_cells, 0).validation_chi2,
        "after": fit_optics(scan, {}, improved, variances, scan.finest_cells, 0).validation_chi2,
    }
    findings, terms = [], dict[str, dict[str, dict[str, float]]]()
    for i, effect in enumerate(selected, start=len(MEASURED_PARAMETERS)):
        amplitude, sd = float(mean[i]), float(np.sqrt(covariance[i, i]))
        others = [other for other in selected if other is not effect]
        gain = likelihood.neg2_log_evidence(others) - evidence
        description = describe_effect(effect, amplitude, sd, scan, rates)
        distances = [
            (distance, catalogue_name(rival, amplitude)) for distance, rival in rivals[effect.name, effect.axis]
        ]
        if description.effect == "intensity-delay":
            description, distance, other_name = discriminate_delay_from_lag(scan, description, amplitude, improved)
            distances.append((distance, other_name))
        findings.append((gain, build_finding(description, gain, distances, heldout)))
        values = {parameter.name: parameter.value for parameter in description.parameters}
        if values and description.effect in catalogue() and description.stage == "optics":
            terms.setdefault(description.axis, {})[description.effect] = values
        elif description.effect == "channel-delay":
            late = [effect.axis] if effect.name == "detector-delay" else AXES
            for axis in (axis for axis in late if axis in detectors):
                variant = catalogue()["channel-delay"].variants.index(detectors[axis].partition("_")[0])
                terms.setdefault(axis, {})["channel-delay"] = {**values, "variant": variant}
    findings.sort(key=lambda pair: -pair[0])
    return tuple(finding for _, finding in findings), terms


def select_effects(likelihood: GaussianLikelihood, candidates: list[OpticsEffect]) -> tuple[list[OpticsEffect], Rivals]:
    """Select effects stepwise by evidence: add the best, then remove those that it has made unnecessary.

    Returns:
        the effects, and the rivals of each.
    """
    selected: list[OpticsEffect] = []
    rivals: Rivals = {}
    best = likelihood.neg2_log_evidence([])
    while len(selected) < MAX_EFFECTS:
        scores = [
            (likelihood.neg2_log_evidence([*selected, effect]), effect)
            for effect in candidates
            if effect not in selected
        ]
        scores = _without_excluded_signs(likelihood, selected, scores)
        scores.sort(key=lambda pair: pair[0])
        if best - scores[0][0] < DETECTION_THRESHOLD:
            break
        best, added = scores[0]
        rivals[added.name, added.axis] = [
            (score - best, effect) for score, effect in scores[1:] if set(effect.direction) & set(added.direction)
        ]
        earlier = range(len(selected))
        selected, best = eliminate_backward(
            [*selected, added], likelihood.neg2_log_evidence, earlier, max_increase=DETECTION_THRESHOLD
        )
    return selected, rivals


def _without_excluded_signs(
    likelihood: GaussianLikelihood, selected: list[OpticsEffect], scores: list[tuple[float, OpticsEffect]]
) -> list[tuple[float, OpticsEffect]]:
    """The scores without effects of a sign that their term excludes, if another effect of the same direction permits
    it."""

    def permitted(effect: OpticsEffect) -> bool:
        return has_permitted_sign(effect, float(likelihood.posterior([*selected, effect]).mean[-1]))

    def same_direction(a: OpticsEffect, b: OpticsEffect) -> bool:
        directions = np.array([_direction(a), _direction(b)])
        gram = directions @ likelihood.information @ directions.T
        return bool(gram[0, 1] ** 2 > MIN_SQUARED_CORRELATION * gram[0, 0] * gram[1, 1])

    allowed = [effect for _, effect in scores if permitted(effect)]
    return [
        (score, effect)
        for score, effect in scores
        if effect in allowed or not any(same_direction(effect, other) for other in allowed)
    ]


def _validated(
    scan: ScanSamples, variances: CellVariances, likelihood: GaussianLikelihood, selected: list[OpticsEffect]
) -> list[OpticsEffect]:
    """The selected effects without whose amplitude samples left out of the fit are predicted worse."""
    mean = likelihood.posterior(selected).mean

    def error(amplitudes: Array) -> float:
        parameters = _total_parameters(np.concatenate([mean[: len(MEASURED_PARAMETERS)], amplitudes]), selected)
        return fit_optics(scan, {}, parameters, variances, scan.finest_cells, 0).validation_chi2

    amplitudes = mean[len(MEASURED_PARAMETERS) :]
    best = error(amplitudes)
    errors = [error(np.where(np.arange(len(selected)) == i, 0.0, amplitudes)) for i in range(len(selected))]
    return [effect for effect, without in zip(selected, errors, strict=True) if without > best]


def _total_parameters(mean: Array, effects: list[OpticsEffect]) -> OpticsParameters:
    """Optics parameters of a posterior mean of (measured parameters, amplitudes of ``effects``)."""
    m = len(MEASURED_PARAMETERS)
    total = mean[:m] + sum(
        (amplitude * _direction(effect) for amplitude, effect in zip(mean[m:], effects, strict=True)), np.zeros(m)
    )
    return {**NOMINAL, **dict(zip(MEASURED_PARAMETERS, total.tolist(), strict=True))}


def _direction(effect: OpticsEffect) -> Array:
    """Direction of an effect among the measured parameters, shape (m,)."""
    return np.array([effect.direction.get(name, 0.0) for name in MEASURED_PARAMETERS])


def _sigma(likelihood: GaussianLikelihood, effect: OpticsEffect) -> float:
    """Natural size of an effect over the standard deviation of its amplitude, with uncertain nominal parameters."""
    covariance = likelihood.prior + np.linalg.pinv(likelihood.information)
    direction = _direction(effect)
    return float(effect.size * np.sqrt(direction @ np.linalg.solve(covariance, direction)))
