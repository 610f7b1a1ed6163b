"""What each finding explains of the misfit, what none explains, and how a device predicts open loop.

All of it is computed on held-out samples, not whitened: in the channel's own unit, where a user meets it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from estimation.diagnosis.data import Run
from estimation.diagnosis.fit import TIME_BLOCKS, VALIDATION_BLOCK_INTERVAL, Fit, Likelihood, fit_model
from estimation.diagnosis.initial import fit_initial_state, flat_whiteners, window_schedule
from estimation.diagnosis.model import Model
from scanner.arrays import Array, Mask
from scanner.device import Device

FIXED_PARAMETER_PRECISION = 1e14
"""Prior precision of a device's value that a prediction may not adjust."""


def held_out(size: int, guard: tuple[int, int] = (0, 0)) -> Mask:
    """Samples of a channel that no fit used, shape (size,)."""
    held = (
        np.floor((np.arange(size) + 0.5) / size * TIME_BLOCKS).astype(int) % VALIDATION_BLOCK_INTERVAL
    ) == VALIDATION_BLOCK_INTERVAL // 2
    held[: guard[0]] = False
    held[size - guard[1] :] = False
    return held


def mean_square(difference: Array, rows: Mask) -> float:
    """Mean square of ``difference`` over ``rows``, both of shape (n,)."""
    return float(np.mean(np.asarray(difference)[rows] ** 2))


def share_of(without: float, complete: float, nominal: float, noise: float) -> float:
    """Share of a misfit that is lost when one finding is taken out of the complete model.

    Args:
        without, complete, nominal: mean squares of what the complete model without the finding, the complete model and
            the nominal model leave; ``noise``: of the noise.
    """
    return float(np.clip((without - complete) / max(nominal - noise, 1e-300), 0.0, 1.0))


def remainder_of(complete: float, nominal: float, noise: float) -> float:
    """Share of a misfit that the complete model leaves; see :func:`share_of`."""
    return float(np.clip((complete - noise) / max(nominal - noise, 1e-300), 0.0, 1.0))


def noise_variance(likelihood: Likelihood, run: int, output: int) -> float:
    """Variance of a channel's noise as the whitening has it, in the band that is compared."""
    psd, size = likelihood.whiteners[run][output].psd, likelihood.runs[run].outputs[output].data.size
    return float(np.sum(psd)) * 2.0 / size**2


def left_by(fit: Fit) -> dict[str, float]:
    """Mean square of what a fit leaves of every channel on held-out samples, over all runs that have it."""
    total: dict[str, list[float]] = {}
    for run, signals in zip(fit.model.runs, fit.model.outputs(fit.x), strict=True):
        for output, signal in zip(run.outputs, signals, strict=True):
            rows = held_out(output.data.size, output.guard)
            total.setdefault(output.name, []).append(mean_square(output.data - signal, rows))
    return {name: float(np.mean(values)) for name, values in total.items()}


def noise_of(likelihood: Likelihood) -> dict[str, float]:
    """Variance of every channel's noise, over all runs that have it."""
    total: dict[str, list[float]] = {}
    for r, run in enumerate(likelihood.runs):
        for i, output in enumerate(run.outputs):
            total.setdefault(output.name, []).append(noise_variance(likelihood, r, i))
    return {name: float(np.mean(values)) for name, values in total.items()}


@dataclass(frozen=True)
class OpenLoop:
    """How a device predicts one channel on held-out samples.

    Attributes:
        error: root-mean-square error, in the channel's unit.
        deviation: of what was recorded from its mean, in the channel's unit.
        sd: standard uncertainty of ``error``: it scatters from one held-out block to the next.
    """

    error: float
    deviation: float
    sd: float

    def to_json(self) -> dict[str, Any]:
        """Error, and error as a fraction of the signal."""
        return {"rmse": self.error, "fraction": self.error / max(self.deviation, 1e-300)}


def with_start(runs: Sequence[Run], device: Device) -> tuple[Model, Array]:
    """A device as it is stated, and the free numbers that start it as the first turns of every run show."""
    model = Model(runs, device, mains=())
    model.precision = np.array(
        [
            p if f.kind in ("start", "hidden") else FIXED_PARAMETER_PRECISION
            for f, p in zip(model.parameters, model.precision, strict=True)
        ]
    )
    likelihood = Likelihood(runs, flat_whiteners(model))
    first = window_schedule(model)[0]
    x = fit_model(likelihood, model, fit_initial_state(likelihood, model, first).x, first, 12, tolerance=1e-3).x
    return model, np.array(
        [value if f.kind in ("start", "hidden") else 0.0 for f, value in zip(model.parameters, x, strict=True)]
    )


def open_loop(runs: Sequence[Run], device: Device) -> dict[str, OpenLoop]:
    """Every channel played open loop through ``device`` from the first turns on, on held-out samples."""
    errors: dict[str, list[Array]] = {}
    data: dict[str, list[Array]] = {}
    with np.errstate(over="ignore", invalid="ignore"):
        for each in runs:
            model, x = with_start([each], device)
            for output, signal in zip(each.outputs, model.outputs(x)[0], strict=True):
                rows = held_out(output.data.size, output.guard)
                wrong = np.nan_to_num(output.data - signal, nan=1e6, posinf=1e6, neginf=1e6)
                blocks = np.floor((np.arange(wrong.size) + 0.5) / wrong.size * TIME_BLOCKS)[rows]
                squares = [float(np.mean(wrong[rows][blocks == block] ** 2)) for block in np.unique(blocks)]
                errors.setdefault(output.name, []).append(np.array(squares))
                data.setdefault(output.name, []).append(output.data[rows])
    found = {}
    for name, parts in errors.items():
        every = np.concatenate(parts)
        error = float(np.sqrt(every.mean()))
        scatter = float(every.std() / np.sqrt(max(every.size - 1, 1)))
        deviation = float(np.sqrt(np.mean([part.var() for part in data[name]])))
        found[name] = OpenLoop(error, deviation, scatter / max(2.0 * error, 1e-300))
    return found


def is_worse(nominal: Mapping[str, OpenLoop], improved: Mapping[str, OpenLoop]) -> bool:
    """Whether a device predicts worse than the nominal one, by more than 1 % and twice the uncertainty.

    Channels are compared together, each as a fraction of its signal. A lag of the readout that is found may move the
    angle by a thousandth of its amplitude, while the sense signal improves tenfold.
    """
    before, before_sd = _relative_error(nominal)
    after, after_sd = _relative_error(improved)
    return bool(after - before > 2.0 * np.hypot(before_sd, after_sd) + 0.01 * before)


def _relative_error(loops: Mapping[str, OpenLoop]) -> tuple[float, float]:
    """Root sum of squares of the errors of all channels as fractions of their signals, and its uncertainty."""
    error, sd = np.array([(o.error, o.sd) for o in loops.values()]).T / [
        max(o.deviation, 1e-300) for o in loops.values()
    ]
    total = float(np.linalg.norm(error))
    return total, float(np.linalg.norm(error * sd)) / max(total, 1e-300)
