"""Optics effects as findings: which term of the catalogue, its parameter, where it shows, and its rivals."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from estimation.candidate_terms.significance import MIN_RIVAL_PROBABILITY, UNIQUE_NAME_THRESHOLD
from estimation.diagnosis.finding import Finding, ParameterEstimate, Rival
from estimation.least_squares import Z_95
from estimation.optics.candidates import OpticsEffect, optics_scales
from estimation.optics.fit import UNRESOLVED_SD_CELLS, validation_error
from estimation.optics.samples import OpticsParameters, ScanSamples
from scanner.device import AXES
from scanner.terms import NaturalScales, Term, catalogue

COMPARISON_SAMPLES = 60_000
"""Samples used to distinguish a delay from a lag. Each evaluation applies the detector's low-pass in every iteration of
the conjugate gradients, so that all samples would take minutes."""

MIN_BLUR_CELLS = 1.25
"""Cells that a lag must smooth over before it can be distinguished from a delay: a grid does not show a blur of less
than its own cell."""

LAG_RELATIVE_SD = 0.06
"""Relative standard deviation of a lag from detail below a cell, which shortens its delay by up to a tenth."""

LAG_SEARCH_RANGE = (0.7, 1.5)
"""Lags that are tried, relative to the delay that was measured. A lag's delay comes out up to a tenth short."""

MAX_SCORE = 1400.0
"""Bound on a difference in -2 log evidence before exp(-x / 2) is taken, which would underflow beyond it."""


PHASE_EFFECTS = ("phase", "detector-delay")
"""Hypotheses about the phase of one axis, see ``OpticsEffect``."""


@dataclass(frozen=True)
class EffectDescription:
    """An effect of known amplitude in the terms of the catalogue; the fields are those of ``Finding``."""

    axis: str
    stage: str
    effect: str
    equation: str
    source: str
    parameters: tuple[ParameterEstimate, ...]
    where: str


def has_permitted_sign(effect: OpticsEffect, amplitude: float) -> bool:
    """Whether the term of an effect permits the sign of its amplitude; a phase error may have either sign."""
    return effect.name in PHASE_EFFECTS or catalogue()[effect.name].parameters[0].sign * amplitude >= 0.0


def catalogue_name(effect: OpticsEffect, amplitude: float) -> str:
    """Name of the effect in the catalogue at the sign of its amplitude.

    A phase error of one axis is ``"unknown"``, because the intensity does not show its cause, unless its motion is
    measured by a detector of its own, which may be late. So is an effect whose sign its term excludes. A negative delay
    of the intensity is a delay of the other channels.
    """
    if effect.name in PHASE_EFFECTS:
        return "channel-delay" if effect.name == "detector-delay" and amplitude < 0.0 else "unknown"
    if has_permitted_sign(effect, amplitude):
        return effect.name
    return "channel-delay" if effect.name == "intensity-delay" else "unknown"


def describe_effect(
    effect: OpticsEffect, value: float, sd: float, scan: ScanSamples, rates: Mapping[str, float]
) -> EffectDescription:
    """An effect with its amplitude converted to the parameter of its term.

    Args:
        value, sd: amplitude along the effect's direction and its standard deviation.
        rates: angular frequency of each axis [rad/s].
    """
    name, axis, low, high = catalogue_name(effect, value), effect.axis, value - Z_95 * sd, value + Z_95 * sd
    if effect.name in PHASE_EFFECTS:
        moved = "lags behind" if value > 0.0 else "is ahead of"
        size = f"{1e6 * abs(value):.3g} +- {1e6 * Z_95 * sd:.2g} us ({abs(np.degrees(rates[axis]) * value):.3g} deg)"
        where = (
            f"forward and backward half-periods of {axis} are displaced against each other, those of the other axis "
            f"are not: the motion {moved} its estimate by {size}"
        )
        if name == "channel-delay":
            return _describe_term(axis, name, -value, (-high, -low), where)
        equation = f"θ_{axis}(t {'-' if value > 0.0 else '+'} {abs(value):.3g} s)"
        return EffectDescription(axis, "timing", name, equation, "forward against backward half-periods", (), where)
    if effect.name == "bleaching":
        if name == "unknown":
            where = f"the light grows by {100 * np.expm1(-value):.3g} % over the recording, at every position"
            equation = f"I(t) = L e^({-value:.3g} t/T)"
            return EffectDescription(axis, "optics", name, equation, "samples of one place", (), where)
        where = f"the light falls by {-100 * np.expm1(-value):.3g} % over the recording, at every position"
        interval = (scan.duration / high, scan.duration / low)
        return _describe_term(axis, name, scan.duration / value, interval, where)
    if effect.name == "sample-motion":
        speed = scan.half_swing[axis] / scan.duration
        where = (
            f"half-periods of both directions are displaced equally along {axis}, by {100 * value / 2:.3g} % of the "
            "full swing over the recording"
        )
        return _describe_term(axis, name, speed * value, (speed * low, speed * high), where)
    if effect.name != "intensity-delay":
        return _describe_linearised(effect, name, value, sd, optics_scales(scan, axis, rates))
    delay, interval = (value, (low, high)) if value > 0.0 else (-value, (-high, -low))
    late = "the intensity lags behind the motion" if value > 0.0 else "the estimated motion lags behind the intensity"
    where = f"{late}: forward and backward half-periods of both axes are displaced by the same {1e6 * delay:.4g} us"
    return _describe_term(axis, name, delay, interval, where)


def _describe_term(
    axis: str, effect: str, value: float, interval: tuple[float, float], where: str
) -> EffectDescription:
    """A description with the first parameter of a term of the catalogue."""
    term: Term = catalogue()[effect]
    parameter = ParameterEstimate(
        term.parameters[0].name, value, (min(interval), max(interval)), term.parameters[0].unit
    )
    return EffectDescription(axis, term.stage, effect, term.equation, term.source, (parameter,), where)


def _describe_linearised(
    effect: OpticsEffect, name: str, value: float, sd: float, scales: NaturalScales
) -> EffectDescription:
    """Describe an effect by its term; parameters other than the first have their prior median and interval."""
    term = catalogue()[effect.name]
    where = f"samples of one place at different times or in different directions differ as by {effect.name}"
    if name == "unknown":
        where += " of the opposite sign"
        return EffectDescription(effect.axis, "optics", name, term.equation, "samples of one place", (), where)
    estimates = []
    for parameter in term.parameters:
        x, x_sd = (value / effect.size, sd / effect.size) if parameter is term.parameters[0] else (0.0, 1.0)
        low, high = sorted(parameter.value(x + side * Z_95 * x_sd, scales) for side in (-1.0, 1.0))
        estimates.append(ParameterEstimate(parameter.name, parameter.value(x, scales), (low, high), parameter.unit))
    return EffectDescription(effect.axis, term.stage, name, term.equation, term.source, tuple(estimates), where)


def discriminate_delay_from_lag(
    scan: ScanSamples, description: EffectDescription, delay: float, parameters: OpticsParameters
) -> tuple[EffectDescription, float, str]:
    """Whether a delayed intensity is delayed or low-pass filtered, by the prediction of samples left out of the fits.

    Args:
        description: as a delay. delay: that was measured [s].
        parameters: of the optics, the delay included.

    Returns:
        the better description, the lead over the other in -2 log likelihood, and the name of the other.
    """
    from scipy.optimize import minimize_scalar

    few = scan.first_samples(COMPARISON_SAMPLES)
    undelayed = {**parameters, **{f"delay_{axis}": parameters[f"delay_{axis}"] - delay for axis in AXES}}

    def error(name: str, size: float) -> float:
        return validation_error(few, {**undelayed, name: size}, few.finest_cells)

    if delay * max(few.largest_speed.values()) * few.finest_cells / 2 < MIN_BLUR_CELLS:
        return description, 0.0, "detector-lag"
    bounds = (LAG_SEARCH_RANGE[0] * delay, LAG_SEARCH_RANGE[1] * delay)
    lagged = minimize_scalar(lambda lag: error("intensity_lag", lag), bounds=bounds, options={"xatol": delay / 50})
    lead = np.count_nonzero(few.validation_mask) * float(np.log(error("intensity_delay", delay) / lagged.fun))
    if lead < 0.0:
        return description, -lead, "detector-lag"
    lag = float(lagged.x)
    position_sd = 2.0 * UNRESOLVED_SD_CELLS / few.finest_cells / max(scan.largest_speed.values())
    sd = float(np.hypot(LAG_RELATIVE_SD * lag, position_sd))
    corner, low, high = (1 / (2 * np.pi * max(value, 1e-12)) for value in (lag, lag + Z_95 * sd, lag - Z_95 * sd))
    where = f"{description.where}; detail along the scan is smoothed as by a low-pass of {1e6 * lag:.3g} us"
    return _describe_term(description.axis, "detector-lag", corner, (low, high), where), lead, "intensity-delay"


def build_finding(
    description: EffectDescription,
    evidence_gain: float,
    rivals: list[tuple[float, str]],
    heldout: Mapping[str, object],
) -> Finding:
    """The finding for diagnosis.json, with probabilities among the effect, its rivals and no effect at all.

    Args:
        evidence_gain: fall of -2 log evidence by the effect.
        rivals: (difference in -2 log evidence, effect) of every effect that may explain the data instead.
        heldout: reduced chi-square of samples left out, before and after.
    """
    weights: dict[str, float] = {}
    for distance, name in rivals:
        if name != description.effect:
            weights[name] = max(weights.get(name, 0.0), float(np.exp(-0.5 * min(distance, MAX_SCORE))))
    total = 1.0 + sum(weights.values()) + float(np.exp(-0.5 * min(evidence_gain, MAX_SCORE)))
    known = catalogue()
    indistinct = {name for distance, name in rivals if distance < UNIQUE_NAME_THRESHOLD} - {description.effect}
    advice = [
        f"{name}: {text}"
        for name in sorted(indistinct)
        if description.effect in known and (text := known[description.effect].confounders.get(name))
    ]
    probabilities = sorted(((weight / total, name) for name, weight in weights.items()), key=lambda pair: -pair[0])
    return Finding(
        axis=description.axis,
        stage=description.stage,
        effect=description.effect,
        equation=description.equation,
        parameters=description.parameters,
        where=description.where,
        probability=1.0 / total,
        rivals=tuple(Rival(name, p) for p, name in probabilities if p > MIN_RIVAL_PROBABILITY),
        heldout=heldout,
        channel="intensity",
        source=description.source,
        advice="; ".join(advice) or None,
    )
