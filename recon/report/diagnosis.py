"""The reports of a diagnosis and of a planned measurement: conclusion, effects, then the evidence."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from estimation.candidate_terms.significance import MIN_RIVAL_PROBABILITY
from estimation.device_fit.data import Run
from estimation.device_fit.fit import Fit
from estimation.device_fit.posterior import PredictionPhaseError, phase_error, phase_portrait, waveform
from estimation.diagnosis.diagnose import Diagnosis
from estimation.diagnosis.finding import Finding
from estimation.diagnosis.identifiability import DISCRIMINATION_SIGMA, Detectability, detectability
from estimation.diagnosis.selection import SelectionResult, SelectionStep
from recon.report.conclusions import conclude_plan
from recon.report.diagnosis_conclusion import conclude_diagnosis, name_rival
from recon.report.diagnosis_figures import (
    detectability_figure,
    effect_figure,
    measured_curve_figure,
    portrait_figure,
    residual_over_time_figure,
    residual_spectrum_figure,
    waveform_figure,
)
from recon.report.effect_curve import effect_curve
from recon.report.numbers import format_interval, format_probability
from recon.report.page import Figure, Section, Table, render
from recon.report.prediction_phase import describe_largest_error, prediction_phase_section, scale_for
from scanner.terms import catalogue

EXCLUDED_NEG2_LOG_EVIDENCE, UNLIKELY_NEG2_LOG_EVIDENCE = 10.0, 6.0
"""Differences in -2 log evidence above which an effect is called excluded and unlikely: odds of 150 and of 20 to 1."""

MAX_SHOWN_DIFFERENCE = 1000.0
"""Differences in -2 log evidence above this are shown as "more than 1000": the number has no further meaning."""

UNITS = {"sense": "V", "angle": "rad", "velocity": "rad/s", "acceleration": "rad/s²"}
"""Unit of a channel by its kind."""


def diagnosis_report(diagnosis: Diagnosis, names: Sequence[str]) -> tuple[str, str]:
    """Return the conclusion of a diagnosis, and its page, which begins with it.

    Args:
        diagnosis: of the recordings.
        names: of the recordings.
    """
    search, errors = diagnosis.search, dict[str, PredictionPhaseError]()
    if search is not None and diagnosis.findings:
        errors = _phase_errors(search, _improved_fit(diagnosis, search))
    sections = [_overview(diagnosis)] if diagnosis.findings else []
    sections += [_open_loop_section(diagnosis)] if diagnosis.open_loop else []
    sections += [_finding_section(finding, i, search) for i, finding in enumerate(diagnosis.findings)]
    if search is not None:
        sections += _motion_sections(diagnosis, search, errors)
    sections += [_optics_section(table) for table in diagnosis.optics]
    conclusion = conclude_diagnosis(diagnosis.to_json(), describe_largest_error(errors, scale_for(diagnosis.device)))
    heading, subject = f"Diagnosis of {diagnosis.device.name}", f"From {', '.join(names)}."
    return conclusion, render(heading, conclusion, sections, subject=subject)


def _overview(diagnosis: Diagnosis) -> Section:
    rows = [
        [
            finding.effect,
            f"{finding.stage} of axis {finding.axis}",
            format_probability(finding.probability),
            "" if finding.share is None else f"{finding.share:.1%}",
            f"{finding.heldout['before']:.3g}",
            f"{finding.heldout['after']:.3g}",
        ]
        for finding in diagnosis.findings
    ]
    if diagnosis.remainder is not None:
        rest = diagnosis.remainder
        rows.append(["not explained", f"{rest['channel']}, {rest['stage']}", "", f"{rest['share']:.1%}", "", ""])
    head = ["effect", "where", "probability", "share of the misfit", "misfit before", "misfit after"]
    text = (
        "Probability: of the effect among the laws that were compared, by these recordings. "
        "Misfit: reduced chi-square on samples that were not used in the fit; noise alone gives 1. Share: of the mean "
        "square misfit of the nominal device on these samples, in the channel that shows the effect most, that returns "
        "without the effect: it is small for effects of which one can take the place of the other. What is not "
        "explained near the noise is a share of the misfit in units of the noise."
    )
    return Section("Effects", text, Table(head, rows))


def _open_loop_section(diagnosis: Diagnosis) -> Section:
    rows = []
    for channel, loops in diagnosis.open_loop.items():
        noise = f"{diagnosis.noise[channel]:.3g}" if channel in diagnosis.noise else ""
        rows.append([channel, *(f"{loop['rmse']:.3g} ({loop['fraction']:.1%})" for loop in loops.values()), noise])
    text = (
        "Root mean square error of the prediction from the drive and the initial state alone, on samples that were not "
        "used in a fit, in the unit of the channel and in percent of its standard deviation. An exact prediction errs "
        "by the noise, up to the scatter of that in these samples."
    )
    head = ["channel", "nominal device", "improved device", "noise"]
    return Section("Prediction by the devices", text, Table(head, rows))


def _finding_section(finding: Finding, index: int, search: SelectionResult | None) -> Section:
    text = f"{finding.equation}. {finding.where}. Source: {finding.source}."
    if finding.advice:
        text += f" To distinguish it from its alternatives: {finding.advice}."
    rows = [[p.name, format_interval(p.value, *p.ci95, p.unit)] for p in finding.parameters]
    for rival in finding.rivals:
        distance = "" if rival.distance is None else f"; differs from it by {rival.distance:.1f} σ at most"
        is_probable = rival.probability > MIN_RIVAL_PROBABILITY
        probability = f"probability {format_probability(rival.probability)}" if is_probable else ""
        name = f"alternative: {name_rival(rival.effect, rival.stage)}"
        rows.append([name, (probability or "not excluded by this recording") + distance])
    figures = [measured_curve_figure(finding.curve)] if finding.curve and "columns" in finding.curve else []
    if search is not None:
        figures += _effect_figures(finding, search)
    table = Table(["parameter", "value ± standard deviation, or value (95 % interval)"], rows) if rows else None
    return Section(f"{index + 1}. {finding.effect}", text, table, figures, least="24rem")


def _effect_figures(finding: Finding, search: SelectionResult) -> list[Figure]:
    key = (finding.axis, finding.effect, finding.channel)
    candidates = [c for c in search.final.model.candidates if (c.axis, c.term.effect, c.channel) == key]
    curves = [curve for c in candidates if (curve := effect_curve(search.final, c)) is not None]
    return [effect_figure(curve, finding.effect) for curve in curves]


def _motion_sections(
    diagnosis: Diagnosis, search: SelectionResult, errors: Mapping[str, PredictionPhaseError]
) -> list[Section]:
    """The evidence from drive to readout."""
    improved = _improved_fit(diagnosis, search)
    sections = [_waveforms(search, improved)]
    if search.steps:
        sections.append(prediction_phase_section(errors, scale_for(diagnosis.device)))
    sections += [_residuals(search, improved), _portraits(search, improved)]
    if search.steps:
        text = (
            "Difference of −2 log evidence to the chosen effect: above 6 an effect is unlikely (odds 1 to 20), above "
            "10 it is excluded (odds 1 to 150)."
        )
        head = ["effect", "difference", "judgement"]
        sections.append(Section("Effects compared", text, Table(head, evidence_rows(search.steps))))
    effects = detectability(search.likelihood, search.final, catalogue().values())
    return [*sections, _detectability(effects), _nominal_values(diagnosis)]


def _improved_fit(diagnosis: Diagnosis, search: SelectionResult) -> Fit:
    """The fit with the findings, and with a measured law of what they leave where the written device holds one."""
    return diagnosis.remainder_fit or search.final


def _run_names(runs: Sequence[Run]) -> list[str]:
    """Name of every recording, with a number where several have the same."""
    names = [run.name for run in runs]
    return [f"{name} ({names[: r + 1].count(name)})" if names.count(name) > 1 else name for r, name in enumerate(names)]


def _phase_errors(search: SelectionResult, improved: Fit) -> dict[str, PredictionPhaseError]:
    """Phase errors of open-loop predictions by recording and axis."""
    errors = {}
    runs = search.likelihood.runs
    for r, (name, run) in enumerate(zip(_run_names(runs), runs, strict=True)):
        for axis in run.inputs:
            error = phase_error(search.nominal, improved, axis, r)
            if error is not None:
                errors[f"{name}, axis {axis}"] = error
    return errors


def _waveforms(search: SelectionResult, improved: Fit) -> Section:
    runs = search.likelihood.runs
    figures = [
        waveform_figure(
            waveform(search.nominal, improved, r, channel),
            f"{name}, {output.name}" if len(runs) > 1 else output.name,
            UNITS.get(output.kind, ""),
        )
        for r, (name, run) in enumerate(zip(_run_names(runs), runs, strict=True))
        for channel, output in enumerate(run.outputs)
    ]
    return Section("Measured and simulated waveforms", figures=figures, least="26rem")


def _residuals(search: SelectionResult, improved: Fit) -> Section:
    figures = []
    first, runs = 0, search.likelihood.runs
    for run_name, run, whiteners in zip(_run_names(runs), runs, search.likelihood.whiteners, strict=True):
        for output, whitener in zip(run.outputs, whiteners, strict=True):
            part = slice(first, first + whitener.samples)
            first += whitener.samples
            pair = [search.nominal.residual[part], improved.residual[part]]
            frequency = np.arange(whitener.psd.size) / (output.data.size * output.step)
            name = f"{run_name}, {output.name}"
            figures.append(residual_over_time_figure(name, whitener.time * run.duration, pair))
            figures.append(residual_spectrum_figure(name, frequency, pair))
    text = "Differences between recording and simulation, divided by the noise at each frequency: noise alone gives 1."
    return Section("Residuals over time and frequency", text, figures=figures, least="24rem")


def _portraits(search: SelectionResult, improved: Fit) -> Section:
    pair = (search.nominal.residual, improved.residual)
    figures, runs = [], search.likelihood.runs
    for r, (name, run) in enumerate(zip(_run_names(runs), runs, strict=True)):
        for channel, output in enumerate(run.outputs):
            before, after = phase_portrait(search.likelihood, improved, pair, r, channel)
            caption = f"{name}, {output.name}: residual over angle and rate of axis {output.axes[0]}"
            figures.append(portrait_figure(before, after, caption))
    return Section("Residuals over the state of the mirror", figures=figures, least="24rem")


def evidence_rows(rounds: Sequence[SelectionStep]) -> list[list[str]]:
    """Every chosen effect, then its alternatives with their difference of -2 log evidence and what it means."""
    rows = []
    for step in rounds:
        gain = step.before.neg2_log_evidence - step.after.neg2_log_evidence
        rows.append([step.candidate.key, "0", f"chosen; no effect at all is worse by {_difference(gain)}"])
        rows += [
            [rival.candidate.key, _difference(rival.evidence_gap), _judgement(rival.evidence_gap)]
            for rival in step.rivals
        ]
    return rows


def _difference(value: float) -> str:
    return f"{value:.1f}" if value < MAX_SHOWN_DIFFERENCE else f"more than {MAX_SHOWN_DIFFERENCE:.0f}"


def _judgement(difference: float) -> str:
    if difference > EXCLUDED_NEG2_LOG_EVIDENCE:
        return "excluded"
    return "unlikely" if difference > UNLIKELY_NEG2_LOG_EVIDENCE else "possible alternative"


def _optics_section(table: Mapping[str, Any]) -> Section:
    rows = [
        [f"{e['effect']}, axis {e['axis']}", f"{e['sigma']:.1f}", ("" if e["detectable"] else "not ") + "detectable"]
        for e in table["effects"]
    ]
    text = (
        f"{table['recording']}: samples of one place at different times and in different directions must agree. The "
        "table shows how many standard deviations an effect of typical size would have. A distorted field or a wrong "
        "amplitude changes all pictures of a scene in the same way. It can only be detected with a known target."
    )
    return Section("Optics: detectability", text, Table(["effect", "σ", "in this recording"], rows))


def _nominal_values(diagnosis: Diagnosis) -> Section:
    rows = [[name, f"{value['pull']:+.2f}".replace("-", "−")] for name, value in diagnosis.nominal.items()]
    text = "Change of every nominal value in the fit, in units of its tolerance (1 standard deviation)."
    return Section("Nominal values", text, Table(["value", "change / tolerance"], rows))


def _detectability(effects: Sequence[Detectability]) -> Section:
    text = (
        "For every effect of typical size: how many standard deviations it would have in these recordings, and how "
        f"many of them remain if its nearest confounder is fitted. From {DISCRIMINATION_SIGMA:g} σ on it is identified "
        "unambiguously; below, a further measurement is needed."
    )
    return Section("What these recordings can show", text, figures=[detectability_figure(effects)], least="34rem")


def plan_report(plan: Mapping[str, Any], effects: Sequence[Detectability]) -> str:
    """The page of a planned measurement.

    Args:
        plan: content of plan.json.
        effects: detectability of every effect, listed in its table.
    """
    runs = [[run["name"], f"{1e3 * run['duration']:.4g}", ", ".join(run["channels"])] for run in plan["excitations"]]
    ambiguous = [
        [
            effect["key"],
            f"{effect['stage']} of axis {effect['axis']}",
            f"{effect['sigma']:.3g}",
            f"{effect['distance']:.3g}",
            effect["nearest"],
            effect["advice"] or "another excitation, or a further channel",
        ]
        for effect in plan["effects"]
        if effect["distance"] < DISCRIMINATION_SIGMA
    ]
    sections = [_detectability(effects)]
    if ambiguous:
        head = ["effect", "where", "detectability (σ)", "distance (σ)", "confounder", "what would distinguish them"]
        sections.append(Section("What would remain ambiguous", "", Table(head, ambiguous)))
    sections.append(Section("Planned recordings", "", Table(["excitation", "duration (ms)", "channels"], runs)))
    return render("What a measurement can show", conclude_plan(plan), sections, subject=f"Device: {plan['device']}.")
