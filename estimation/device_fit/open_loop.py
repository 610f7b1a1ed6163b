"""Open-loop prediction by a device: its error in every channel on held-out samples, and the comparison of two devices.

Errors are in the unit of the channel and not whitened, as a user measures them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from estimation.device_fit.data import Run
from estimation.device_fit.fit import Likelihood, fit_model, held_out_samples, time_blocks
from estimation.device_fit.initial import fit_initial_state, flat_whiteners, window_schedule
from estimation.device_fit.model import Model
from estimation.device_fit.noise import sample_times
from scanner.arrays import Array
from scanner.device import Device

FIXED_PARAMETER_PRECISION = 1e14
"""Prior precision of a value of the device that a prediction may not adjust."""

DIVERGED_ERROR = 1e6
"""Largest error that counts, and the one of a prediction that has no value, in the channel's unit: its fourth power is
finite."""

ERROR_MARGIN = 0.01
"""Relative increase of an open-loop error that counts as none: fits end within it."""


@dataclass(frozen=True)
class OpenLoop:
    """Prediction of one channel by a device, on held-out samples.

    Attributes:
        squares: mean squared error of every held-out block, in the square of the channel's unit, shape (n,).
        deviation: standard deviation of the recorded samples, in the channel's unit.
    """

    squares: Array
    deviation: float

    @property
    def error(self) -> float:
        """Root-mean-square error, in the channel's unit."""
        return float(np.sqrt(self.squares.mean()))

    @property
    def relative_squares(self) -> Array:
        """Mean squared error of every block as a fraction of the variance of the signal, shape (n,)."""
        return np.asarray(self.squares / max(self.deviation, 1e-50) ** 2)

    def to_json(self) -> dict[str, Any]:
        """Error, and error as a fraction of the signal."""
        return {"rmse": self.error, "fraction": self.error / max(self.deviation, 1e-300)}


def fit_start_only(runs: Sequence[Run], device: Device) -> tuple[Model, Array]:
    """Model of a device with its stated values, and parameters of which only the initial state of every run is fitted.

    The initial state is fitted to the first periods of the motion.
    """
    model = Model(runs, device, mains=())
    is_start = np.array([f.kind in ("start", "hidden") for f in model.parameters], bool)
    model.precision = np.where(is_start, model.precision, FIXED_PARAMETER_PRECISION)
    likelihood = Likelihood(runs, flat_whiteners(model))
    first = window_schedule(model)[0]
    x = fit_model(likelihood, model, fit_initial_state(likelihood, model, first).x, first, 12, tolerance=1e-3).x
    return model, np.where(is_start, x, 0.0)


def open_loop(runs: Sequence[Run], device: Device) -> dict[str, OpenLoop]:
    """Open-loop error of every channel over all runs; each run starts from its own fitted initial state."""
    squared_errors: dict[str, list[Array]] = {}
    data: dict[str, list[Array]] = {}
    with np.errstate(over="ignore", invalid="ignore"):
        for run in runs:
            model, x = fit_start_only([run], device)
            for output, signal in zip(run.outputs, model.outputs(x)[0], strict=True):
                rows = held_out_samples(output.data.size, output.guard)
                error = np.nan_to_num(output.data - signal, nan=DIVERGED_ERROR)
                error = np.clip(error, -DIVERGED_ERROR, DIVERGED_ERROR)
                blocks = time_blocks(sample_times(error.size))[rows]
                squares = [float(np.mean(error[rows][blocks == block] ** 2)) for block in np.unique(blocks)]
                squared_errors.setdefault(output.name, []).append(np.array(squares))
                data.setdefault(output.name, []).append(output.data[rows])
    return {
        name: OpenLoop(np.concatenate(parts), float(np.sqrt(np.mean([part.var() for part in data[name]]))))
        for name, parts in squared_errors.items()
    }


def has_larger_error(nominal: Mapping[str, OpenLoop], improved: Mapping[str, OpenLoop]) -> bool:
    """Whether the error of a device, over all channels as in :func:`is_worse`, exceeds that of the nominal one."""
    return _relative_error(improved) > (1.0 + ERROR_MARGIN) * _relative_error(nominal)


def is_worse(reference: Mapping[str, OpenLoop], device: Mapping[str, OpenLoop]) -> bool:
    """Whether a device predicts worse than a reference: by more than ``ERROR_MARGIN`` and consistently.

    The errors of all channels are added, each as a fraction of its signal: a readout lag may change the angle by a
    thousandth of its amplitude while the error of the sense signal falls to a tenth. Consistently: the mean over the
    blocks of the logarithm of the ratio of both errors exceeds twice its standard uncertainty. Blocks that are hard to
    predict, such as the first ones of a decay, are so for both devices, so they do not add to its scatter. Channels
    count in the mean by their part of the squared errors.

    Args:
        reference, device: prediction of every channel on the same blocks.
    """
    if not _relative_error(device) > (1.0 + ERROR_MARGIN) * _relative_error(reference):
        return False
    pairs = [(reference[name].relative_squares, channel.relative_squares) for name, channel in device.items()]
    weights = np.array([before.mean() + after.mean() for before, after in pairs])
    weights /= weights.sum()
    ratios = [np.log(np.maximum(after, 1e-300) / np.maximum(before, 1e-300)) for before, after in pairs]
    mean = float(weights @ [each.mean() for each in ratios])
    variance = float(weights**2 @ [each.var() / max(each.size - 1, 1) for each in ratios])
    return bool(mean > 2.0 * np.sqrt(variance))


def _relative_error(channels: Mapping[str, OpenLoop]) -> float:
    """Root sum of squares of the errors of all channels as fractions of their signals."""
    return float(np.sqrt(sum(channel.relative_squares.mean() for channel in channels.values())))
