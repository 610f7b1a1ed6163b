"""How far a finding stands from its look-alikes, and which further measurement would move it away from them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimation.mismatch.experiment import Run
from estimation.mismatch.fit import Comparison, Fit
from estimation.mismatch.model import Candidate, Model
from estimation.mismatch.noise import Whitener
from estimation.mismatch.screen import amplitudes
from estimation.mismatch.sensitivity import APART, columns, left_over, linearised, stated_whitener

Array = NDArray[np.float64]

ANGLE_NOISE = 1e-3
"""Noise of an angle channel that is advised, in amplitudes of the motion."""


def distances_from(comparison: Comparison, fit: Fit, candidate: Candidate, rivals: Sequence[Candidate]) -> list[float]:
    """What each rival, with all else refitted, would leave of a candidate of the size that ``fit`` gives it [sigma].

    A rival that changes nothing leaves all of it.
    """
    own = np.array([f.kind in ("term", "hidden") and f.owner == candidate.key for f in fit.model.free])
    signal, rest = _signal(comparison, fit, candidate)[fit.rows], fit.jacobian[np.ix_(fit.rows, ~own)]
    found = []
    for blocks in columns(comparison, fit, rivals):
        shown = [block[fit.rows] for block in blocks]
        size, apart = left_over(rest, fit.model.precision[~own], signal[:, None], shown)
        found.append(float(min([size[0], *apart[0]])))
    return found


def _signal(comparison: Comparison, fit: Fit, candidate: Candidate) -> Array:
    """What a candidate does to the whitened residual, shape (N,): to first order where it has an amplitude."""
    moving = amplitudes(fit.model, candidate)
    if moving:
        return np.asarray(fit.jacobian[:, moving] @ fit.x[moving])
    kept = [each for each in fit.model.candidates if each is not candidate]
    less = Model(fit.model.runs, fit.model.device, kept, fit.model.mains)
    return fit.residual - comparison.residual(less, less.embed(fit.model, fit.x))


@dataclass(frozen=True)
class Further:
    """A measurement that could be added: the runs, their noise, and the free numbers of all."""

    what: str
    model: Model
    x: Array
    whiteners: Sequence[Sequence[Whitener]]


def remedies(comparison: Comparison, fit: Fit, candidate: Candidate, rival: Candidate) -> list[tuple[str, float]]:
    """Measurements beside those made, each with the distance [sigma] to ``rival`` that it would give, best first."""
    found = []
    for each in _further(comparison, fit, candidate.axis):
        together = linearised(each.model, each.x, each.whiteners)
        found.append((each.what, distances_from(*together, candidate, [rival])[0]))
    return sorted(found, key=lambda pair: -pair[1])


def advice(comparison: Comparison, fit: Fit, candidate: Candidate, rival: Candidate, distance: float) -> str:
    """In words: how far a look-alike stands, and what would tell the two apart."""
    name = rival.term.effect
    said = f"{name} lies {distance:.1f} σ away, {APART} are needed"
    computed = [f"{what}: {d:.1f} σ" for what, d in remedies(comparison, fit, candidate, rival) if d > 1.2 * distance]
    known = candidate.term.lookalikes.get(name) or rival.term.lookalikes.get(candidate.term.effect)
    return "; ".join([said, *computed, *([known] if known else [])])


def _further(comparison: Comparison, fit: Fit, axis: str) -> Iterator[Further]:
    """What could be measured beside the runs of ``fit``."""
    runs, whiteners = fit.model.runs, comparison.whiteners
    r = next(i for i, run in enumerate(runs) if axis in run.inputs)
    if not any(output.name == f"angle_{axis}" for run in runs for output in run.outputs):
        seeing = _with_angle(runs[r], axis)
        noise = (*whiteners[r], stated_whitener(seeing.outputs[-1]))
        yield _made(
            f"with its angle recorded, noise {ANGLE_NOISE:g} of the swing",
            fit, r, (*runs[:r], seeing, *runs[r + 1 :]), (*whiteners[:r], noise, *whiteners[r + 1 :]),
        )  # fmt: skip
    for what, second, swing in _variations(fit.model, runs[r], axis):
        yield _made(f"beside {what}", fit, r, (*runs, second), (*whiteners, whiteners[r]), swing)


def _with_angle(run: Run, axis: str) -> Run:
    seen = next(output for output in run.outputs if axis in output.axes)
    noise = ANGLE_NOISE * run.scales[axis].amplitude
    angle = replace(seen, name=f"angle_{axis}", kind="angle", axes=(axis,), noise_sd=noise)
    return replace(run, outputs=(*run.outputs, angle))


def _variations(model: Model, run: Run, axis: str) -> Iterator[tuple[str, Run, float]]:
    """A second recording: what it is, the recording, and the factor of the swing that it starts from."""
    drive, scales = model.device.axis(axis).drive, run.scales[axis]
    if drive is not None and drive.kind == "linear":
        yield "a recording at half the drive", _at_voltage(run, 0.5, 0.5), 0.5
    elif scales.voltage_rms <= 1e-6 * abs(scales.voltage_mean):
        yield "a ringdown from half the swing", run, 0.5
        if scales.voltage_mean:
            yield "a ringdown at 1.5 times the bias", _at_voltage(run, 1.5, 1.5), 1.0
    else:
        yield "a recording at 0.9 of the drive", _at_voltage(run, 0.9, 0.9), 1.0
        yield "a ringdown at the drive's mean voltage", _at_voltage(run, 1.0, 0.0), 1.0


def _at_voltage(run: Run, mean: float, swing: float) -> Run:
    """The run with other voltages: factors of their means, and of what they swing about those."""
    inputs = {}
    for name, each in run.inputs.items():
        middle = each.voltage.mean()
        inputs[name] = replace(each, voltage=mean * middle + swing * (each.voltage - middle))
    return replace(run, inputs=inputs)


def _made(what: str, fit: Fit, r: int, runs: Sequence[Run], whiteners: Sequence[Sequence[Whitener]],
          swing: float = 1.0) -> Further:  # fmt: skip
    """``runs`` around what was fitted; one that is new starts as run ``r`` did, ``swing`` times as far out."""
    old = fit.model
    model = Model(runs, old.device, old.candidates, old.mains)
    x = model.embed(old, fit.x)
    for i, free in enumerate(model.free):
        if free.kind == "start" and free.run == len(old.runs):
            start = old.index("start", free.owner, free.name, r)
            assert start is not None
            x[i] = swing * fit.x[start]
    return Further(what, model, x, whiteners)
