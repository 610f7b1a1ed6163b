"""Diagnosis of frequency responses: modes, feedthrough and laws of amplitude that the nominal device omits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from estimation.candidate_terms.significance import MIN_RIVAL_PROBABILITY
from estimation.diagnosis.diagnose import Diagnosis
from estimation.diagnosis.finding import Finding, ParameterEstimate, Rival
from estimation.least_squares import Z_95
from estimation.slow.diagnose import MIN_REMAINDER
from estimation.slow.law_units import law_estimate, relative_unit_sd
from estimation.slow.response import (
    AMPLITUDE_LAWS,
    DELAY,
    FEEDTHROUGH,
    SECOND_MODE,
    Response,
    ResponseFit,
    fit_response,
)
from estimation.slow.response_selection import (
    MAX_CONSISTENT_ERROR,
    fit_subsets,
    prediction_error,
    select_response_effects,
    with_common_modes,
)
from scanner.device import Axis, Device
from scanner.terms import catalogue
from scanner.terms.driven_modes import EFFECT as DRIVEN_MODES

METRIC = "error of the response on tones not used in the fit, as a fraction of the response (rms)"

SECOND_MODE_ADVICE = "cross-axis-coupling: the second mode may be that of the other axis; drive each axis alone"


def diagnose_responses(responses: Sequence[Response], device: Device) -> Diagnosis:
    """Diagnose the frequency responses of one device, one an axis.

    The gain and the phase of the drive are fitted. The device takes resonance and damping, laws of amplitude where the
    response is in rad, and, if it states a linear drive, a second mode as ``driven-modes``, relative to the first one.
    """
    tables = [fit_subsets(response) for response in responses]
    selected = [select_response_effects(response, table) for response, table in zip(responses, tables, strict=True)]
    selected = with_common_modes(responses, selected)
    findings: list[Finding] = []
    unexplained, remainders, loops = [], [], {}
    for response, table, best in zip(responses, tables, selected, strict=True):
        axis, channel = device.axes[response.name], f"amplitude_{response.name}"
        linear_error, best_error = (prediction_error(response, fit) for fit in (table[()], best))
        nominal_error = prediction_error(response, _nominal_fit(response, axis) or table[()])
        found = [_finding(response, axis, effect, best, table, len(device.axes) > 1) for effect in best.effects]
        findings += sorted(found, key=lambda finding: -(finding.share or 0.0))
        rest = best_error.error / best_error.deviation
        if rest > MAX_CONSISTENT_ERROR:
            unexplained.append(f"the response of {response.name} is missed by {rest:.1%} (rms)")
        share = min((best_error.error / max(linear_error.error, 1e-300)) ** 2, 1.0)
        if found and share > MIN_REMAINDER:
            remainders.append({"share": share, "stage": "mechanics", "channel": channel})
        improved, improved_error = _with_fit(device, response, best, found), best_error
        if SECOND_MODE in best.effects and DRIVEN_MODES not in improved.axes[response.name].terms:
            first_mode = (float(best.modes[0, 0]), float(best.modes[0, 1]))
            improved_error = prediction_error(response, fit_response(response, (), first_mode))
        if improved_error.error > nominal_error.error:
            improved, improved_error = device, nominal_error
        device = improved
        loops[channel] = {
            key: {"rmse": error.error * response.scale, "fraction": error.error / error.deviation}
            for key, error in (("nominal", nominal_error), ("improved", improved_error))
        }
    return Diagnosis(
        "mismatch" if findings or unexplained else "consistent",
        tuple(findings),
        "; ".join(unexplained) or None,
        device,
        None,
        remainder=max(remainders, key=lambda each: float(str(each["share"])), default=None),
        open_loop=loops,
    )


def _nominal_fit(response: Response, axis: Axis) -> ResponseFit | None:
    """The response of the nominal device with a fitted gain, None where it states no mechanics."""
    if axis.mechanics is None or axis.mechanics.b <= 0.0:
        return None
    quality = 2.0 * np.pi * axis.resonance * axis.mechanics.J / axis.mechanics.b
    return fit_response(response, (), (axis.resonance, quality))


def _finding(
    response: Response,
    axis: Axis,
    effect: str,
    best: ResponseFit,
    fits: Mapping[tuple[str, ...], ResponseFit],
    has_other_axis: bool,
) -> Finding:
    term, name = catalogue()[effect], response.name
    weights = {effects: float(np.exp(-0.5 * min(fit.score - best.score, 1400.0))) for effects, fit in fits.items()}
    weights[best.effects] = 1.0
    total = sum(weights.values())
    without = {effects: weight / total for effects, weight in weights.items() if effect not in effects}
    others: dict[str, float] = {}
    for effects, weight in without.items():
        for other in set(effects) - set(best.effects):
            others[other] = others.get(other, 0.0) + weight
    rivals = [
        Rival(other, p) for other, p in sorted(others.items(), key=lambda each: -each[1]) if p > MIN_RIVAL_PROBABILITY
    ]
    probability = 1.0 - sum(without.values())
    if effect == SECOND_MODE and has_other_axis:  # the same equations of motion
        probability *= 0.5
        rivals = [Rival("cross-axis-coupling", probability), *rivals]
    removed = fits[tuple(each for each in best.effects if each != effect)]
    errors = [prediction_error(response, fit) for fit in (fits[()], removed, best)]
    misfit, gain = (errors[i].error ** 2 - errors[2].error ** 2 for i in (0, 1))
    before, after = (errors[i].error / errors[i].deviation for i in (0, 2))
    return Finding(
        axis=name,
        stage=term.stage,
        effect=effect,
        equation=term.equation,
        parameters=_parameters(response, axis, effect, best),
        where=f"one linear mode misses the response of {name} at {response.frequency[0]:.6g} to "
        f"{response.frequency[-1]:.6g} Hz by {before:.2%} (rms), with all findings {after:.2%} are left",
        probability=probability,
        rivals=tuple(rivals),
        heldout={"metric": METRIC, "before": before, "after": after},
        channel=f"amplitude_{name}",
        source=term.source,
        share=float(np.clip(gain / max(misfit, 1e-300), 0.0, 1.0)),
        advice=SECOND_MODE_ADVICE if effect == SECOND_MODE else None,
    )


def _parameters(response: Response, axis: Axis, effect: str, fit: ResponseFit) -> tuple[ParameterEstimate, ...]:
    """Parameters of an effect: frequencies and qualities of both modes, of laws in SI units where that is possible."""
    if effect == SECOND_MODE:
        return tuple(
            ParameterEstimate(f"{key}{i + 1}", float(value), (float(value - Z_95 * sd), float(value + Z_95 * sd)), unit)
            for i in (0, 1)
            for key, unit, value, sd in zip(("f", "Q"), ("Hz", "1"), fit.modes[i], fit.mode_sd[i], strict=True)
        )
    if effect == FEEDTHROUGH:
        size, sd = (abs(value) / response.largest for value in (fit.feedthrough, fit.feedthrough_sd))
        return (law_estimate("fraction_of_largest_amplitude", "1", size, sd),)
    if effect == DELAY:
        return (law_estimate("delay", "s", *fit.delay),)
    value, sd = fit.laws[effect]
    if not response.in_rad or axis.mechanics is None:
        power = {"cubic-stiffness": -2, "cubic-damping": -1, "quadratic-drag": 0, "coulomb-friction": -2}[effect]
        factor = (2.0 * np.pi * float(fit.modes[0, 0])) ** power
        return (law_estimate("at_largest_amplitude", "1", factor * value, factor * sd),)
    power = {"cubic-stiffness": -2, "cubic-damping": -2, "quadratic-drag": -1, "coulomb-friction": 1}[effect]
    factor = axis.mechanics.J * response.largest**power
    parameter = catalogue()[effect].parameters[0]
    relative_sd = relative_unit_sd(axis, response.tolerance, power)
    return (law_estimate(parameter.name, parameter.unit, factor * value, factor * sd, relative_sd),)


def _with_fit(device: Device, response: Response, fit: ResponseFit, findings: Sequence[Finding]) -> Device:
    """The device with resonance and damping of the first mode, and the laws of amplitude."""
    axis = device.axes[response.name]
    if axis.mechanics is None:
        return device
    J, rate, quality = axis.mechanics.J, 2.0 * np.pi * float(fit.modes[0, 0]), float(fit.modes[0, 1])
    mechanics = replace(axis.mechanics, k=J * rate**2, b=J * rate / quality)
    device = replace(device, axes={**device.axes, response.name: replace(axis, mechanics=mechanics)})
    if SECOND_MODE in fit.effects and axis.drive is not None and axis.drive.torque_per_volt is not None:
        device = device.with_terms({response.name: {DRIVEN_MODES: _second_mode(fit, axis.drive.torque_per_volt / J)}})
    if not response.in_rad:
        return device
    terms = {}
    for finding in findings:
        if finding.effect in AMPLITUDE_LAWS:
            terms[finding.effect] = {each.name: each.value for each in finding.parameters}
            if finding.effect == "coulomb-friction":  # the rate at which friction turns over is far below the motion's
                terms[finding.effect]["omega_s"] = 1e-3 * response.largest * rate
    return device.with_terms({response.name: terms}) if terms else device


def _second_mode(fit: ResponseFit, first_gain: float) -> dict[str, list[float]]:
    """The second mode as the table of ``driven-modes``.

    The residues of both modes contain the same unknown gain and phase of drive and lock-in amplifier, so that their
    ratio does not.

    Args:
        first_gain: acceleration of the first mode by voltage [rad/s^2 / V].
    """
    gain = complex(fit.residues[1] / fit.residues[0]) * first_gain
    frequency, quality = map(float, fit.modes[1])
    return {"frequency": [frequency], "quality": [quality], "gain": [gain.real], "gain_rate": [gain.imag]}
