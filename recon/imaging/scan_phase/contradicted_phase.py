"""A phase that the picture contradicts, as part of the stated uncertainty of the phase.

A channel that starts at another time than stated, a sensor of the wrong kind, or samples that were lost leave the
motion further from the picture than the registration reaches. The standard deviation of the sensor does not contain
that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from recon.imaging.scan_phase.phase_agreement import Contradiction
from scanner.motion import Motion


def include_contradictions(motion: Motion, found: Sequence[Contradiction]) -> Motion:
    """The motion with the distance to the phase at which the picture agrees in the ``phase_sd`` of each axis.

    The distance is known up to whole half-periods, so that it is a lower bound of the error.

    Args:
        motion: with the phases that the picture contradicts.
        found: by :func:`recon.imaging.scan_phase.phase_agreement.find_contradictions`.
    """
    axes = dict(motion.axes)
    for each in found:
        distance = float(np.sqrt(np.mean(np.square(each.phases))))
        axes[each.axis] = replace(axes[each.axis], phase_sd=np.hypot(axes[each.axis].phase_sd, distance))
    return replace(motion, axes=axes)
