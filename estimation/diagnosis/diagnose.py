"""The diagnosis: verdict, findings with their evidence, and the improved device."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from types import MappingProxyType
from typing import Any

from estimation.candidate_terms.significance import residual_is_noise
from estimation.device_fit.data import Run, prepare_run, sense_channel
from estimation.device_fit.fit import Fit, nominal_values_are_improbable
from estimation.device_fit.further_modes import describe_modes, with_driven_modes
from estimation.device_fit.hum import describe_strong_hum
from estimation.device_fit.open_loop import is_worse, open_loop
from estimation.device_fit.predict import finite_signals
from estimation.diagnosis.corrected_parameters import correct_parameters
from estimation.diagnosis.finding import METRIC, Finding, beside_imperfections, find_effect
from estimation.diagnosis.held_drive import with_held_drives
from estimation.diagnosis.improvement import improve
from estimation.diagnosis.remainder_law import with_remainder_law
from estimation.diagnosis.selection import Progress, SelectionResult, select_terms
from estimation.diagnosis.shares import (
    best_correction,
    channel_of_share,
    describe_unexplained,
    find_corrections,
    find_remainder,
    noise_by_channel,
)
from estimation.diagnosis.unit_check import check_units_and_signs
from estimation.parallel import map_fits
from estimation.signals import require_device
from scanner.device import Device
from scanner.recording import Recording
from scanner.terms import Term, catalogue

SCHEMA = "lissajous-diagnosis/1"


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
        noise: standard deviation of the noise, by channel, in its unit: no prediction has a smaller error.
        optics: effects on the picture, for every recording with an intensity.
        further_modes: see :func:`estimation.device_fit.further_modes.describe_modes`.
        hum: mains hum that is stronger than the noise, by channel, see
            :func:`estimation.device_fit.hum.describe_strong_hum`. It is taken as noise.
        untested: what the recordings do not test, with the reason, in words; None if everything is tested.
        remainder_fit: of a measured law of what the findings leave, if the improved device holds one.
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
    hum: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    untested: str | None = None
    remainder_fit: Fit | None = None
    noise: Mapping[str, float] = field(default_factory=dict)

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
            "noise": dict(self.noise),
            "optics": list(self.optics),
            "further_modes": {name: dict(modes) for name, modes in self.further_modes.items()},
            "hum": {name: dict(of) for name, of in self.hum.items()},
            "untested": self.untested,
        }


def diagnose(
    recordings: Sequence[Recording],
    device: Device | None = None,
    progress: Progress = lambda text: None,
    excluded: Collection[str] = (),
) -> Diagnosis:
    """Diagnose which effects on drive, mechanics, readout and timing the nominal device omits.

    Args:
        recordings: of one device; all are fitted together.
        device: the nominal one; None takes that of the first recording.
        progress: called with one line of text at every step.
        excluded: effects that are no candidates.

    Raises:
        BadInput: no device, a recording that cannot be compared with it, one in another unit or with another sign, or a
            stated term with which the motion diverges.
    """
    nominal = require_device(recordings[0], device)
    runs = [prepare_run(recording, nominal) for recording in recordings]
    check_units_and_signs(recordings, runs, nominal)
    if any(axis.terms for axis in nominal.axes.values()):
        for run in runs:
            finite_signals(run, nominal)
    diagnosis = _diagnose_with_modes(runs, nominal, progress, excluded)
    return replace(diagnosis, findings=with_held_drives(diagnosis.findings, recordings, nominal))


def _diagnose_with_modes(
    runs: Sequence[Run], nominal: Device, progress: Progress, excluded: Collection[str]
) -> Diagnosis:
    """The diagnosis of prepared recordings, with further modes where they show them."""
    extended = with_driven_modes(runs, nominal)
    diagnosis = _diagnose_runs(runs, nominal, extended, progress, excluded)
    if extended is nominal and _leaves_most(diagnosis):
        extended = with_driven_modes(runs, nominal, unexplained=True)
        if extended is not nominal:
            without_modes, diagnosis = diagnosis, _diagnose_runs(runs, nominal, extended, progress, excluded)
            if not is_worse(open_loop(runs, diagnosis.device), open_loop(runs, without_modes.device)):
                return without_modes
    if extended is nominal:
        return diagnosis
    nominal_loops = {name: loop.to_json() for name, loop in open_loop(runs, nominal).items()}
    loops = {name: {**both, "nominal": nominal_loops[name]} for name, both in diagnosis.open_loop.items()}
    return replace(diagnosis, verdict="mismatch", open_loop=loops)


def _leaves_most(diagnosis: Diagnosis) -> bool:
    """Whether the findings, laws and free corrections alike, explain no more of the misfit than is left.

    Both are zero for a correction whose device was rejected because it predicts worse than the nominal one.
    """
    explained = sum(finding.share or 0.0 for finding in diagnosis.findings)
    return bool(diagnosis.findings) and (diagnosis.remainder or {}).get("share", 0.0) >= explained


def _diagnose_runs(
    runs: Sequence[Run], nominal: Device, device: Device, progress: Progress, excluded: Collection[str]
) -> Diagnosis:
    """The diagnosis of prepared recordings. Where every selected law is rejected, the others are selected from.

    Args:
        nominal: the stated device.
        device: the same one, with further modes if the recordings show them.
    """
    modes = describe_modes(runs, nominal, device)
    left = {sense_channel(nominal, axis): 1.0 - of_axis["share"] for axis, of_axis in modes.items()}
    terms: Mapping[str, Term] = {effect: term for effect, term in catalogue().items() if effect not in excluded}
    while True:
        result = select_terms(runs, device, terms, progress)
        progress("prediction of held-out samples, values and shares")
        diagnosis = build_diagnosis(result, left)
        if not result.steps or (diagnosis.search and diagnosis.search.steps):
            return replace(diagnosis, further_modes=modes)
        rejected = {step.candidate.term.effect for step in result.steps}
        terms = {effect: term for effect, term in terms.items() if effect not in rejected}


def build_diagnosis(result: SelectionResult, left: Mapping[str, float] = MappingProxyType({})) -> Diagnosis:
    """Verdict, findings and improved device from the result of a selection.

    Args:
        left: by channel, the fraction of the nominal device's misfit that further modes leave; 1 for other channels.
    """
    improvement = improve(result)
    result = improvement.search
    corrections = find_corrections(result)
    correction = best_correction(corrections) if corrections else None
    if correction is not None:
        improvement = with_remainder_law(improvement, correction.candidate)
    corrected = correct_parameters(result.final, corrections) if corrections else None
    findings = map_fits(
        lambda step: find_effect(result, step, correction, corrected), result.steps, result.likelihood.steps
    )
    # The nominal fit of the selection has the further modes already; shares are of the misfit without them.
    findings = [
        replace(finding, share=(finding.share or 0.0) * left.get(channel_of_share(result, step), 1.0))
        for finding, step in zip(findings, result.steps, strict=True)
    ]
    remainder = find_remainder(result, correction, improvement.remainder_fit is not None)
    if remainder is not None:
        remainder["share"] *= left.get(remainder["channel"], 1.0)
    findings = beside_imperfections(findings, [bool(step.candidate.term.free_parameters) for step in result.steps])
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
        remainder,
        improvement.to_json(),
        hum=describe_strong_hum(result.final),
        remainder_fit=improvement.remainder_fit,
        noise={name: variance**0.5 for name, variance in noise_by_channel(result.likelihood).items()},
    )


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
    rest = "; the residual is noise" if residual_is_noise(fit) else ""
    return Finding(
        axis=axis,
        stage=name.partition(".")[0],
        effect="unknown",
        equation=f"{name} off by {size:+.1f} tolerances",
        parameters=(),
        where=f"{name} must deviate by {size:+.1f} tolerances to explain the recording{rest}",
        probability=1.0,
        rivals=(),
        heldout={"metric": METRIC, "before": fit.validation_chi2, "after": fit.validation_chi2},
        channel="sense",
        source="pull on a prior",
        curve={"x": "nominal value", "y": "pull / tolerance", "points": [[n, p] for p, _, n in pulls]},
    )
