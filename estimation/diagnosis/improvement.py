"""The improved device: what was found is written where the recording determines it and where it predicts better."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from estimation.diagnosis.data import Run
from estimation.diagnosis.discrepancy import DISCREPANCY_TERMS
from estimation.diagnosis.discrepancy_law import STATIC_PARAMETERS, measured_law_table
from estimation.diagnosis.fit import Fit, fit_model
from estimation.diagnosis.identifiability import determined_only
from estimation.diagnosis.model import Candidate, Model
from estimation.diagnosis.selection import SelectionResult, SelectionStep, refit_without
from estimation.diagnosis.shares import OpenLoop, is_worse, open_loop
from scanner.device import Axis, Device
from scanner.terms.measured_law import EFFECT as MEASURED_LAW


@dataclass(frozen=True)
class Improvement:
    """The device that a diagnosis writes.

    Attributes:
        search: without the findings that were rejected.
        device: never predicts worse than the nominal one, beyond the uncertainty of that likelihood.
        nominal, improved: how the two devices predict every channel.
    """

    search: SelectionResult
    device: Device
    nominal: Mapping[str, OpenLoop]
    improved: Mapping[str, OpenLoop]

    def to_json(self) -> dict[str, Any]:
        """The content of ``open_loop`` in diagnosis.json."""
        return {
            name: {"nominal": each.to_json(), "improved": self.improved[name].to_json()}
            for name, each in self.nominal.items()
        }


def improve(found: SelectionResult) -> Improvement:
    """Return the device with the findings that do not make its open-loop prediction worse.

    A named law that makes it worse than the nominal device's, beyond the uncertainty of that likelihood, is rejected,
    the weakest first. A law without a name is a finding all the same. Where the device with it predicts no better, the
    device stays nominal.
    """
    runs, stated = found.likelihood.runs, found.final.model.device
    nominal = open_loop(runs, stated)
    while True:
        unnamed = any(each.candidate.term.effect in DISCREPANCY_TERMS for each in found.steps)
        device = improved_device(static_law(found) if unnamed else found.final)
        improved = open_loop(runs, device)
        if unnamed or not found.steps:
            better = all(_is_better([run], stated, device) for run in runs)
            return Improvement(found, device if better else stated, nominal, improved if better else nominal)
        if not is_worse(nominal, improved):
            return Improvement(found, device, nominal, improved)
        found = without_weakest(found)


def _is_better(runs: Sequence[Run], stated: Device, device: Device) -> bool:
    """Whether ``device`` predicts no channel of the runs with a larger error than the stated device."""
    nominal, improved = open_loop(runs, stated), open_loop(runs, device)
    return all(improved[name].error <= each.error for name, each in nominal.items())


def static_law(found: SelectionResult) -> Fit:
    """The fit with the part alone of its free correction that a device file can state; see ``measured_law_table``."""
    fit, free = found.final, found.final.model.candidates[-1]
    static = STATIC_PARAMETERS.get(free.term.effect, ())
    parameters = tuple(
        each if each.kind == "fixed" or each.name in static else replace(each, kind="fixed", scale=lambda scales: 0.0)
        for each in free.term.parameters
    )
    fewer = Candidate(replace(free.term, parameters=parameters), free.axis, free.channel)
    others = fit.model.candidates[:-1]
    model = Model(fit.model.runs, fit.model.device, [*others, fewer] if static else others, fit.model.mains)
    return fit_model(found.likelihood, model, model.map_parameters_from(fit.model, fit.x))


def without_weakest(found: SelectionResult) -> SelectionResult:
    """A search's result without the finding that explains least."""
    weakest = min(found.steps, key=lambda each: each.before.chi2 + each.before.penalty)
    rest = [each for each in found.steps if each is not weakest]
    final = refit_without(found.likelihood, found.final, weakest.candidate) if rest else found.nominal

    def refitted(each: SelectionStep) -> SelectionStep:
        before = refit_without(found.likelihood, final, each.candidate) if len(rest) > 1 else found.nominal
        return replace(each, before=before, after=final)

    return replace(found, final=final, steps=tuple(map(refitted, rest)))


def improved_device(fit: Fit) -> Device:
    """The device with its nominal values as far as the recording determines them, and the terms that were found."""
    fit = replace(fit, x=determined_only(fit))
    device = fit.model.device
    axes: dict[str, Axis] = dict(device.axes)
    shared = device.readout
    for name in fit.model.axes:
        made = fit.model.nominal(name, fit.x)
        if shared is not None:
            shared = made.readout if name == next(iter(device.axes)) else shared
            made = replace(made, readout=None)
        terms = {effect: dict(values) for effect, values in device.axis(name).terms.items()}
        for each in fit.model.candidates:
            if each.axis == name and each.term.effect not in DISCREPANCY_TERMS:
                values = fit.model.values(each, fit.x)
                terms[each.term.effect] = {p.name: float(v) for p, v in zip(each.term.parameters, values, strict=True)}
                if variant := each.term.channels.index(each.channel):
                    terms[each.term.effect]["variant"] = variant
            elif each.axis == name and (table := measured_law_table(fit)) is not None:
                terms[MEASURED_LAW] = table
        axes[name] = replace(made, terms=terms)
    return replace(device, axes=axes, readout=shared)
