"""Harmonics of the capacitance under a sinusoidal motion, and the response of a readout to them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanner.laws import capacitance
from scanner.lowpass import lowpass_response
from scanner.stages import Amdm, Capacitance, MotionSensor, Readout

_SAMPLES_PER_CYCLE = 256
"""Enough for amplitudes up to five times theta0: harmonics beyond the 128th are then below 1e-16 of C0."""

_PHASE = 2.0 * np.pi * np.arange(_SAMPLES_PER_CYCLE) / _SAMPLES_PER_CYCLE


def capacitance_harmonics(amplitude: float, comb: Capacitance, count: int = 8) -> NDArray[np.complex128]:
    """Return the coefficients c_n of C(A sin u) = sum over n >= 0 of Re(c_n exp(i n u)), shape (count + 1,) [F].

    For theta_th = 0 the odd ones vanish and c_2n = 2 C0 exp(-z) I_n(z) with z = (A / theta0)^2 / 2, I_n the modified
    Bessel functions; the transform used here holds for any theta_th.
    """
    values = capacitance(amplitude * np.sin(_PHASE), comb.C0, comb.Cb, comb.theta0, comb.theta_th)
    coefficients = np.fft.rfft(values)[: count + 1] * (2.0 / _SAMPLES_PER_CYCLE)
    coefficients[0] *= 0.5
    return coefficients


def readout_response(readout: Readout, frequency: NDArray[np.float64] | float) -> NDArray[np.complex128]:
    """Return the gain of a readout at ``frequency`` [Hz], low-pass sections included, in the shape of ``frequency``.

    In V/F for a capacitive readout, in V/rad for a sensor of the motion.
    """
    if isinstance(readout, Amdm):
        return readout.a_cir * lowpass_response(frequency, readout.lpf_hz)
    if isinstance(readout, MotionSensor):
        return readout.gain * (2j * np.pi * np.asarray(frequency, dtype=np.complex128)) ** readout.order
    return -readout.R_s * readout.V_bias * 2j * np.pi * np.asarray(frequency)
