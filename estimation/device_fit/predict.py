"""Open-loop prediction of a recording: the response of a device to the recorded drive."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from estimation.device_fit.data import Run, prepare_run, unsettled_samples
from estimation.device_fit.model import Model
from estimation.device_fit.open_loop import fit_start_only
from estimation.device_fit.undriven import axes_without_drive, steady_without_drive
from estimation.held_samples import held_runs_while_driven, without_samples
from scanner.active_terms import stated_terms
from scanner.arrays import Array
from scanner.device import Device
from scanner.errors import BadInput, DeviceInvalid
from scanner.recording import Recording
from scanner.terms.measured_law import EFFECT as MEASURED_LAW
from scanner.terms.measured_law import beyond


@dataclass(frozen=True)
class Predicted:
    """Prediction of one channel at its recorded sample times.

    Attributes:
        values: predicted, shape (n,), NaN where the drive was not recorded, and where a lag or a delay of the readout
            refers to what preceded the recording or follows it.
        measured: recorded, shape (n,), NaN where the signal stands at one value while the axis is driven.
        unit: of both.
        sample_rate, start: of both [Hz], [s].
        noise_sd: stated standard deviation of the noise of a sample, None where none is stated.
        left_out: number of the samples that stand at one value, as a sensor or a converter that was stopped.
    """

    values: Array
    measured: Array
    unit: str
    sample_rate: float
    start: float
    noise_sd: float | None
    left_out: int = 0

    def __repr__(self) -> str:
        return f"Predicted {self.values.size} samples at {self.sample_rate:.9g} Hz: rmse {self.rmse:.4g} {self.unit}"

    @property
    def rmse(self) -> float:
        """Root mean square difference over the samples that are not left out, in the channel's unit."""
        return float(np.sqrt(np.nanmean((self.values - self.measured) ** 2)))


def predict(recording: Recording, device: Device) -> dict[str, Predicted]:
    """Predict every recorded sense and angle channel from the recorded drive, with the terms of ``device`` included.

    Only the mirror's angle and rate at the first sample, and the states of stated terms there, such as the motion of a
    second mode, are fitted, to the first few periods of the channels. The values of the device are not adjusted.

    Returns:
        The prediction of each channel by its name.

    Raises:
        BadInput: the recording has no sense or angle channel, a channel is missing or invalid, its motion persists
            without a recorded drive, or the predicted motion diverges.
    """
    run = prepare_run(recording, device, to_last_sample=True)
    if axes_without_drive(recording, device) and (steady := steady_without_drive(recording, device)) is not None:
        hint = "record the voltage that drives it; without one a free decay is predicted"
        raise BadInput(f"has no drive to predict from: {steady}", file=recording.path, hint=hint)
    signals = finite_signals(run, device)
    held = held_runs_while_driven(recording, device)
    return {
        output.name: _at_sample_times(run, index, signal, recording, device, held.get(output.name, []))
        for index, (output, signal) in enumerate(zip(run.outputs, signals, strict=True))
    }


def finite_signals(run: Run, device: Device) -> list[Array]:
    """Every channel of a run on the integration grid, as ``device`` predicts it.

    Raises:
        DeviceInvalid: a motion diverges; the error names the term without which it does not, if there is one.
    """
    signals = _signals(run, device)
    for output, signal in zip(run.outputs, signals, strict=True):
        if not np.isfinite(signal).all():
            raise _divergence(run, device, output.axes)
    return signals


def _signals(run: Run, device: Device) -> list[Array]:
    """Every channel of a run on the integration grid. That of a motion that diverges is not finite."""
    with np.errstate(over="ignore", invalid="ignore"):
        model, x = fit_start_only([run], device)
        return model.full_signals(x)


def _divergence(run: Run, device: Device, axes: Sequence[str]) -> DeviceInvalid:
    """The error of a motion of ``axes`` that diverges. It names a term without which no predicted motion diverges."""
    terms = [(name, effect) for name in run.inputs for effect in device.axes[name].terms]
    for name, effect in terms:
        axis = device.axes[name]
        rest = {each: values for each, values in axis.terms.items() if each != effect}
        without = replace(device, axes={**device.axes, name: replace(axis, terms=rest)})
        if all(np.isfinite(signal).all() for signal in _signals(run, without)):
            hint = (
                "without this term it does not: its size, or a frequency of it far above that of the motion, is wrong"
            )
            where = f"{name}.terms.{effect}"
            return DeviceInvalid("lets the predicted motion diverge", file=device.source, channel=where, hint=hint)
    what = "lets the predicted motion diverge"
    hint = "check its mechanics, its drive and its terms; all values are in SI units"
    return DeviceInvalid(what, file=device.source, channel=" and ".join(axes), hint=hint)


def drifts(device: Device) -> dict[str, list[str]]:
    """Effects of a device that change with time, by axis. In every recording they start again at its first sample."""
    found = {
        name: [each.term.effect for each in stated_terms(axis) if each.term.drifts and each.term.stage != "optics"]
        for name, axis in device.axes.items()
    }
    return {name: effects for name, effects in found.items() if effects}


def beyond_measured_laws(recording: Recording, device: Device) -> dict[str, float]:
    """Fraction of the predicted samples, by axis, that lie beyond the range in which a law of the device was measured.

    Beyond its range a measured law continues linearly, so the prediction is an extrapolation there. Axes without a
    measured law are not listed.
    """
    laws = {name: axis.terms[MEASURED_LAW] for name, axis in device.axes.items() if MEASURED_LAW in axis.terms}
    if not laws:
        return {}
    run = prepare_run(recording, device)
    model, x = fit_start_only([run], device)
    trajectories = model.trajectories(0, x)
    before = Model([run], _without_readout_laws(device), mains=())
    sensed = dict(zip((output.name for output in run.outputs), before.full_signals(x), strict=True))
    fractions = {}
    for name, law in laws.items():
        if name in trajectories:
            trajectory = trajectories[name]
            signal = next((s for key, s in sensed.items() if key in (f"sense_{name}", "sense")), trajectory.angle)
            variables = {
                "mechanics": [trajectory.angle, trajectory.rate],
                "optics": [trajectory.angle],
                "readout": [signal],
            }
            fractions[name] = beyond(law, variables.get(law["stage"], [trajectory.drive.samples]))
    return fractions


def _without_readout_laws(device: Device) -> Device:
    """The device without the measured laws of its readouts, whose variable is the signal before them."""
    axes = {
        name: replace(axis, terms={effect: law for effect, law in axis.terms.items() if law.get("stage") != "readout"})
        for name, axis in device.axes.items()
    }
    return replace(device, axes=axes)


def _at_sample_times(
    run: Run, index: int, signal: Array, recording: Recording, device: Device, held: Sequence[tuple[int, int]]
) -> Predicted:
    """A signal on the integration grid, at every sample of its channel, by a cubic spline.

    Args:
        held: runs of samples (first, stop) of the channel that are not compared.
    """
    from scipy.interpolate import CubicSpline

    output, channel = run.outputs[index], recording[run.outputs[index].name]
    inputs = run.inputs[output.axes[0]]
    grid = recording.origin + inputs.time
    time = channel.time()
    values = np.full(time.size, np.nan)
    inside = (time >= grid[0] - 1e-9) & (time <= grid[-1] + 1e-9)
    values[inside] = CubicSpline(grid, signal)(time[inside])
    axes = [device.sensed_axis(name) for name in output.axes]
    first, last = unsettled_samples(output.kind, axes, channel.size, 1.0 / channel.sample_rate)
    values[np.flatnonzero(inside)[:first]] = np.nan
    values[np.flatnonzero(inside)[np.count_nonzero(inside) - last :]] = np.nan
    measured = without_samples(channel, held).read()
    left_out = sum(stop - first for first, stop in held)
    return Predicted(values, measured, channel.unit, channel.sample_rate, channel.start, output.noise_sd, left_out)
