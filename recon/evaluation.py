"""Evaluation of an estimate against the truth of a simulated recording. No estimator reads the truth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from scanner.arguments import check_type
from scanner.arrays import Array
from scanner.errors import BadInput
from scanner.lock_in import block_phasors, slow_clock_block
from scanner.motion import AxisMotion, rms_phase
from scanner.truth import read_truth

CYCLES_PER_PHASE = 4.0
"""Cycles of the motion in one block of the comparison: the blocks of the estimators' slow clock."""


@dataclass(frozen=True)
class AxisEvaluation:
    """Comparison of one axis with its truth.

    Attributes:
        time: block centres, shape (n,) [s].
        phase: phase of the truth minus phase of the estimate, shape (n,) [rad], after correction of a wrong sign.
        amplitude: relative error, estimate over truth minus 1, shape (n,).
        true_amplitude: amplitude of the truth, shape (n,) [rad].
        angle_rmse: of the angle at the intensity's samples, after correction of a wrong sign [rad].
        mirrored: whether the estimate has the wrong one of the two signs that an even capacitance allows.
    """

    time: Array
    phase: Array
    amplitude: Array
    true_amplitude: Array
    angle_rmse: float
    mirrored: bool

    @property
    def phase_rmse(self) -> float:
        """Root mean square of ``phase``, weighted with the squared amplitude [rad]."""
        return rms_phase(self.phase, self.true_amplitude)


@dataclass(frozen=True)
class Truth:
    """The known answer of a simulation.

    Attributes:
        angles: (values [rad], sample rate [Hz], start [s]) by axis.
        scene: noiseless, over the whole field, blurred by the beam spot; None where not stored.
        spot_sd: standard deviation of the spot as a fraction of the field's width; 0 where not stored.
    """

    angles: Mapping[str, tuple[Array, float, float]]
    scene: Array | None
    spot_sd: float


def load_truth(path: Path) -> Truth | None:
    """Return the truth in a recording's file; None where it contains no true angle.

    Raises:
        BadInput: as :func:`truth_from_simulation`.
    """
    return truth_from_simulation(read_truth(path) or {}, path)


def truth_from_simulation(simulated: Mapping[str, Any], path: Path | None = None) -> Truth | None:
    """Return the truth from what a simulation returns; None where it contains no true angle.

    Args:
        simulated: values by name, alone or with their attributes: ``angle_x``, ``angle_y`` [rad], ``scene``,
            ``spot_sd``.
        path: of the file, for error messages.

    Raises:
        BadInput: it is no mapping, a true angle has no sample_rate, or a value is no number or no array of the shape
            that belongs to it.
    """
    check_type(Mapping, "give the truth that lissajous.simulate returns", truth=simulated)

    def numbers(value: object, dimensions: int, name: str) -> Array:
        try:
            array = np.asarray(value, np.float64)
        except (TypeError, ValueError):
            array = None
        if array is None or array.ndim != dimensions or not array.size:
            what = f"is not {('a number', 'an array of numbers', 'a matrix of numbers')[dimensions]}"
            hint = "store it as `lissajous simulate` does, or remove /truth"
            raise BadInput(what, file=path, channel=f"/truth/{name}", hint=hint)
        return array

    angles = {}
    values = {name: value[0] if isinstance(value, tuple) else value for name, value in simulated.items()}
    for axis in ("x", "y"):
        name = f"angle_{axis}"
        if values.get(name) is None:
            continue
        stated = simulated[name][1] if isinstance(simulated[name], tuple) else {}
        rate, start = (float(numbers(stated.get(key, 0.0), 0, f"{name}, {key}")) for key in ("sample_rate", "start"))
        if not 0.0 < rate < np.inf:
            what = "states no sample_rate" if "sample_rate" not in stated else f"states a sample_rate of {rate:g} Hz"
            raise BadInput(what, file=path, channel=f"/truth/{name}", hint="store it as attribute")
        angles[axis] = numbers(values[name], 1, name), rate, start
    if not angles:
        return None
    scene = numbers(values["scene"], 2, "scene") if values.get("scene") is not None else None
    return Truth(angles, scene, float(numbers(values.get("spot_sd", 0.0), 0, "spot_sd")))


def evaluate_axis(axis: AxisMotion, angle: Array, rate: float, start: float) -> AxisEvaluation:
    """Compare one axis with its true angle, both demodulated over the same blocks of ``CYCLES_PER_PHASE``.

    Args:
        axis: the estimate.
        angle: true angle, shape (n,) [rad].
        rate: sample rate of the true angle [Hz].
        start: time of its first sample [s].

    Raises:
        BadInput: the two have no time in common.
    """
    track, track_angle = axis.angle, axis.angle.read()
    if (track.sample_rate, track.start, track.size) != (rate, start, angle.size):
        time = track.start + np.arange(track.size) / track.sample_rate
        angle = np.interp(time, start + np.arange(angle.size) / rate, angle, left=np.nan, right=np.nan)
    both = np.isfinite(track_angle) & np.isfinite(angle)
    if not both.any():
        what, hint = "has no angle at the time of the motion", "correct the channels' start times, or remove /truth"
        raise BadInput(what, channel="/truth", hint=hint)
    first, last = int(both.argmax()), both.size - int(both[::-1].argmax())
    begin = track.start + first / track.sample_rate
    frequency = float(np.median(axis.frequency))
    block = slow_clock_block(frequency, track.sample_rate, CYCLES_PER_PHASE, last - first)
    time, estimated = block_phasors(track_angle[first:last], track.sample_rate, begin, frequency, block)
    _, true = block_phasors(angle[first:last], track.sample_rate, begin, frequency, block)
    known = np.isfinite(estimated) & np.isfinite(true)
    if known.any():  # the angle may be unknown within the recording too
        time, estimated, true = time[known], estimated[known], true[known]
    mirrored = bool(np.sum((np.conj(estimated) * true).real) < 0.0)
    sign = -1.0 if mirrored else 1.0
    return AxisEvaluation(
        time=time,
        phase=np.angle(sign * np.conj(estimated) * true),
        amplitude=np.abs(estimated) / np.abs(true) - 1.0,
        true_amplitude=np.abs(true),
        angle_rmse=float(np.sqrt(np.nanmean((sign * track_angle - angle) ** 2))),
        mirrored=mirrored,
    )
