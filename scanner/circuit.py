"""The amplitude modulation and demodulation circuit of chen2020 (II-C, figs 2 to 5), at the level of its components.

A carrier rides on the drive; the comb's current is amplified, high-passed, squared by the envelope detector and
low-passed. The paper reduces all of this to y = a_cir C + b_cir; what that leaves out is stated here in closed form
(``reduced``, ``envelope_section``) and can be measured by running the circuit (``run``) on any trajectory.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from scanner.device import Amdm, Capacitance
from scanner.errors import BadInput
from scanner.laws import capacitance, capacitance_slope
from scanner.lowpass import lowpass, step_coefficients

Array = NDArray[np.float64]

SLOWEST_CLOCK = 25e6
"""Below 50 samples a carrier period the sections' exact step no longer sees a straight line between samples [Hz]."""

_TURN = 2.0 * np.pi * np.arange(256) / 256


@dataclass(frozen=True)
class AmdmCircuit:
    """Component values; chen2020 Table I where it prints them.

    Attributes:
        carrier_volts, carrier_hz: V_c0 [V] and f_c [Hz].
        R_f: feedback resistor of the amplification stage [ohm].
        C_p: parasitic capacitance beside the comb [F]; the paper prints none.
        hpf_hz: corner of the first-order high-pass [Hz].
        a_d, b_d: envelope detector a_d v + b_d v^2 (eq 23), [1] and [1/V]; the paper prints neither. The default is the
            second-order expansion of a diode's law, b_d / a_d = 1 / (2 n V_T), with n V_T = 39 mV.
        lpf_hz: corners of the first-order low-pass sections: the detector's own and the LPF stage [Hz].
        gain, offset: of the output stage, [1] and [V]; ``matched`` sets them.
    """

    carrier_volts: float = 6.0
    carrier_hz: float = 500e3
    R_f: float = 17.86e3
    C_p: float = 2e-12
    hpf_hz: float = 482e3
    a_d: float = 1.0
    b_d: float = 12.8
    lpf_hz: tuple[float, ...] = (40.8e3, 41.1e3)
    gain: float = 1.0
    offset: float = 0.0

    def carrier(self, time: Array) -> Array:
        """Carrier voltage at ``time`` [s]: [V], of its shape."""
        return self.carrier_volts * np.sin(2 * np.pi * self.carrier_hz * time)

    @property
    def square_gain(self) -> float:
        """Volts a farad squared: the output is gain times this times (C + C_p)^2, plus offset, for slow C [V/F^2]."""
        passed = self.carrier_hz / math.hypot(self.carrier_hz, self.hpf_hz)
        return 0.5 * self.b_d * (passed * 2 * math.pi * self.carrier_hz * self.carrier_volts * self.R_f) ** 2


@dataclass(frozen=True)
class Stages:
    """Voltages behind every stage on the fine clock, each of shape (n,) [V]; names as in chen2020 fig 2."""

    v_o1: Array
    v_o2: Array
    v_o3: Array
    y: Array


def components(circuit: AmdmCircuit, comb: Capacitance, angle: Array, rate: Array, drive: Array, time: Array) -> Array:
    """V_1 to V_6 of the amplification stage (chen2020 eq 21).

    Args:
        angle, rate: of the mirror [rad, rad/s]. drive: voltage without the carrier [V]. time: [s]. All of shape (n,).

    Returns:
        Shape (6, n) [V]. V_3 and V_5 hold the drive's derivative, taken by central differences of order four.
    """
    C = capacitance(angle, comb.C0, comb.Cb, comb.theta0, comb.theta_th)
    C_rate = capacitance_slope(angle, comb.C0, comb.theta0, comb.theta_th) * rate
    w = 2 * np.pi * circuit.carrier_hz
    carrier, carrier_rate = circuit.carrier(time), w * circuit.carrier_volts * np.cos(w * time)
    drive_rate = _derivative(drive, (time[-1] - time[0]) / (time.size - 1))
    C_p = circuit.C_p
    terms = (C_rate * drive, C_rate * carrier, C * drive_rate, C * carrier_rate, C_p * drive_rate, C_p * carrier_rate)
    return circuit.R_f * np.array(terms)


def _derivative(values: Array, step: float) -> Array:
    out = np.gradient(values, step)
    out[2:-2] = (8.0 * (values[3:-1] - values[1:-3]) - (values[4:] - values[:-4])) / (12.0 * step)
    return out


def run(
    circuit: AmdmCircuit, comb: Capacitance, angle: Array, rate: Array, drive: Array, clock: float, start: float = 0.0
) -> Stages:
    """Every stage's voltage for a trajectory on a fine clock.

    The sections start from rest: the first 0.2 ms are the circuit switching on.

    Args:
        angle, rate: [rad, rad/s]. drive: voltage without the carrier [V]. All of shape (n,).
        clock: rate of these [Hz]. start: time of the first [s].

    Raises:
        BadInput: a clock below ``SLOWEST_CLOCK``.
    """
    if clock < SLOWEST_CLOCK:
        raise BadInput(f"the circuit is run at {clock:g} Hz", hint=f"give it {SLOWEST_CLOCK:g} Hz or more")
    time = start + np.arange(angle.size) / clock
    v_o1 = components(circuit, comb, angle, rate, drive, time).sum(axis=0)
    low = v_o1.copy()
    lowpass(low, *step_coefficients(circuit.hpf_hz, 1.0 / clock), 0.0, v_o1[0])
    v_o2 = v_o1 - low
    v_o3 = circuit.a_d * v_o2 + circuit.b_d * v_o2**2
    y = v_o3.copy()
    for cutoff in circuit.lpf_hz:
        lowpass(y, *step_coefficients(cutoff, 1.0 / clock), 0.0, y[0])
    return Stages(v_o1, v_o2, v_o3, circuit.gain * y + circuit.offset)


def envelope_section(circuit: AmdmCircuit) -> float:
    """Corner of the first-order section that the high-pass is for the envelope [Hz].

    The high-pass H(f) = j f / (f_h + j f) stands between the sidebands f_c +- f. To first order in f its unequal gains
    turn amplitude into phase modulation, which a square-law detector does not see, and its unequal phases delay the
    envelope by f_h / (2 pi (f_h^2 + f_c^2)): 0.159 us, 1.8 degrees of the sense signal at 31.4 kHz.
    """
    return (circuit.hpf_hz**2 + circuit.carrier_hz**2) / circuit.hpf_hz


def linear_gain(circuit: AmdmCircuit, comb: Capacitance, amplitude: float) -> tuple[float, float]:
    """a_cir [V/F] and b_cir [V] of the line through the square law over a swing of ``amplitude`` [rad]."""
    C = capacitance(amplitude * np.sin(_TURN), comb.C0, comb.Cb, comb.theta0, comb.theta_th)
    output = circuit.gain * circuit.square_gain * (C + circuit.C_p) ** 2 + circuit.offset
    centred = C - C.mean()
    a_cir = float(centred @ output / (centred @ centred))
    return a_cir, float(output.mean() - a_cir * C.mean())


def matched(circuit: AmdmCircuit, comb: Capacitance, amplitude: float, a_cir: float, b_cir: float) -> AmdmCircuit:
    """The circuit with an output stage that gives ``a_cir`` [V/F], ``b_cir`` [V] at a swing of ``amplitude`` [rad]."""
    a_raw, b_raw = linear_gain(replace(circuit, gain=1.0, offset=0.0), comb, amplitude)
    gain = a_cir / a_raw
    return replace(circuit, gain=gain, offset=b_cir - gain * b_raw)


def reduced(circuit: AmdmCircuit, comb: Capacitance, amplitude: float, noise_var: float, bits: int | None) -> Amdm:
    """The readout a_cir C + b_cir (eq 25) of the circuit at one amplitude, with the high-pass as one more section."""
    a_cir, b_cir = linear_gain(circuit, comb, amplitude)
    return Amdm(a_cir, b_cir, (*circuit.lpf_hz, envelope_section(circuit)), noise_var, bits)
