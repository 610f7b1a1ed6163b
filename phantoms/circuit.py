"""The amplitude modulation and demodulation circuit of chen2020 (II-C, figs 2 to 5), at the level of its components.

A carrier is added to the drive. The current of the comb is amplified, high-passed, squared by the envelope detector and
low-passed. The paper reduces this to y = a_cir C + b_cir. The difference is given here in closed form
(``reduce_to_readout``, ``envelope_section``) and can be measured by simulating the circuit (``run_circuit``).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from scanner.arrays import Array
from scanner.errors import BadInput
from scanner.laws import capacitance, capacitance_slope
from scanner.lowpass import run_section, section_coefficients
from scanner.stages import Amdm, Capacitance

MIN_CLOCK_HZ = 25e6
"""50 samples in a period of the 500 kHz carrier. With fewer, the exact step of the sections, which takes its input as
linear between samples, is no longer accurate."""

_PHASE = 2.0 * np.pi * np.arange(256) / 256


@dataclass(frozen=True)
class AmdmCircuit:
    """Component values; chen2020 Table I where it prints them.

    Attributes:
        carrier_volts, carrier_hz: V_c0 [V] and f_c [Hz].
        R_f: feedback resistor of the amplification stage [ohm].
        C_p: parasitic capacitance parallel to the comb [F]; the paper prints none.
        hpf_hz: corner of the first-order high-pass [Hz].
        a_d, b_d: envelope detector a_d v + b_d v^2 (eq 23), [1] and [1/V]; the paper prints neither. The default is the
            second-order expansion of a diode's law, b_d / a_d = 1 / (2 n V_T), with n V_T = 39 mV.
        lpf_hz: corners of the first-order low-pass sections: the detector's own and the LPF stage [Hz].
        gain, offset: of the output stage [1, V]; ``match_gain`` sets them.
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
        """Return the carrier voltage at ``time`` [s], in its shape [V]."""
        return self.carrier_volts * np.sin(2 * np.pi * self.carrier_hz * time)

    @property
    def square_gain(self) -> float:
        """Factor K of the output for slow C, which is gain K (C + C_p)^2 + offset [V/F^2]."""
        passed = self.carrier_hz / math.hypot(self.carrier_hz, self.hpf_hz)
        return 0.5 * self.b_d * (passed * 2 * math.pi * self.carrier_hz * self.carrier_volts * self.R_f) ** 2


@dataclass(frozen=True)
class Stages:
    """Voltages after every stage on the integration clock, each of shape (n,) [V]; names as in chen2020 fig 2."""

    v_o1: Array
    v_o2: Array
    v_o3: Array
    y: Array


def current_components(
    circuit: AmdmCircuit, comb: Capacitance, angle: Array, rate: Array, drive: Array, time: Array
) -> Array:
    """Return V_1 to V_6 of the amplification stage (chen2020 eq 21).

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


def run_circuit(
    circuit: AmdmCircuit, comb: Capacitance, angle: Array, rate: Array, drive: Array, clock: float, start: float = 0.0
) -> Stages:
    """Return the voltage after every stage for a trajectory on a fine clock.

    The sections start at zero, so the first 0.2 ms are the transient of the circuit.

    Args:
        angle, rate: [rad, rad/s]. drive: voltage without the carrier [V]. All of shape (n,).
        clock: rate of these [Hz]. start: time of the first [s].

    Raises:
        BadInput: a clock below ``MIN_CLOCK_HZ``.
    """
    if clock < MIN_CLOCK_HZ:
        raise BadInput(f"the circuit is run at {clock:g} Hz", hint=f"give it {MIN_CLOCK_HZ:g} Hz or more")
    time = start + np.arange(angle.size) / clock
    v_o1 = current_components(circuit, comb, angle, rate, drive, time).sum(axis=0)
    low = v_o1.copy()
    run_section(low, *section_coefficients(circuit.hpf_hz, 1.0 / clock), 0.0, v_o1[0])
    v_o2 = v_o1 - low
    v_o3 = circuit.a_d * v_o2 + circuit.b_d * v_o2**2
    y = v_o3.copy()
    for cutoff in circuit.lpf_hz:
        run_section(y, *section_coefficients(cutoff, 1.0 / clock), 0.0, y[0])
    return Stages(v_o1, v_o2, v_o3, circuit.gain * y + circuit.offset)


def envelope_section(circuit: AmdmCircuit) -> float:
    """Return the corner of the first-order section by which the high-pass acts on the envelope [Hz].

    The high-pass H(f) = j f / (f_h + j f) acts on the sidebands f_c +- f. To first order in f its unequal gains
    turn amplitude into phase modulation, to which a square-law detector does not respond; its unequal phases delay the
    envelope by f_h / (2 pi (f_h^2 + f_c^2)): 0.159 us, 1.8 degrees of the sense signal at 31.4 kHz.
    """
    return (circuit.hpf_hz**2 + circuit.carrier_hz**2) / circuit.hpf_hz


def linear_gain(circuit: AmdmCircuit, comb: Capacitance, amplitude: float) -> tuple[float, float]:
    """Return a_cir [V/F] and b_cir [V] of the line fitted to the square law over an amplitude [rad] of the motion."""
    C = capacitance(amplitude * np.sin(_PHASE), comb.C0, comb.Cb, comb.theta0, comb.theta_th)
    output = circuit.gain * circuit.square_gain * (C + circuit.C_p) ** 2 + circuit.offset
    centred = C - C.mean()
    a_cir = float(centred @ output / (centred @ centred))
    return a_cir, float(output.mean() - a_cir * C.mean())


def match_gain(circuit: AmdmCircuit, comb: Capacitance, amplitude: float, a_cir: float, b_cir: float) -> AmdmCircuit:
    """Return the circuit with an output stage that gives ``a_cir`` [V/F] and ``b_cir`` [V] at an amplitude [rad]."""
    a_raw, b_raw = linear_gain(replace(circuit, gain=1.0, offset=0.0), comb, amplitude)
    gain = a_cir / a_raw
    return replace(circuit, gain=gain, offset=b_cir - gain * b_raw)


def reduce_to_readout(
    circuit: AmdmCircuit, comb: Capacitance, amplitude: float, noise_var: float, bits: int | None
) -> Amdm:
    """Return the readout a_cir C + b_cir (eq 25) at one amplitude [rad], with the high-pass as another section."""
    a_cir, b_cir = linear_gain(circuit, comb, amplitude)
    return Amdm(a_cir, b_cir, (*circuit.lpf_hz, envelope_section(circuit)), noise_var, bits)
