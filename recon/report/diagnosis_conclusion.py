"""The conclusion of a diagnosis: what the nominal device lacks, how well that is known, and what to do."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from estimation.device_fit.deviations import deviations_are_improbable
from recon.report.numbers import format_interval, format_value
from scanner.wording import percent

MIN_CERTAIN_PROBABILITY = 0.9
"""Probability of a finding from which it is stated without its probability."""

VALUES_LISTED = 4
"""Values of the device that are listed where they contradict their tolerances: those of a comb and its gain."""


def conclude_diagnosis(content: Mapping[str, Any], prediction_error: str = "") -> str:
    """What the nominal device lacks, and what to do.

    Args:
        content: of diagnosis.json.
        prediction_error: sentence on the phase error of the nominal device's open-loop prediction, where it has one.
    """
    findings = content["findings"]
    remarks = _describe_hum(content)
    if content.get("untested"):
        remarks += f" Not tested: {content['untested']}."
    if not findings and content["verdict"] == "consistent":
        return (
            "The recordings agree with the nominal device within their noise and the tolerances of its values; "
            f"no effect has to be added.{_describe_open_loop(content)}{remarks}"
        )
    modes = "".join(
        f" The drive also excites further modes of {name} at "
        f"{', '.join(f'{frequency:.3g}' for frequency in sorted(of['frequency']))} Hz "
        f"({of['share']:.0%} of the nominal misfit), which device.toml states."
        for name, of in content.get("further_modes", {}).items()
    )
    if modes and not findings:
        text = "The nominal device lacks no effect beside its own mode."
    elif not findings:
        text = "The recordings contradict the nominal device, but no single effect explains the difference."
    else:
        text = _describe_findings(findings)
        if (content.get("remainder") or {}).get("share", 0.0) > 0.5:
            near_noise = "" if content.get("unexplained") else " with fitted values, which is near the noise,"
            text = f"Most of the difference between recording and nominal device{near_noise} is not explained. {text}"
    text += f" {prediction_error}" if prediction_error else ""
    text += modes + _describe_values(content)
    loops = content.get("open_loop", {}).values()
    in_picture = any(finding["channel"] == "intensity" for finding in findings)
    if loops and not in_picture and all(loop["improved"] == loop["nominal"] for loop in loops):
        text += " device.toml is the nominal device: a corrected one predicts the held-out samples no better."
    elif findings or modes:
        rest = content.get("remainder") or {}
        law = f" It also has a measured law of the {rest['stage']}." if rest.get("in_device") else ""
        text += f" Use the corrected device.toml in place of the nominal one.{law}{_describe_open_loop(content)}"
    if content.get("unexplained"):
        text += f" Not explained: {content['unexplained']}{_describe_remainder(content)}."
    return text + remarks


def _describe_values(content: Mapping[str, Any]) -> str:
    """Values of the device that contradict their tolerances; empty if they are as probable as in a right device."""
    deviations = {name: value["pull"] for name, value in content.get("nominal", {}).items()}
    if not deviations or not deviations_are_improbable(np.array(list(deviations.values()))):
        return ""
    far = [name for name, deviation in deviations.items() if abs(deviation) > 1.0]
    largest = sorted(far, key=lambda name: -abs(deviations[name]))[:VALUES_LISTED]
    listed = ", ".join(f"{name} by {format_value(deviations[name], 2)}" for name in largest)
    return (
        f" Values of the device, as fitted, lie far outside their tolerances: {listed} tolerances. Check that the "
        "device file belongs to this device and that its tolerances are right: with right values less may be missing."
    )


def _describe_remainder(content: Mapping[str, Any]) -> str:
    """Share and stage of the misfit that the findings leave; empty without findings or a remainder."""
    rest = content.get("remainder")
    if not rest or not content["findings"]:
        return ""
    return (
        f"; {percent(rest['share'])} of the nominal misfit of {rest['channel']} are left, and a change of the "
        f"{rest['stage']} would take most of it"
    )


def _describe_hum(content: Mapping[str, Any]) -> str:
    """Mains hum that is stronger than the noise; empty if there is none."""
    return "".join(
        f" {channel} has mains hum of {of['frequency']:.2f} Hz, {format_value(of['relative'], 2)} times as strong as "
        "noise; it is taken as noise."
        for channel, of in content.get("hum", {}).items()
    )


def _describe_open_loop(content: Mapping[str, Any]) -> str:
    """How well the corrected device predicts, beside the nominal one; empty if they are the same."""
    loops = content.get("open_loop", {})
    changed = {name: loop["improved"] for name, loop in loops.items() if loop["improved"] != loop["nominal"]}
    if not changed:
        return ""
    compared = {name: f"nominal {percent(loops[name]['nominal']['fraction'])}" for name in changed}
    for name, noise in content.get("noise", {}).items():
        if name in changed:
            compared[name] += f", noise {percent(noise / changed[name]['rmse'] * changed[name]['fraction'])}"
    listed = ", ".join(f"{percent(loop['fraction'])} of {name} ({compared[name]})" for name, loop in changed.items())
    text = (
        " From drive and initial state alone, device.toml predicts samples that were not fitted with an error of "
        f"{listed}."
    )
    useless = [name for name, loop in changed.items() if loop["fraction"] >= 1.0]
    if useless:
        text += f" That is no better than no prediction of {' and '.join(useless)}."
    return text


def _describe_findings(findings: Sequence[Mapping[str, Any]]) -> str:
    """What the device lacks, then what it may lack: effects of which other explanations are not excluded."""
    certain = [finding for finding in findings if finding["probability"] >= MIN_CERTAIN_PROBABILITY]
    parts = ["The nominal device lacks " + "; and ".join(map(_describe_finding, certain)) + "."] if certain else []
    for finding in findings:
        if finding not in certain:
            parts.append(f"{'It' if parts else 'The nominal device'} {_describe_uncertain_finding(finding)}")
    return " ".join(parts)


def _describe_uncertain_finding(finding: Mapping[str, Any]) -> str:
    """What the device may lack, with its probability and the most probable alternative; the subject is left out."""
    probability, rivals = finding["probability"], finding["rivals"][:1]
    if probability < 0.5 and any(rival.get("stage") for rival in rivals):
        return (
            f"probably lacks several effects that are not in the catalogue, in the {rivals[0]['stage']} above all "
            f"({rivals[0]['probability']:.0%}); a single one in the {finding['stage']} of axis {finding['axis']} is "
            f"less probable ({probability:.0%})."
        )
    others = "".join(f" ({name_rival(r['effect'], r.get('stage'))}: {r['probability']:.0%})" for r in rivals)
    verb = "probably lacks" if probability >= 0.5 else "may lack"
    return f"{verb} {_describe_finding(finding)}, with a probability of {probability:.0%}{others}."


def name_rival(effect: str, stage: str | None) -> str:
    """Name of a rival; one with a stage stands for all other stages together, of which it needs this one most."""
    return f"{effect} in other stages, the {stage} above all" if stage else effect


def _describe_finding(finding: Mapping[str, Any]) -> str:
    values = ", ".join(
        f"{p['name']} = {format_interval(p['value'], p['ci95'][0], p['ci95'][1], p['unit'])}"
        for p in finding["parameters"]
    )
    name = "an effect that is not in the catalogue" if finding["effect"] == "unknown" else finding["effect"]
    return f"{name} in the {finding['stage']} of axis {finding['axis']}" + (f" ({values})" if values else "")
