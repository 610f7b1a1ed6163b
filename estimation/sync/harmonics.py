"""Harmonics of a motion, which displace the edges of a detector from where a sine would pass it.

The third harmonic of a mirror with combs is 0.1 % of the amplitude and shifts the phase of its edges by 0.05 degrees.
It follows from the recorded drive and the stated mechanics by harmonic balance, as in the tracker.
"""

from __future__ import annotations

from contextlib import suppress
from typing import NamedTuple

import numpy as np

from estimation.reference import PhaseReference
from estimation.tracker.averaged_dynamics import MAX_MOTION_HARMONIC, axis_parameters
from estimation.tracker.drive_blocks import demodulate_drive
from estimation.tracker.kalman_filter import fill_track_rates
from estimation.tracker.state_space import AXIS_STATES, LOG_AMPLITUDE, PHASE
from scanner.arrays import Array, Complex
from scanner.device import Device
from scanner.errors import BadInput
from scanner.recording import Recording
from scanner.stages import Position

ORDERS = np.arange(MAX_MOTION_HARMONIC + 1)


class MotionHarmonics(NamedTuple):
    """Harmonics h_n of theta = A (sin u + sum of Re(h_n exp(i n u))); h_1 is 0.

    Attributes:
        values: shape (n, MAX_MOTION_HARMONIC + 1).
        relative_sd: their relative standard deviation, by the tolerances of the torque and the inertia.
    """

    values: Complex
    relative_sd: float

    def deviation(self, u: Array) -> Array:
        """Deviation from the sine at the phases ``u`` (n,), relative to the amplitude."""
        return np.asarray(np.sum((self.values * np.exp(1j * np.outer(u, ORDERS))).real, axis=1))

    def slope(self, u: Array) -> Array:
        """Derivative of the deviation by the phase at ``u`` (n,)."""
        return np.asarray(np.sum((1j * ORDERS * self.values * np.exp(1j * np.outer(u, ORDERS))).real, axis=1))

    def edge_shift(self, u: Array) -> Array:
        """Phase by which the motion passes an angle later than its sine, which passes it at ``u`` (n,) [rad]."""
        return -self.deviation(u) / np.cos(u)

    def turn_shift(self, u: Array) -> Array:
        """Phase by which the motion turns later than its sine, which turns at ``u`` (n,) [rad]."""
        return self.slope(u) / np.sin(u)

    def at(self, time: Array, wanted: Array) -> MotionHarmonics:
        """Return the harmonics at the times ``wanted``, interpolated between ``time`` (n,) [s]."""
        columns = [np.interp(wanted, time, part) for h in self.values.T for part in (h.real, h.imag)]
        pairs = np.array(columns).reshape(len(ORDERS), 2, -1)
        return self._replace(values=(pairs[:, 0] + 1j * pairs[:, 1]).T)


def motion_harmonics(
    recording: Recording, device: Device, name: str, reference: PhaseReference, time: Array, phase: Array, size: Array
) -> MotionHarmonics | None:
    """Return the harmonics that the recorded drive of an axis causes.

    Args:
        recording: with the drive.
        device: with mechanics and drive of the axis.
        name: of the axis.
        reference: of the phase.
        time: evenly spaced, shape (n,) [s].
        phase: of the motion against the reference, shape (n,) [rad].
        size: amplitude, shape (n,) [rad].

    Returns:
        None where drive, mechanics or combs are not known.
    """
    axis, drive = device.axis(name), recording.channels.get(f"drive_{name}")
    if drive is None or axis.drive is None or axis.mechanics is None or time.size < 2:
        return None
    with suppress(BadInput):
        law = axis_parameters(axis, Position(gain=1.0, noise_sd=0.0))
        blocks = demodulate_drive(drive, reference, time, float(np.median(np.diff(time))), law)
        states = np.zeros((time.size, AXIS_STATES))
        states[:, PHASE], states[:, LOG_AMPLITUDE] = phase + reference.phase(time) - blocks.psi, np.log(size)
        rates, harmonics = np.empty(time.size, np.complex128), np.empty((time.size, ORDERS.size), np.complex128)
        fill_track_rates(law, blocks.w, blocks.force, states, rates, harmonics)
        torque = "C0" if axis.drive.kind == "electrostatic" else "torque_per_volt"
        sd = float(np.hypot(device.tolerance(name, torque), device.tolerance(name, "J")))
        return MotionHarmonics(harmonics / size[:, None], sd)
    return None
