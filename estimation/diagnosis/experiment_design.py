"""Distance of a finding from its confounders, and further measurements that would increase it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from estimation.diagnosis.data import Run
from estimation.diagnosis.fit import Fit, Likelihood
from estimation.diagnosis.identifiability import (
    DISCRIMINATION_SIGMA,
    candidate_sensitivities,
    linearise_simulated,
    stated_whitener,
    unexplained_norms,
)
from estimation.diagnosis.model import Candidate, Model
from estimation.diagnosis.noise import Whitener
from estimation.diagnosis.screening import amplitude_indices
from scanner.arrays import Array

RELATIVE_ANGLE_NOISE_SD = 1e-3
"""Noise of a proposed angle channel, in amplitudes of the motion: an assumed detector that resolves a thousandth of
it."""


def distances_to_rivals(
    likelihood: Likelihood, fit: Fit, candidate: Candidate, rivals: Sequence[Candidate]
) -> list[float]:
    """Norm of the fitted effect of a candidate that remains after each rival is fitted in its place [sigma].

    For a rival without any effect it is the norm of the whole effect.
    """
    own = np.array([f.kind in ("term", "hidden") and f.owner == candidate.key for f in fit.model.parameters])
    signal, rest = _effect_signal(likelihood, fit, candidate)[fit.rows], fit.jacobian[np.ix_(fit.rows, ~own)]
    found = []
    for blocks in candidate_sensitivities(likelihood, fit, rivals):
        shown = [block[fit.rows] for block in blocks]
        size, apart = unexplained_norms(rest, fit.model.precision[~own], signal[:, None], shown)
        found.append(float(min([size[0], *apart[0]])))
    return found


def _effect_signal(likelihood: Likelihood, fit: Fit, candidate: Candidate) -> Array:
    """Effect of a candidate on the whitened residual, shape (N,); to first order if it has an amplitude."""
    moving = amplitude_indices(fit.model, candidate)
    if moving:
        return np.asarray(fit.jacobian[:, moving] @ fit.x[moving])
    kept = [each for each in fit.model.candidates if each is not candidate]
    less = Model(fit.model.runs, fit.model.device, kept, fit.model.mains)
    return fit.residual - likelihood.residual(less, less.map_parameters_from(fit.model, fit.x))


@dataclass(frozen=True)
class CandidateExperiment:
    """A proposed measurement: the model of all runs, its parameters, and the whiteners of all channels."""

    what: str
    model: Model
    x: Array
    whiteners: Sequence[Sequence[Whitener]]


def rank_experiments(
    likelihood: Likelihood, fit: Fit, candidate: Candidate, rival: Candidate
) -> list[tuple[str, float]]:
    """Further measurements, each with the distance [sigma] to ``rival`` that it would give; the best first."""
    found = []
    for each in _candidate_experiments(likelihood, fit, candidate.axis):
        together = linearise_simulated(each.model, each.x, each.whiteners)
        found.append((each.what, distances_to_rivals(*together, candidate, [rival])[0]))
    return sorted(found, key=lambda pair: -pair[1])


def discrimination_advice(
    likelihood: Likelihood, fit: Fit, candidate: Candidate, rival: Candidate, distance: float
) -> str:
    """Distance to a confounder in words, and the measurements that would distinguish the two."""
    name = rival.term.effect
    said = f"{name} lies {distance:.1f} σ away, {DISCRIMINATION_SIGMA} are needed"
    computed = [
        f"{what}: {d:.1f} σ" for what, d in rank_experiments(likelihood, fit, candidate, rival) if d > 1.2 * distance
    ]
    known = candidate.term.confounders.get(name) or rival.term.confounders.get(candidate.term.effect)
    return "; ".join([said, *computed, *([known] if known else [])])


def _candidate_experiments(likelihood: Likelihood, fit: Fit, axis: str) -> Iterator[CandidateExperiment]:
    """Measurements that could be added to the runs of ``fit``."""
    runs, whiteners = fit.model.runs, likelihood.whiteners
    r = next(i for i, run in enumerate(runs) if axis in run.inputs)
    if not any(output.name == f"angle_{axis}" for run in runs for output in run.outputs):
        seeing = _with_angle(runs[r], axis)
        noise = (*whiteners[r], stated_whitener(seeing.outputs[-1]))
        yield _candidate_experiment(
            f"with its angle recorded, noise {RELATIVE_ANGLE_NOISE_SD:g} of the swing",
            fit, r, (*runs[:r], seeing, *runs[r + 1 :]), (*whiteners[:r], noise, *whiteners[r + 1 :]),
        )  # fmt: skip
    for what, second, swing in _variations(fit.model, runs[r], axis):
        yield _candidate_experiment(f"beside {what}", fit, r, (*runs, second), (*whiteners, whiteners[r]), swing)


def _with_angle(run: Run, axis: str) -> Run:
    seen = next(output for output in run.outputs if axis in output.axes)
    noise = RELATIVE_ANGLE_NOISE_SD * run.scales[axis].amplitude
    angle = replace(seen, name=f"angle_{axis}", kind="angle", axes=(axis,), noise_sd=noise)
    return replace(run, outputs=(*run.outputs, angle))


def _variations(model: Model, run: Run, axis: str) -> Iterator[tuple[str, Run, float]]:
    """Second recordings: description, recording, and factor of the initial amplitude."""
    drive, scales = model.device.axis(axis).drive, run.scales[axis]
    if drive is not None and drive.kind == "linear":
        yield "a recording at half the drive", _scale_drive(run, 0.5, 0.5), 0.5
    elif scales.voltage_rms <= 1e-6 * abs(scales.voltage_mean):
        yield "a ringdown from half the swing", run, 0.5
        if scales.voltage_mean:
            yield "a ringdown at 1.5 times the bias", _scale_drive(run, 1.5, 1.5), 1.0
    else:
        yield "a recording at 0.9 of the drive", _scale_drive(run, 0.9, 0.9), 1.0
        yield "a ringdown at the drive's mean voltage", _scale_drive(run, 1.0, 0.0), 1.0


def _scale_drive(run: Run, mean: float, swing: float) -> Run:
    """The run with the mean of each drive scaled by ``mean`` and its alternating part by ``swing``."""
    inputs = {}
    for name, each in run.inputs.items():
        middle = each.voltage.mean()
        inputs[name] = replace(each, voltage=mean * middle + swing * (each.voltage - middle))
    return replace(run, inputs=inputs)


def _candidate_experiment(what: str, fit: Fit, r: int, runs: Sequence[Run], whiteners: Sequence[Sequence[Whitener]],
          swing: float = 1.0) -> CandidateExperiment:  # fmt: skip
    """Model of ``runs`` at the fitted parameters; a new run starts from the state of run ``r`` times ``swing``."""
    old = fit.model
    model = Model(runs, old.device, old.candidates, old.mains)
    x = model.map_parameters_from(old, fit.x)
    for i, free in enumerate(model.parameters):
        if free.kind == "start" and free.run == len(old.runs):
            start = old.index("start", free.owner, free.name, r)
            assert start is not None
            x[i] = swing * fit.x[start]
    return CandidateExperiment(what, model, x, whiteners)
