"""Prediction: a recording's drive played through a device, open loop from the first samples on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimation.diagnosis.data import Run, prepare_run
from estimation.diagnosis.shares import with_start
from scanner.arrays import Array
from scanner.device import Device
from scanner.recording import Recording
from scanner.terms.measured_law import EFFECT as MEASURED_LAW
from scanner.terms.measured_law import beyond


@dataclass(frozen=True)
class Predicted:
    """One channel on the recording's own clock.

    Attributes:
        values: shape (n,), NaN where the drive was not recorded.
        measured: what was recorded there.
        unit, sample_rate, start: of both.
        noise_sd: stated, None where none is.
    """

    values: Array
    measured: Array
    unit: str
    sample_rate: float
    start: float
    noise_sd: float | None

    def __repr__(self) -> str:
        return f"Predicted {self.values.size} samples at {self.sample_rate:.9g} Hz: rmse {self.rmse:.4g} {self.unit}"

    @property
    def rmse(self) -> float:
        """Root mean square difference, in the channel's unit."""
        return float(np.sqrt(np.nanmean((self.values - self.measured) ** 2)))


def predict(recording: Recording, device: Device) -> dict[str, Predicted]:
    """Every sense and angle channel that ``device`` would have shown, its terms included.

    Only the mirror's state at the first sample is taken from the channels, from the first few turns; every value of the
    device stays as it is stated.

    Raises:
        BadInput: nothing to compare with, or a channel missing or unusable.
    """
    run = prepare_run(recording, device)
    model, x = with_start([run], device)
    return {
        output.name: _on_own_clock(run, index, signal, recording)
        for index, (output, signal) in enumerate(zip(run.outputs, model.full_signals(x), strict=True))
    }


def beyond_measured_laws(recording: Recording, device: Device) -> dict[str, float]:
    """Fraction of the predicted samples, by axis, that lie beyond the range in which a law of the device was measured.

    There the law continues with the slope at the edge, so the prediction is an extrapolation. Axes without a measured
    law are left out.
    """
    laws = {name: axis.terms[MEASURED_LAW] for name, axis in device.axes.items() if MEASURED_LAW in axis.terms}
    if not laws:
        return {}
    run = prepare_run(recording, device)
    model, x = with_start([run], device)
    trajectories = model.trajectories(
        run,
        0,
        {name: model.nominal(name, x) for name in model.axes},
        {name: model.active_terms(name, 0, x) for name in run.inputs},
        x,
        1.0,
    )
    sensed = dict(zip((output.name for output in run.outputs), model.full_signals(x), strict=True))
    found = {}
    for name, law in laws.items():
        if name in trajectories:
            path = trajectories[name]
            signal = next((s for key, s in sensed.items() if key in (f"sense_{name}", "sense")), path.angle)
            variables = {"mechanics": [path.angle, path.rate], "optics": [path.angle], "readout": [signal]}
            found[name] = beyond(law, variables.get(law["stage"], [path.voltage]))
    return found


def _on_own_clock(run: Run, index: int, signal: Array, recording: Recording) -> Predicted:
    """A signal on the integration grid, at every sample of its channel, by a cubic spline."""
    from scipy.interpolate import CubicSpline

    output, channel = run.outputs[index], recording[run.outputs[index].name]
    inputs = run.inputs[output.axes[0]]
    grid = recording.start + inputs.time
    time = channel.time()
    values = np.full(time.size, np.nan)
    inside = (time >= grid[0] - 1e-9) & (time <= grid[-1] + 1e-9)
    values[inside] = CubicSpline(grid, signal)(time[inside])
    return Predicted(values, channel.read(), channel.unit, channel.sample_rate, channel.start, output.noise_sd)
