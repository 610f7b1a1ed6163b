"""The error of a track against the simulated angle."""

import numpy as np

from estimation.tracker.angle_synthesis import PhasorAngle
from scanner.lock_in import block_phasors
from scanner.motion import AxisMotion


def track_errors(axis: AxisMotion, angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Phase error [rad], modulo pi, and error of ln(amplitude) of every block that ``angle`` covers, each (blocks,)."""
    assert isinstance(axis.angle, PhasorAngle)
    reference = axis.angle.motion.reference
    block = round((axis.time[1] - axis.time[0]) * axis.angle.sample_rate)
    time, phasor = block_phasors(angle.astype(float), axis.angle.sample_rate, 0.0, reference.frequency, block)
    assert np.allclose(time, axis.time)
    error = axis.phase - np.angle(phasor * np.exp(-1j * reference.phase(time)))
    return (error + np.pi / 2) % np.pi - np.pi / 2, np.log(axis.amplitude / np.abs(phasor))
