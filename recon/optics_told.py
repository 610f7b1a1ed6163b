"""An effect of the optics told in the catalogue's words: which term, its parameter, where it shows, and its rivals."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from estimation.mismatch.diagnosis import Estimate, Finding, Rival
from estimation.mismatch.naming import LEAD_OVER_NEXT
from recon.optics_fit import AXES, MISLED, Numbers, Scan, foretold
from scanner.terms import Term, catalogue

JUDGED = 60_000
"""Samples by which a delay is told from a lag: every step of that runs through the detector many times."""

BLURRED = 1.25
"""Cells that a lag must smooth over before it can be told from a delay."""

SHORT = 0.06
"""Relative standard deviation of a lag that is told."""


@dataclass(frozen=True)
class Effect:
    """What may be wrong: a direction among the measured numbers.

    Attributes:
        name: of the effect, told with its axis.
        axis: that it belongs to.
        direction: change of the measured numbers with its amplitude.
        size: prior standard deviation of the amplitude.
    """

    name: str
    axis: str
    direction: Numbers
    size: float


@dataclass(frozen=True)
class Told:
    """An effect in the catalogue's words."""

    axis: str
    stage: str
    effect: str
    equation: str
    source: str
    parameters: tuple[Estimate, ...]
    where: str


def told_name(effect: Effect, value: float) -> str:
    """In the catalogue's words; a phase of one axis that is off has no cause that the picture could tell."""
    if effect.name == "phase" or (effect.name == "bleaching" and value < 0.0):
        return "unknown"
    return "channel-delay" if effect.name == "intensity-delay" and value < 0.0 else effect.name


def tell(effect: Effect, value: float, sd: float, scan: Scan, rates: Mapping[str, float]) -> Told:
    """An effect of one amplitude, told in the units of its term."""
    name, axis, low, high = told_name(effect, value), effect.axis, value - 1.96 * sd, value + 1.96 * sd
    if effect.name == "phase":
        turned = np.degrees(rates[axis])
        where = (
            f"forward and backward sweeps of {axis} lie apart and those of the other axis do not: its motion lags "
            f"{1e6 * value:.3g} +- {1.96e6 * sd:.2g} us ({turned * value:.3g} deg) behind the estimate"
        )
        return Told(axis, "timing", name, f"θ_{axis}(t - {value:.3g} s)", "forward against backward sweeps", (), where)
    if effect.name == "bleaching":
        if name == "unknown":
            where = f"the light grows by {100 * np.expm1(-value):.3g} % over the recording, wherever the beam is"
            return Told(axis, "optics", name, f"I(t) = L e^({-value:.3g} t/T)", "samples of one place", (), where)
        where = f"the light falls by {-100 * np.expm1(-value):.3g} % over the recording, wherever the beam is"
        ends = (scan.duration / high, scan.duration / low)
        return _listed(axis, name, scan.duration / value, ends, where)
    if effect.name == "sample-motion":
        speed = scan.half[axis] / scan.duration
        where = f"sweeps in both directions move alike along {axis}, by {100 * value / 2:.3g} % of the swing in all"
        return _listed(axis, name, speed * value, (speed * low, speed * high), where)
    late, ends = (value, (low, high)) if value > 0.0 else (-value, (-high, -low))
    who = "the intensity lags behind the motion" if value > 0.0 else "the estimated motion lags behind the intensity"
    where = f"{who}: forward and backward sweeps of both axes lie apart by one time, {1e6 * late:.4g} us"
    return _listed(axis, name, late, ends, where)


def _listed(axis: str, effect: str, value: float, ends: tuple[float, float], where: str) -> Told:
    term: Term = catalogue()[effect]
    parameter = Estimate(term.parameters[0].name, value, (min(ends), max(ends)), term.parameters[0].unit)
    return Told(axis, term.stage, effect, term.equation, term.source, (parameter,), where)


def late_or_lagging(scan: Scan, told: Told, late: float, p: Numbers) -> tuple[Told, float, str]:
    """Delay or lag, whichever foretells samples better that it has not seen: that one, and how far behind the other is.

    A lag's delay comes out short by up to a tenth where the sample has detail below a cell, hence ``SHORT``.
    """
    from scipy.optimize import minimize_scalar

    few = scan.beginning(JUDGED)
    early = {**p, **{f"late_{axis}": p[f"late_{axis}"] - late for axis in AXES}}

    def error(name: str, size: float) -> float:
        return foretold(few, {**early, name: size}, few.finest)

    if late * max(few.fastest.values()) * few.finest / 2 < BLURRED:
        return told, 0.0, "detector-lag"
    lagging = minimize_scalar(
        lambda lag: error("lag", lag), bounds=(0.7 * late, 1.5 * late), options={"xatol": late / 50}
    )
    lead = np.count_nonzero(few.held) * float(np.log(error("delay", late) / lagging.fun))
    if lead < 0.0:
        return told, -lead, "detector-lag"
    lag = float(lagging.x)
    sd = float(np.hypot(SHORT * lag, 2.0 * MISLED / few.finest / max(scan.fastest.values())))
    corner, low, high = (1 / (2 * np.pi * max(each, 1e-12)) for each in (lag, lag + 1.96 * sd, lag - 1.96 * sd))
    where = f"{told.where}, and detail along the sweep is smoothed as by a section of {1e6 * lag:.3g} us"
    return _listed(told.axis, "detector-lag", corner, (low, high), where), lead, "intensity-delay"


def finding_of(told: Told, lead: float, against: list[tuple[float, str]], heldout: Mapping[str, object]) -> Finding:
    """In the form of diagnosis.json."""
    weights: dict[str, float] = {}
    for distance, name in against:
        if name != told.effect:
            weights[name] = max(weights.get(name, 0.0), float(np.exp(-0.5 * min(distance, 1400.0))))
    total = 1.0 + sum(weights.values()) + float(np.exp(-0.5 * min(lead, 1400.0)))
    known = catalogue()
    close = {name for distance, name in against if distance < LEAD_OVER_NEXT} - {told.effect}
    advice = [
        f"{name}: {text}"
        for name in sorted(close)
        if told.effect in known and (text := known[told.effect].lookalikes.get(name))
    ]
    ordered = sorted(weights.items(), key=lambda pair: -pair[1])
    return Finding(
        axis=told.axis,
        stage=told.stage,
        effect=told.effect,
        equation=told.equation,
        parameters=told.parameters,
        where=told.where,
        probability=1.0 / total,
        rivals=tuple(Rival(name, weight / total) for name, weight in ordered if weight / total > 1e-4),
        heldout=heldout,
        channel="intensity",
        source=told.source,
        advice="; ".join(advice) or None,
    )
