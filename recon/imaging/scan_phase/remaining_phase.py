"""Phase errors that the picture still shows after all corrections, as part of the stated uncertainty of the phase.

A clock of the intensity that runs off, samples that were lost at an unknown place, or a phase that changes faster than
the model of the readout leave forward and backward half-periods apart. The sense signal does not contain these errors,
and its standard deviation does not either.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from recon.imaging.scan_phase.phase_error import PhaseError
from scanner.arrays import Array
from scanner.motion import Motion

MIN_REMAINING_SDS = 3.0
"""Rms of the slices' phase errors over their standard deviations from which errors remain. It is 0.3 to 1 after a
correction, and above 15 with a clock that is 30 ppm wrong."""


def include_remaining_errors(
    motion: Motion, errors: Sequence[PhaseError], searched: Mapping[str, Sequence[PhaseError]] | None = None
) -> tuple[Motion, list[str]]:
    """The motion with the phase errors that remain in the picture in its ``phase_sd``, and a line for each such axis.

    Args:
        motion: on the intensity's clock.
        errors: of the slices of the scan.
        searched: phase errors of the axes whose phase lies beyond the reach of ``errors``, used in their place.
    """
    axes, notes = dict(motion.axes), []
    for name, axis in motion.axes.items():
        used = (searched or {}).get(name, errors)
        time, value, sd = _determined(used, name)
        if not time.size or np.sqrt(np.mean(np.square(value / sd))) < MIN_REMAINING_SDS:
            continue
        remaining = np.interp(axis.time, axis.angle.start + time, np.abs(value))
        axes[name] = replace(axis, phase_sd=np.hypot(axis.phase_sd, remaining))
        rms = np.degrees(np.sqrt(np.mean(value**2)))
        notes.append(
            f"forward and backward half-periods show phase errors of {name} that were not removed, {rms:.2g}° rms in "
            f"{time.size} of {len(used)} slices of the scan; the standard deviation of the phase includes them"
        )
    return replace(motion, axes=axes), notes


def _determined(errors: Sequence[PhaseError], name: str) -> tuple[Array, Array, Array]:
    """Times from the first sample [s], phase errors and standard deviations [rad] of the slices that determine one."""
    rows = [(error.time, *getattr(error, name)) for error in errors]
    time, value, sd = np.array(rows, float).reshape(-1, 3).T
    known = np.isfinite(sd) & np.isfinite(value)
    return time[known], value[known], np.maximum(sd[known], np.finfo(float).tiny)
