"""The improved device: values that the recording determines, and terms that do not make its prediction worse."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from estimation.candidate_terms.discrepancy import is_discrepancy
from estimation.candidate_terms.significance import DETECTION_THRESHOLD, held_out_gain, residual_is_noise
from estimation.device_fit.data import Run
from estimation.device_fit.fit import (
    Fit,
    fit_model,
    held_out_samples,
    misfit,
    nominal_values_are_improbable,
    time_blocks,
)
from estimation.device_fit.noise import sample_times
from estimation.device_fit.open_loop import DIVERGED_ERROR, OpenLoop, has_larger_error, is_worse, open_loop
from estimation.diagnosis.discrepancy_law import STATIC_PARAMETERS, measured_law_table
from estimation.diagnosis.identifiability import determined_parameters
from estimation.diagnosis.pruning import refit_without, with_free_parameters
from estimation.diagnosis.selection import SelectionResult, SelectionStep
from scanner.arrays import Array
from scanner.device import Axis, Device
from scanner.stages import MotionSensor
from scanner.terms.measured_law import EFFECT as MEASURED_LAW


@dataclass(frozen=True)
class Improvement:
    """Improved device of a diagnosis.

    Attributes:
        search: result of the selection without the rejected findings.
        device: the improved device, or the nominal one if its open-loop error is not larger.
        nominal, improved: open-loop errors of the nominal and of the improved device, by channel.
        remainder_fit: of a measured law of what the named laws leave, if the device holds one.
    """

    search: SelectionResult
    device: Device
    nominal: Mapping[str, OpenLoop]
    improved: Mapping[str, OpenLoop]
    remainder_fit: Fit | None = None

    def to_json(self) -> dict[str, Any]:
        """The content of ``open_loop`` in diagnosis.json."""
        return {
            name: {"nominal": loop.to_json(), "improved": self.improved[name].to_json()}
            for name, loop in self.nominal.items()
        }


def improve(result: SelectionResult) -> Improvement:
    """Improve the device by the findings that its open-loop prediction supports.

    Findings beside others that the held-out samples contradict are rejected first. The weakest finding is removed as
    long as the prediction rejects it; a rail at which samples stand is certain and stays. If the findings leave noise
    alone, they are rejected by a prediction that is worse than that of the nominal device, beyond the uncertainty of
    the comparison; within it they stay, but the nominal device takes the place of one with a larger error. If they
    leave more than noise, they have to explain more of the misfit than they leave, and to lower the error, and the
    weakest of them too. A discrepancy term always remains a finding, but if the device with its measured law predicts
    any channel of any run worse, the device with the named laws alone is returned, or the nominal one if that is worse
    too.
    """
    result = without_contradicted(_settled(result))
    runs, stated = result.likelihood.runs, result.final.model.device
    nominal = open_loop(runs, stated)
    while True:
        unnamed = any(is_discrepancy(step.candidate) for step in result.steps)
        device = improved_device(_fit_static_law(result) if unnamed else result.final)
        improved = open_loop(runs, device)
        if unnamed or not any(step.candidate.term.free_parameters for step in result.steps):
            options = [device]
            if unnamed and len(result.steps) > 1:  # the device with the named laws alone
                *_, discrepancy = result.final.model.candidates
                options.append(improved_device(refit_without(result.likelihood, result.final, discrepancy)))
            better = next((one for one in options if all(predicts_no_worse(run, stated, one) for run in runs)), stated)
            return Improvement(result, better, nominal, open_loop(runs, better))
        if residual_is_noise(result.final):
            if not is_worse(nominal, improved):
                if has_larger_error(nominal, improved):
                    device, improved = stated, nominal
                return Improvement(result, device, nominal, improved)
            result = without_weakest(result)
        else:
            reduced = without_weakest(result)
            others = [nominal, open_loop(runs, improved_device(reduced.final))] if reduced.steps else [nominal]
            if _explain_most(result) and all(has_larger_error(improved, other) for other in others):
                return Improvement(result, device, nominal, improved)
            result = reduced


def _settled(result: SelectionResult) -> SelectionResult:
    """The result with a final fit that is continued with undetermined nominal values as stated, if that is better.

    Along a curved valley a fit ends where a step gains little, many tolerances from the stated values. From there the
    way back to them, which ``determined_parameters`` takes to first order, would change the motion.
    """
    final = result.final
    fit = fit_model(result.likelihood, final.model, determined_parameters(final))
    if misfit(fit) >= misfit(final):
        return result
    return replace(result, final=fit, steps=tuple(replace(step, after=fit) for step in result.steps))


def _explain_most(result: SelectionResult) -> bool:
    """Whether the findings explain more of the misfit of the fitted samples than they leave above the noise.

    Where nominal values are improbable without the findings, they have absorbed a part of what the findings explain,
    and nothing follows.
    """
    explained, left = misfit(result.nominal) - misfit(result.final), result.final.chi2 - result.final.rows.sum()
    return nominal_values_are_improbable(result.nominal) or bool(explained > left)


def predicts_no_worse(run: Run, stated: Device, device: Device) -> bool:
    """Whether ``device`` predicts every channel of a run with an error at most that of the stated device."""
    nominal, improved = open_loop([run], stated), open_loop([run], device)
    return all(improved[name].error <= loop.error for name, loop in nominal.items())


def _fit_static_law(result: SelectionResult) -> Fit:
    """Refit the final model with only the static part of its discrepancy term, which a device file can state.

    See ``measured_law_table``.
    """
    model = result.final.model
    *others, discrepancy = model.candidates
    static = STATIC_PARAMETERS.get(discrepancy.term.effect, ())
    reduced = model.with_candidates([*others, *([with_free_parameters(discrepancy, static)] if static else [])])
    return fit_model(result.likelihood, reduced, reduced.map_parameters_from(model, result.final.x))


def without_weakest(result: SelectionResult) -> SelectionResult:
    """The result of a selection without the fitted finding whose removal raises the misfit least, refitted."""
    return _without(result, min(_fitted(result), key=lambda step: misfit(step.before)))


def without_contradicted(result: SelectionResult) -> SelectionResult:
    """The result of a selection without findings beside others that the held-out samples contradict, refitted.

    Without such a finding the misfit of these samples is lower by more than a law has to gain: it follows the noise, or
    what no law describes, in the fitted samples alone.
    """
    while len(_fitted(result)) > 1:
        gain, i = min((held_out_gain(step.before, step.after), i) for i, step in enumerate(_fitted(result)))
        if gain >= -DETECTION_THRESHOLD:
            break
        result = _without(result, _fitted(result)[i])
    return result


def _fitted(result: SelectionResult) -> list[SelectionStep]:
    """The steps whose terms have parameters that are fitted; a rail at which samples stand has none."""
    return [step for step in result.steps if step.candidate.term.free_parameters]


def _without(result: SelectionResult, removed: SelectionStep) -> SelectionResult:
    """The result of a selection without one of its findings, refitted."""
    remaining = [step for step in result.steps if step is not removed]
    final = refit_without(result.likelihood, result.final, removed.candidate) if remaining else result.nominal

    def refit(step: SelectionStep) -> SelectionStep:
        is_only_fitted = len(remaining) == 1 and step.candidate.term.free_parameters
        before = result.nominal if is_only_fitted else refit_without(result.likelihood, final, step.candidate)
        return replace(step, before=before, after=final)

    return replace(result, final=final, steps=tuple(map(refit, remaining)))


def improved_device(fit: Fit) -> Device:
    """The device with the fitted nominal values, as far as the recording determines them, and the fitted terms."""
    fit = replace(fit, x=determined_parameters(fit))
    device = fit.model.device
    axes: dict[str, Axis] = dict(device.axes)
    shared_readout = device.readout
    for name in fit.model.axes:
        axis = _with_fitted_offset(fit, name, fit.model.nominal(name, fit.x))
        if shared_readout is not None:
            shared_readout = axis.readout if name == next(iter(device.axes)) else shared_readout
            axis = replace(axis, readout=None)
        terms = {effect: dict(values) for effect, values in device.axis(name).terms.items()}
        for candidate in fit.model.candidates:
            term = candidate.term
            if candidate.axis != name:
                continue
            if not is_discrepancy(candidate):
                values = fit.model.values(candidate, fit.x)
                terms[term.effect] = {p.name: float(v) for p, v in zip(term.parameters, values, strict=True)}
                if variant := term.channels.index(candidate.channel):
                    terms[term.effect]["variant"] = variant
            elif (table := measured_law_table(fit)) is not None:
                terms[MEASURED_LAW] = table
        axes[name] = replace(axis, terms=terms)
    return replace(device, axes=axes, readout=shared_readout)


def _with_fitted_offset(fit: Fit, name: str, axis: Axis) -> Axis:
    """An axis with the mean over all runs of the constant that was fitted beside the stated offset of its sensor.

    Under noise that rises towards 0 Hz a fit leaves a part of a constant in the residual; see ``remaining_offset``.
    """
    model, readout, values = fit.model, axis.readout, list[float]()
    if not isinstance(readout, MotionSensor):
        return axis
    for r, (run, signals) in enumerate(zip(model.runs, model.outputs(fit.x), strict=True)):
        for output, signal in zip(run.outputs, signals, strict=True):
            index = model.index("additive", output.name, "offset", r)
            if not np.abs(signal).max() < DIVERGED_ERROR:
                continue  # nothing follows from a trajectory that has diverged
            if output.kind == "sense" and output.axes == (name,) and index is not None:
                fitted = float(fit.x[index] * model.additive_terms(output)["offset"][0])
                values.append(fitted + remaining_offset(output.data - signal, output.guard))
    if not values:
        return axis
    return replace(axis, readout=replace(readout, offset=readout.offset + sum(values) / len(values)))


def remaining_offset(residual: Array, guard: tuple[int, int] = (0, 0)) -> float:
    """Constant in a residual, as far as it exceeds the scatter of slow noise between the fitted blocks of time.

    Args:
        residual: in the unit of its channel, shape (n,).
        guard: samples at the start and at the end that are not compared.

    Source: positive-part estimator, James & Stein, Proc. 4th Berkeley Symp. 1, 361 (1961).
    """
    size = residual.size
    block = time_blocks(sample_times(size))
    used = ~held_out_samples(size)
    used[: guard[0]] = used[size - guard[1] :] = False
    means = np.array([residual[used & (block == one)].mean() for one in np.unique(block[used])])
    mean = float(means.mean())
    return mean * max(0.0, 1.0 - float(means.var()) / max(mean**2, 1e-300))
