"""Distance of a finding from its confounders, and further measurements that would exclude them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from estimation.candidate_terms.screening import amplitude_indices
from estimation.device_fit.data import Run
from estimation.device_fit.fit import Fit, Likelihood, linearise_simulated
from estimation.device_fit.initial import start_indices, stated_whitener
from estimation.device_fit.model import Model
from estimation.device_fit.noise import Whitener
from estimation.device_fit.parameters import Candidate
from estimation.diagnosis.identifiability import (
    DISCRIMINATION_SIGMA,
    candidate_sensitivities,
    confusion_probability,
    unexplained_norms,
)
from scanner.arrays import Array

RELATIVE_ANGLE_NOISE_SD = 1e-3
"""Standard deviation of the noise of a proposed angle channel, in amplitudes of the motion: assumes a detector that
resolves a thousandth of the amplitude."""


def distances_to_rivals(
    likelihood: Likelihood, fit: Fit, candidate: Candidate, rivals: Sequence[Candidate]
) -> list[float]:
    """Norm of the fitted effect of a candidate that remains after each rival is fitted to it [sigma].

    For a rival without any effect it is the norm of the effect itself.
    """
    of_candidate = np.array([f.kind in ("term", "hidden") and f.owner == candidate.key for f in fit.model.parameters])
    signal = _effect_signal(likelihood, fit, candidate)[fit.rows]
    other_columns = fit.jacobian[np.ix_(fit.rows, ~of_candidate)]
    distances = []
    for blocks in candidate_sensitivities(likelihood, fit, rivals):
        rows_of_blocks = [block[fit.rows] for block in blocks]
        size, after_rival = unexplained_norms(
            other_columns, fit.model.precision[~of_candidate], signal[:, None], rows_of_blocks
        )
        distances.append(float(min([size[0], *after_rival[0]])))
    return distances


def _effect_signal(likelihood: Likelihood, fit: Fit, candidate: Candidate) -> Array:
    """Effect of a candidate on the whitened residual, shape (N,); to first order if it has an amplitude."""
    amplitudes = amplitude_indices(fit.model, candidate)
    if amplitudes:
        return np.asarray(fit.jacobian[:, amplitudes] @ fit.x[amplitudes])
    without = fit.model.with_candidates([other for other in fit.model.candidates if other is not candidate])
    return fit.residual - likelihood.residual(without, without.map_parameters_from(fit.model, fit.x))


def rank_experiments(
    likelihood: Likelihood, fit: Fit, candidate: Candidate, rival: Candidate
) -> list[tuple[str, float]]:
    """Further measurements, each with the distance [sigma] to ``rival`` that it would give; the best first."""
    ranked = []
    for description, model, x, whiteners in _experiments(likelihood, fit, candidate.axis):
        simulated = linearise_simulated(model, x, whiteners)
        ranked.append((description, distances_to_rivals(*simulated, candidate, [rival])[0]))
    return sorted(ranked, key=lambda pair: -pair[1])


def discrimination_advice(
    likelihood: Likelihood, fit: Fit, candidate: Candidate, rival: Candidate, distance: float
) -> str:
    """Distance to a confounder in words, and the measurements that would distinguish the two."""
    name = rival.term.effect
    distance_text = (
        f"{name} is at a distance of {distance:.1f} σ, at which noise would favour it in "
        f"{confusion_probability(distance):.0%} of repeated recordings (at {DISCRIMINATION_SIGMA} σ in "
        f"{confusion_probability(DISCRIMINATION_SIGMA):.0%})"
    )
    computed = [
        f"{description}: {d:.1f} σ"
        for description, d in rank_experiments(likelihood, fit, candidate, rival)
        if d > 1.2 * distance
    ]
    general = candidate.term.confounders.get(name) or rival.term.confounders.get(candidate.term.effect)
    return "; ".join([distance_text, *computed, *([general] if general else [])])


def _experiments(
    likelihood: Likelihood, fit: Fit, axis: str
) -> Iterator[tuple[str, Model, Array, Sequence[Sequence[Whitener]]]]:
    """Measurements that could be added to the runs of ``fit``: an angle channel, and a second run of each variation.

    Each is a description, the model of all runs, its parameters, and the whiteners of all channels.
    """
    runs, whiteners = fit.model.runs, likelihood.whiteners
    index = next(i for i, run in enumerate(runs) if axis in run.inputs)
    if not any(output.name == f"angle_{axis}" for run in runs for output in run.outputs):
        with_angle = _with_angle(runs[index], axis)
        with_noise = (*whiteners[index], stated_whitener(with_angle.outputs[-1]))
        yield (
            f"with its angle recorded, noise {RELATIVE_ANGLE_NOISE_SD:g} of the amplitude",
            *_with_runs(fit, (*runs[:index], with_angle, *runs[index + 1 :])),
            (*whiteners[:index], with_noise, *whiteners[index + 1 :]),
        )
    for description, run, amplitude_factor in _variations(fit.model, runs[index], axis):
        model, x = _with_runs(fit, (*runs, run))
        for name in run.inputs:
            x[start_indices(model, name, len(runs))] = amplitude_factor * x[start_indices(model, name, index)]
        yield f"with {description} in addition", model, x, (*whiteners, whiteners[index])


def _with_runs(fit: Fit, runs: Sequence[Run]) -> tuple[Model, Array]:
    """Model of other runs, and its parameters at the fitted ones; those of the state of an added run are zero."""
    model = Model(runs, fit.model.device, fit.model.candidates, fit.model.mains)
    return model, model.map_parameters_from(fit.model, fit.x)


def _with_angle(run: Run, axis: str) -> Run:
    sensed = next(output for output in run.outputs if axis in output.axes)
    noise = RELATIVE_ANGLE_NOISE_SD * run.scales[axis].amplitude
    angle = replace(sensed, name=f"angle_{axis}", kind="angle", axes=(axis,), noise_sd=noise)
    return replace(run, outputs=(*run.outputs, angle))


def _variations(model: Model, run: Run, axis: str) -> Iterator[tuple[str, Run, float]]:
    """Second recordings: description, recording, and factor of the initial amplitude."""
    drive, scales = model.device.axis(axis).drive, run.scales[axis]
    is_linear = drive is not None and drive.kind == "linear"
    if scales.voltage_rms <= 1e-6 * abs(scales.voltage_mean):
        yield "a ringdown from half the amplitude", run, 0.5
        if scales.voltage_mean and not is_linear:
            yield "a ringdown at 1.5 times the bias", _scale_drive(run, 1.5, 1.5), 1.0
    elif is_linear:
        yield "a recording at half the drive", _scale_drive(run, 0.5, 0.5), 0.5
    else:
        yield "a recording at 0.9 of the drive", _scale_drive(run, 0.9, 0.9), 1.0
        yield "a ringdown at the drive's mean voltage", _scale_drive(run, 1.0, 0.0), 1.0


def _scale_drive(run: Run, mean_factor: float, alternating_factor: float) -> Run:
    """The run with the mean and the alternating part of each drive scaled."""
    inputs = {}
    for name, drive in run.inputs.items():
        average = drive.voltage.mean()
        inputs[name] = replace(drive, voltage=mean_factor * average + alternating_factor * (drive.voltage - average))
    return replace(run, inputs=inputs)
