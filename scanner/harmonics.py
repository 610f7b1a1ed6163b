"""Harmonics of the capacitance under a sinusoidal motion, and how a readout passes them on."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanner.device import Amdm, Capacitance, Position, Readout
from scanner.laws import capacitance
from scanner.lowpass import response

_POINTS = 256
_TURN = 2.0 * np.pi * np.arange(_POINTS) / _POINTS


def capacitance_harmonics(amplitude: float, comb: Capacitance, count: int = 8) -> NDArray[np.complex128]:
    """Fourier coefficients c_n of C(A sin u) = sum over n >= 0 of Re(c_n exp(i n u)), shape (count + 1,) [F].

    For theta_th = 0 the odd ones vanish and c_2n = 2 C0 exp(-z) I_n(z) with z = (A / theta0)^2 / 2, I_n the modified
    Bessel functions; the transform used here holds for any theta_th.
    """
    values = capacitance(amplitude * np.sin(_TURN), comb.C0, comb.Cb, comb.theta0, comb.theta_th)
    coefficients = np.fft.rfft(values)[: count + 1] * (2.0 / _POINTS)
    coefficients[0] *= 0.5
    return coefficients


def readout_response(readout: Readout, frequency: NDArray[np.float64] | float) -> NDArray[np.complex128]:
    """Volts a farad (a position sensor: a radian) at ``frequency`` [Hz], the filters' delay included."""
    if isinstance(readout, Amdm):
        return readout.a_cir * response(frequency, readout.lpf_hz)
    if isinstance(readout, Position):
        return readout.gain * np.ones(np.shape(frequency), dtype=np.complex128)
    return -readout.R_s * readout.V_bias * 2j * np.pi * np.asarray(frequency)
