"""Whether the motion has a frequency near the resonance that the device file states.

A position sensor shows the motion whatever the mechanics are, so that a wrong inertia, stiffness or sample rate has no
effect on the picture. Everything that is computed from the mechanics is then wrong: the tracker, a diagnosis, a plan.
"""

from __future__ import annotations

from math import isclose

import numpy as np

from recon.quality.drive_check import MAX_DRIVE_RATIO, SAME_FREQUENCY
from scanner.device import Device
from scanner.motion import Motion

MIN_RESONANT_RATIO = 0.2
"""Frequency over the resonance below which a motion is quasistatic, as ``estimation.signals.phase_reference`` reads a
linear drive: stages and slow axes follow their drive there."""

COMMON_CAUSES = (
    (2.0, "combs (kind electrostatic) move the mirror at half the drive's frequency, or sample_rate is stated doubled"),
    (0.5, "J and k are those of the drive's frequency of combs (kind electrostatic), or sample_rate is stated halved"),
)
"""Frequency over the resonance, and what causes it."""


def describe_resonance_mismatch(device: Device, motion: Motion) -> list[str]:
    """A line for each axis that moves away from the resonance of the device.

    Args:
        device: a nominal one; an axis without mechanics states no resonance.
        motion: estimated; an axis that repeats at no known frequency is left out.
    """
    lines = []
    for name, own in motion.axes.items():
        axis = device.axis(name)
        if axis.mechanics is None or own.reference == "blocks":
            continue
        frequency = float(np.median(own.frequency))
        ratio = frequency / axis.resonance
        if MIN_RESONANT_RATIO < ratio < 1.0 / MAX_DRIVE_RATIO or ratio > MAX_DRIVE_RATIO:
            lines.append(_describe(name, frequency, axis.resonance))
    return lines


def _describe(name: str, frequency: float, resonance: float) -> str:
    """The line on one axis; frequencies of the motion and of the resonance [Hz]."""
    ratio = frequency / resonance
    named = "".join(f"; {cause}" for at, cause in COMMON_CAUSES if isclose(ratio, at, rel_tol=SAME_FREQUENCY))
    return (
        f"{name}: moves at {frequency:.6g} Hz, {ratio:.3g} times the resonance of {resonance:.6g} Hz that J and k in "
        f"[{name}.mechanics] state: check both, and the sample_rate of the signal, unless the axis is driven off its "
        f"resonance{named}. A motion from a position sensor or from edges does not depend on J and k; that of the "
        "tracker, and a diagnosis, do"
    )
