"""The phase error of the readout from frame to frame of a live scan: each measurement is the prior of the next one.

A frame without features, or with too little light, thus keeps the phase that earlier frames showed, with a standard
deviation that grows from one measurement to the next.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from recon.imaging.scan_phase.phase_error import PhaseError
from recon.imaging.scan_phase.readout_phase import measured_phase_error, posterior_times
from recon.imaging.scan_phase.readout_phase_model import (
    OFFSET_SDS_RAD,
    ConstantPrior,
    ReadoutPhase,
    average_separately,
    constant_prior,
    weigh_hypotheses,
)
from scanner.device import AXES
from scanner.motion import Motion

CHANGE_SD_RAD = OFFSET_SDS_RAD[0]
"""Change of the readout's phase error between two measurements in frames of a live scan, seconds apart: the smallest
that matters. A changing readout is then followed, and without features the standard deviation grows."""


def apply_readout_phase(motion: Motion, known: Mapping[str, ReadoutPhase]) -> Motion:
    """Correct a motion by phase errors that are known from an earlier part of the same scan.

    Args:
        motion: of the mirror.
        known: phase errors by axis; the value at the end of each is used.
    """
    axes = dict(motion.axes)
    for name, error in known.items():
        axis = motion.axes[name]
        ahead = axis.advanced(np.full(axis.time.size, error.mean[-1]))
        axes[name] = replace(ahead, phase_sd=np.sqrt(axis.phase_sd**2 + error.variance[-1]))
    return replace(motion, axes=axes)


def update_readout_phase(
    motion: Motion, corrected: Motion, errors: Sequence[PhaseError], known: Mapping[str, ReadoutPhase]
) -> dict[str, ReadoutPhase]:
    """Phase errors of the readout from a further part of a scan and from what the earlier parts showed.

    Args:
        motion, corrected: of the further part, before and after :func:`apply_readout_phase`.
        errors: phase errors of the corrected motion.
        known: phase errors by axis from the earlier parts. The end of each, whose variance has grown by that of
            ``CHANGE_SD_RAD``, is the prior.
    """
    updated = dict(known)
    for column, name in enumerate(AXES):
        axis = motion.axes[name]
        measured = measured_phase_error(errors, column, axis, corrected.axes[name])
        prior = constant_prior(OFFSET_SDS_RAD)
        if name in known:
            updated[name] = replace(known[name], variance=known[name].variance + CHANGE_SD_RAD**2)
            prior = ConstantPrior(float(updated[name].mean[-1]), updated[name].variance[-1:], np.zeros(1))
        hypotheses = weigh_hypotheses(*measured, posterior_times(axis, measured[0]), may_drift=False)
        if hypotheses.determines_constant:
            updated[name] = average_separately(hypotheses, prior)
    return updated
