"""Prediction: a recording's drive played through a device, open loop from the first samples on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimation.mismatch.experiment import Run, experiment
from estimation.mismatch.fit import Comparison, solve
from estimation.mismatch.model import Model
from estimation.mismatch.start import first_whiteners, started, windows
from scanner.device import Device
from scanner.recording import Recording

Array = NDArray[np.float64]

FIXED = 1e14
"""Prior precision of what a prediction may not adjust."""


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
    run = experiment(recording, device)
    model = Model([run], device)
    model.precision = np.array(
        [p if f.kind in ("start", "hidden") else FIXED for f, p in zip(model.free, model.precision, strict=True)]
    )
    comparison = Comparison([run], first_whiteners(model))
    first = windows(model)[0]
    x = solve(comparison, model, started(comparison, model, first).x, first, 12, tolerance=1e-3).x
    x = np.array([value if f.kind in ("start", "hidden") else 0.0 for f, value in zip(model.free, x, strict=True)])
    return {
        output.name: _on_own_clock(run, index, signal, recording)
        for index, (output, signal) in enumerate(zip(run.outputs, model.full_signals(x), strict=True))
    }


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
