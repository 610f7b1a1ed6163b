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

from estimation.mismatch.diagnosis import Finding
from estimation.mismatch.naming import LEAD_OVER_NOTHING
from estimation.mismatch.sensitivity import APART
from recon.optics_fit import AT_REST, AXES, COARSEST, MISLED, Fit, Numbers, Scan, fit, look, measured_noise, scan_of
from recon.optics_told import Effect, finding_of, late_or_lagging, tell, told_name
from recon.scene import Noise
from scanner.channel import Channel
from scanner.device import Amdm, Device
from scanner.motion import Motion
from scanner.terms import Scales, catalogue

Array = NDArray[np.float64]

METRIC = "reduced chi-square of the intensity about the best picture, on blocks of time not used in the fit"

FLICKER = 0.01
"""What detail finer than a cell of the picture misleads the light by, as a fraction, over the recording."""

RESOLVED = 1.25
"""Variance of the samples of one cell over what neighbouring cells differ by, from which on the picture does not
resolve the sample. ``MISLED`` and ``FLICKER`` are then a whole cell and half of the light: which sweep meets which
detail is decided by the scan's pattern."""

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

MOST_EFFECTS = 4

MEASURED = ("late_x", "late_y", "slew_x", "slew_y", "swell_x", "swell_y", "fade", "move_x", "move_y")


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
    named = _foretelling(scan, noise, measured, named)
    visible = tuple(Visible(each.name, each.axis, _sigma(measured, each)) for each in effects)
    visible += tuple(Visible("field-distortion", axis, 0.0) for axis in AXES)
    if not named:
        return Judgement((), visible, {})
    mean, covariance, _ = measured.posterior(named)
    after = _numbers(mean, named)
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
        told = tell(effect, value, sd, scan, rates)
        against = [(distance, told_name(rival, value)) for distance, rival in rivals[effect.name, effect.axis]]
        if told.effect == "intensity-delay":
            told, distance, other = late_or_lagging(scan, told, value, after)
            against.append((distance, other))
        findings.append((lead, finding_of(told, lead, against, heldout)))
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
    misled, flicker = (MISLED, FLICKER) if noise.scatter < RESOLVED * noise.contrast else (1.0, 0.5)
    blur = 2.0 * misled / scan.finest
    sd = {"fade": flicker, **{f"move_{axis}": blur for axis in AXES}, **{f"swell_{axis}": SWELL for axis in AXES}}
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


def _foretelling(scan: Scan, noise: Noise, measured: Measured, named: list[Effect]) -> list[Effect]:
    """Those of ``named`` without whose amplitude samples that no fit has seen are foretold worse."""
    mean = measured.posterior(named)[0]

    def error(amplitudes: Array) -> float:
        p = _numbers(np.concatenate([mean[: len(MEASURED)], amplitudes]), named)
        return fit(scan, {}, p, noise, scan.finest, 0).held_chi2

    amplitudes = mean[len(MEASURED) :]
    errors = [error(np.where(np.arange(len(named)) == i, 0.0, amplitudes)) for i in range(len(named))]
    best = error(amplitudes)
    return [each for each, without in zip(named, errors, strict=True) if without > best]


def _numbers(mean: Array, effects: list[Effect]) -> Numbers:
    """The optics that a posterior mean of (numbers, amplitudes) stands for."""
    n = len(MEASURED)
    total = mean[:n].copy()
    for amplitude, effect in zip(mean[n:], effects, strict=True):
        total += [amplitude * effect.direction.get(name, 0.0) for name in MEASURED]
    return {**AT_REST, **dict(zip(MEASURED, total.tolist(), strict=True))}


def _sigma(measured: Measured, effect: Effect) -> float:
    """Natural size of an effect over what it could be measured to, calibration in doubt as it is."""
    spread = measured.prior + np.linalg.pinv(measured.information)
    way = np.array([effect.direction.get(name, 0.0) for name in MEASURED])
    return float(effect.size * np.sqrt(way @ np.linalg.solve(spread, way)))
