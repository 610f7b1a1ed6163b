"""The optics of a recording judged by its own picture: samples of one place must agree, whenever and whichever way.

No picture is known beforehand, so what is judged is consistency. A single fit of all numbers that a scan's samples can
tell, the picture free (``recon.optics_fit``), measures how far each axis's motion lags, what fades and what moves, with
a covariance. Every effect is a direction among those numbers, and hypotheses are compared by their evidence there:

* nothing: the numbers lie within the estimator's phase error, the tolerance of the readout's corners, and what detail
  below a cell of the picture misleads by;
* the intensity is late: both axes lag by one time;  * the phase of one axis is off: that axis alone lags;
* the light fades;  * the sample moves along an axis: both directions' sweeps alike.

A detector's lag delays and blurs, so that it is told from a delay by a second fit through the detector's own response.
A bent field bends every picture alike: it cannot be seen without a known target, and neither can a wrong swing.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimation.mismatch.diagnosis import Estimate, Finding, Rival
from estimation.mismatch.naming import LEAD_OVER_NEXT, LEAD_OVER_NOTHING
from estimation.mismatch.sensitivity import APART
from recon.optics_fit import AT_REST, AXES, COARSEST, Fit, Numbers, Scan, fit, foretold, look, measured_noise, scan_of
from recon.scene import Noise
from scanner.channel import Channel
from scanner.device import Amdm, Device
from scanner.motion import Motion
from scanner.terms import Scales, Term, catalogue

Array = NDArray[np.float64]

METRIC = "reduced chi-square of the intensity about the best picture, on blocks of time not used in the fit"

MISLED = 0.1
"""What detail finer than a cell of the picture misleads a place by [cells]; a whole cell where samples of one cell
scatter more than ``RESOLVED`` times what neighbouring cells differ by: such a sample the picture does not resolve."""

RESOLVED = 1.25

FLICKER = 0.01
"""What it misleads the light by, as a fraction, over the recording."""

LATEST = 25e-6
"""Lateness of an intensity that is searched for [s]."""

TURN = np.radians(15.0)
"""Phase error that is searched for."""

CLEARLY = 0.95
"""Share of the scatter at rest below which another start is worth trying."""

SEARCHED = 40_000
"""Samples that the search looks at: a start needs no more."""

WANDER, SWELL = np.radians(0.3), 0.02
"""Slow change of phase, and of relative swing, over a recording that an estimator may have missed."""

JUDGED = 60_000
"""Samples by which a delay is told from a lag: every step of that runs through the detector many times."""

BLURRED = 1.25
"""Cells that a lag must smooth over before it can be told from a delay."""

SHORT = 0.06
"""Relative standard deviation of a lag that is told."""

MOST_EFFECTS = 4

MEASURED = ("late_x", "late_y", "slew_x", "slew_y", "swell_x", "swell_y", "fade", "move_x", "move_y")


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
class Visible:
    """How many standard deviations an effect of natural size would amount to in this recording."""

    effect: str
    axis: str
    sigma: float


@dataclass(frozen=True)
class Judgement:
    """What the picture says of the optics.

    Attributes:
        findings: in order of weight.
        visible: what this recording could tell.
        terms: for the improved device: axis -> effect -> parameter -> value.
    """

    findings: tuple[Finding, ...]
    visible: tuple[Visible, ...]
    terms: Mapping[str, Mapping[str, Mapping[str, float]]]

    def to_json(self) -> list[dict[str, object]]:
        """What could be told, for diagnosis.json."""
        return [{"effect": v.effect, "axis": v.axis, "sigma": v.sigma, "told": v.sigma >= APART} for v in self.visible]


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


@dataclass(frozen=True)
class Measured:
    """The numbers of the optics as measured: likelihood ``exp(-(p' H p)/2 + b' p)``.

    Attributes:
        information: H. push: b. prior: covariance of the numbers where nothing is wrong.
    """

    information: Array
    push: Array
    prior: Array

    def posterior(self, effects: list[Effect]) -> tuple[Array, Array, float]:
        """Mean and covariance of (numbers, amplitudes), and -2 log evidence but for a constant."""
        ways = np.array([[each.direction.get(name, 0.0) for name in MEASURED] for each in effects])
        joint = np.vstack([np.eye(len(MEASURED)), ways.reshape(-1, len(MEASURED))])
        prior = np.zeros((len(joint), len(joint)))
        n = len(MEASURED)
        prior[:n, :n] = self.prior
        prior[range(n, len(joint)), range(n, len(joint))] = [each.size**2 for each in effects]
        root = np.linalg.cholesky(prior)
        inner = np.eye(len(joint)) + root.T @ joint @ self.information @ joint.T @ root
        push = root.T @ joint @ self.push
        covariance = root @ np.linalg.inv(inner) @ root.T
        mean = covariance @ joint @ self.push
        evidence = float(-push @ np.linalg.solve(inner, push) + np.linalg.slogdet(inner)[1])
        return mean, covariance, evidence


def judge_optics(motion: Motion, intensity: Channel, device: Device) -> Judgement:
    """What the samples of a scan say of its optics.

    Args:
        motion: of both axes, at the intensity's samples.
        device: nominal, for its tolerances.
    """
    scan = scan_of({axis: motion.axes[axis].angle for axis in AXES}, intensity)
    rates = {axis: 2 * np.pi * float(np.median(motion.axes[axis].frequency)) for axis in AXES}
    wide = _wide(rates)
    noise, found = _measured(scan, wide, rates)
    p = found.p
    prior = _calibration(motion, device, rates, scan, noise)
    at = np.array([p[name] for name in MEASURED])
    measured = Measured(found.information, found.information @ at + at / found.sd**2, prior)
    effects = possible_effects(scan, rates)
    named, rivals = named_effects(measured, effects)
    visible = tuple(Visible(each.name, each.axis, _sigma(measured, each)) for each in effects)
    visible += tuple(Visible("field-distortion", axis, 0.0) for axis in AXES)
    if not named:
        return Judgement((), visible, {})
    mean, covariance, _ = measured.posterior(named)
    after = {**AT_REST, **dict(zip(MEASURED, _numbers(mean, named), strict=True))}
    heldout = {
        "metric": METRIC,
        "before": fit(scan, {}, AT_REST, noise, scan.finest, 0).held_chi2,
        "after": fit(scan, {}, after, noise, scan.finest, 0).held_chi2,
    }
    findings, terms = [], dict[str, dict[str, dict[str, float]]]()
    for i, effect in enumerate(named):
        k = len(MEASURED) + i
        value, sd = float(mean[k]), float(np.sqrt(covariance[k, k]))
        others = [each for each in named if each is not effect]
        lead = measured.posterior(others)[2] - measured.posterior(named)[2]
        told = _told(effect, value, sd, scan, rates)
        against = [(distance, _name(rival, value)) for distance, rival in rivals[effect.name, effect.axis]]
        if told.effect == "intensity-delay":
            told, distance, other = _late_or_lagging(scan, told, value, after)
            against.append((distance, other))
        findings.append((lead, _finding(told, lead, against, heldout)))
        if told.parameters and told.effect in catalogue() and told.stage == "optics":
            parameters = {each.name: each.value for each in told.parameters}
            terms.setdefault(told.axis, {})[told.effect] = parameters
    findings.sort(key=lambda pair: -pair[0])
    return Judgement(tuple(finding for _, finding in findings), visible, terms)


def _wide(rates: Mapping[str, float]) -> Numbers:
    """Priors of the measurement itself: none to speak of."""
    wide = {"fade": 1.0, **{f"swell_{axis}": SWELL for axis in AXES}, **{f"move_{axis}": 0.1 for axis in AXES}}
    for axis in AXES:
        wide |= {f"late_{axis}": max(LATEST, TURN / rates[axis]), f"slew_{axis}": np.radians(5.0) / rates[axis]}
    return {name: wide[name] for name in MEASURED}


def _measured(scan: Scan, wide: Numbers, rates: Mapping[str, float]) -> tuple[Noise, Fit]:
    """The numbers of the optics, and what samples of one cell then scatter by.

    Detail that repeats makes a wrong place look right, and cells that do not resolve it are misled: whatever comes from
    coarse cells counts only where it is clearly better than what is found next to rest.
    """
    fits = [_refined(scan, wide, AT_REST, scan.finest)]
    fits += [_refined(scan, wide, start, COARSEST) for start in _starts(scan, rates)]
    best = min(fits, key=lambda pair: pair[0].scatter)
    return best if best[0].scatter < CLEARLY * fits[0][0].scatter else fits[0]


def _refined(scan: Scan, wide: Numbers, p: Numbers, cells: int) -> tuple[Noise, Fit]:
    """From ``cells`` to the finest."""
    while True:
        noise = measured_noise(scan, look(scan, p, cells), cells)
        found = fit(scan, wide, p, noise, cells)
        p = found.p
        if cells == scan.finest:
            return measured_noise(scan, look(scan, p, cells), cells), found
        cells = min(2 * cells, scan.finest)


def _starts(scan: Scan, rates: Mapping[str, float]) -> list[Numbers]:
    """Rest, and where samples of a coarse cell scatter clearly less: both axes late by one time, or one axis alone."""
    few = scan.beginning(SEARCHED)
    fast = scan.fastest
    tried = [AT_REST]
    for names, step, reach in (
        (("late_x", "late_y"), 1.0 / COARSEST / max(fast.values()), max(LATEST, TURN / max(rates.values()))),
        *((((f"late_{axis}",), 1.0 / COARSEST / fast[axis], TURN / rates[axis])) for axis in AXES),
    ):
        lates = step * np.arange(-np.ceil(reach / step), np.ceil(reach / step) + 1)
        tried += [{**AT_REST, **dict.fromkeys(names, float(late))} for late in lates]
    scatter = [measured_noise(few, look(few, p, COARSEST), COARSEST).scatter for p in tried]
    best = int(np.argmin(scatter))
    return [AT_REST, tried[best]] if scatter[best] < CLEARLY * scatter[0] else [AT_REST]


def _calibration(motion: Motion, device: Device, rates: Mapping[str, float], scan: Scan, noise: Noise) -> Array:
    """Covariance of the measured numbers where nothing is wrong but what is known to be uncertain."""
    misled = MISLED if noise.scatter < RESOLVED * noise.contrast else 1.0
    blur = 2.0 * misled / scan.finest
    sd = {"fade": FLICKER, **{f"move_{axis}": blur for axis in AXES}, **{f"swell_{axis}": SWELL for axis in AXES}}
    for axis in AXES:
        phase_sd = float(np.sqrt(np.nanmean(np.square(motion.axes[axis].phase_sd))))
        late = np.hypot(phase_sd / rates[axis], blur / scan.fastest[axis])
        sd |= {f"late_{axis}": float(late), f"slew_{axis}": float(np.hypot(late, WANDER / rates[axis]))}
    prior = np.diag([sd[name] ** 2 for name in MEASURED])
    corners = np.array([_corner_shift(device, axis, rates[axis]) for axis in AXES])
    if device.readout is not None:  # one readout, one error
        prior[:2, :2] += np.outer(corners, corners)
    else:
        prior[:2, :2] += np.diag(corners**2)
    return prior


def _corner_shift(device: Device, axis: str, rate: float) -> float:
    """How late the motion may seem because the readout's corners are not quite where they are said to be [s]."""
    readout = device.readout or device.axis(axis).readout
    if not isinstance(readout, Amdm):
        return 0.0
    sense = rate / np.pi  # an even capacitance shows the motion at twice its frequency [Hz]
    ratio = sense / np.array(readout.lpf_hz)
    turned = device.tolerance(axis, "lpf_hz") * float(np.sum(ratio / (1.0 + ratio**2)))
    return turned / (2 * np.pi * sense)


def _scales(scan: Scan, axis: str, rate: float) -> Scales:
    return Scales(scan.half[axis], rate, 1.0, 1.0, 1.0, scan.duration)


def possible_effects(scan: Scan, rates: Mapping[str, float]) -> list[Effect]:
    """What is looked for, with the sizes that the terms state."""
    known = catalogue()
    scales = {axis: _scales(scan, axis, rates[axis]) for axis in AXES}

    def size(effect: str, axis: str) -> float:
        return known[effect].parameters[0].scale(scales[axis])

    fading = scan.duration / size("bleaching", "x")
    effects = [
        Effect("intensity-delay", "x", {"late_x": 1.0, "late_y": 1.0}, size("intensity-delay", "x")),
        Effect("bleaching", "x", {"fade": 1.0}, fading),
    ]
    for axis in AXES:
        moved = size("sample-motion", axis) * scan.duration / scan.half[axis]
        effects.append(Effect("sample-motion", axis, {f"move_{axis}": 1.0}, moved))
        effects.append(Effect("phase", axis, {f"late_{axis}": 1.0}, TURN / rates[axis]))
    return effects


def named_effects(
    measured: Measured, effects: list[Effect]
) -> tuple[list[Effect], dict[tuple[str, str], list[tuple[float, Effect]]]]:
    """Effects one after the other, each the one that adds most evidence, and the rivals it had, with their distance."""
    named: list[Effect] = []
    rivals: dict[tuple[str, str], list[tuple[float, Effect]]] = {}
    best = measured.posterior([])[2]
    while len(named) < MOST_EFFECTS:
        tried = sorted(
            ((measured.posterior([*named, each])[2], each) for each in effects if each not in named),
            key=lambda pair: pair[0],
        )
        if best - tried[0][0] < LEAD_OVER_NOTHING:
            break
        best, found = tried[0]
        named.append(found)
        rivals[found.name, found.axis] = [
            (evidence - best, each) for evidence, each in tried[1:] if set(each.direction) & set(found.direction)
        ]
        for each in [each for each in named if each is not found]:  # what a later effect has made superfluous
            less = [other for other in named if other is not each]
            if measured.posterior(less)[2] - best < LEAD_OVER_NOTHING:
                named, best = less, measured.posterior(less)[2]
    return named, rivals


def _numbers(mean: Array, effects: list[Effect]) -> list[float]:
    """The measured numbers that a posterior mean of (numbers, amplitudes) stands for."""
    n = len(MEASURED)
    total = mean[:n].copy()
    for amplitude, effect in zip(mean[n:], effects, strict=True):
        total += [amplitude * effect.direction.get(name, 0.0) for name in MEASURED]
    return [float(value) for value in total]


def _sigma(measured: Measured, effect: Effect) -> float:
    """Natural size of an effect over what it could be measured to, calibration in doubt as it is."""
    spread = measured.prior + np.linalg.pinv(measured.information)
    way = np.array([effect.direction.get(name, 0.0) for name in MEASURED])
    return float(effect.size * np.sqrt(way @ np.linalg.solve(spread, way)))


def _name(effect: Effect, value: float) -> str:
    """In the catalogue's words; a phase of one axis that is off has no cause that the picture could tell."""
    if effect.name == "phase" or (effect.name == "bleaching" and value < 0.0):
        return "unknown"
    return "channel-delay" if effect.name == "intensity-delay" and value < 0.0 else effect.name


def _told(effect: Effect, value: float, sd: float, scan: Scan, rates: Mapping[str, float]) -> Told:
    """An effect of one amplitude, told in the units of its term."""
    name, axis, low, high = _name(effect, value), effect.axis, value - 1.96 * sd, value + 1.96 * sd
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


def _late_or_lagging(scan: Scan, told: Told, late: float, p: Numbers) -> tuple[Told, float, str]:
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


def _finding(told: Told, lead: float, against: list[tuple[float, str]], heldout: Mapping[str, object]) -> Finding:
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
