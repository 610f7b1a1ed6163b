"""The estimate against the truth of a simulated recording. Nothing but scoring reads the truth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.demodulate import block_length, block_phasors
from scanner.errors import BadInput
from scanner.motion import AxisMotion
from scanner.truth import read_truth

Array = NDArray[np.float64]

_CYCLES = 4.0  # of the motion, in one phase: the window of the estimators' own slow clock


@dataclass(frozen=True)
class AxisError:
    """Estimate minus truth for one axis.

    Attributes:
        time: block centres, shape (n,) [s].
        phase: truth ahead of the estimate, shape (n,) [rad], once a wrong sign is turned.
        amplitude: relative, estimate over truth minus 1, shape (n,).
        angle_rmse: of the angle at the intensity's samples, sign turned [rad].
        mirrored: the estimate has the other of the two signs that an even capacitance allows.
    """

    time: Array
    phase: Array
    amplitude: Array
    angle_rmse: float
    mirrored: bool

    @property
    def phase_rmse(self) -> float:
        """Root mean square of ``phase`` [rad]."""
        return float(np.sqrt(np.mean(self.phase**2)))


@dataclass(frozen=True)
class Truth:
    """What a simulation knew.

    Attributes:
        angles: (values [rad], sample rate [Hz], start [s]) by axis.
        scene: noiseless, over the whole field, beam spot included; None where not told.
        spot_sd: of the beam, as a fraction of the field's width; 0 where not told.
    """

    angles: Mapping[str, tuple[Array, float, float]]
    scene: Array | None
    spot_sd: float


def truth_of(path: Path) -> Truth | None:
    """The truth in a recording's file, None where there is none that tells an angle.

    Raises:
        BadInput: a true angle without its sample_rate.
    """
    return told_truth(read_truth(path) or {}, path)


def told_truth(told: Mapping[str, Any], path: Path | None = None) -> Truth | None:
    """The truth as a simulation tells it; raises and returns as :func:`truth_of`, with ``path`` for the message."""
    angles = {}
    for axis in ("x", "y"):
        value: Any = told.get(f"angle_{axis}")
        if value is None:
            continue
        values, attrs = value if isinstance(value, tuple) else (value, {})
        if "sample_rate" not in attrs:
            raise BadInput(
                "states no sample_rate", file=path, channel=f"/truth/angle_{axis}", hint="store it as attribute"
            )
        angles[axis] = (np.asarray(values, np.float64), float(attrs["sample_rate"]), float(attrs.get("start", 0.0)))
    scene = told.get("scene")
    scene = scene[0] if isinstance(scene, tuple) else scene
    if not angles:
        return None
    return Truth(angles, None if scene is None else np.asarray(scene, np.float64), float(told.get("spot_sd", 0.0)))


def axis_error(axis: AxisMotion, angle: Array, rate: float, start: float) -> AxisError:
    """Compare one axis with its true angle, both demodulated alike over blocks of 4 cycles.

    Args:
        angle: true angle, shape (n,) [rad]. rate: [Hz]. start: [s].
    """
    track = axis.angle
    if (track.sample_rate, track.start, track.values.size) != (rate, start, angle.size):
        time = track.start + np.arange(track.values.size) / track.sample_rate
        angle = np.interp(time, start + np.arange(angle.size) / rate, angle, left=np.nan, right=np.nan)
    both = np.isfinite(track.values) & np.isfinite(angle)
    first, last = int(both.argmax()), both.size - int(both[::-1].argmax())
    begin = track.start + first / track.sample_rate
    frequency = float(np.median(axis.frequency))
    block = block_length(frequency, track.sample_rate, _CYCLES)
    time, estimated = block_phasors(track.values[first:last], track.sample_rate, begin, frequency, block)
    _, true = block_phasors(angle[first:last], track.sample_rate, begin, frequency, block)
    mirrored = bool(np.sum((np.conj(estimated) * true).real) < 0.0)
    sign = -1.0 if mirrored else 1.0
    return AxisError(
        time=time,
        phase=np.angle(sign * np.conj(estimated) * true),
        amplitude=np.abs(estimated) / np.abs(true) - 1.0,
        angle_rmse=float(np.sqrt(np.nanmean((sign * track.values - angle) ** 2))),
        mirrored=mirrored,
    )
