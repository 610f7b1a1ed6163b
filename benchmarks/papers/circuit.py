"""chen2020 II-C, figs 3 to 5: the circuit's spectra, and the errors of its reduction to y = a_cir C + b_cir."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks.papers.figures import Results, entry, figure
from phantoms.amdm import STEPS_PER_SAMPLE
from phantoms.circuit import (
    AmdmCircuit,
    Stages,
    current_components,
    envelope_section,
    linear_gain,
    match_gain,
    run_circuit,
)
from phantoms.waveforms import Sine
from scanner.arrays import Array
from scanner.device import Axis
from scanner.devices import load
from scanner.laws import capacitance
from scanner.lock_in import block_phasors
from scanner.lowpass import lowpass_response
from scanner.parametric import DriveShape, sine_drive, steady_state
from scanner.stages import Capacitance

CLOCK = 5e6 * STEPS_PER_SAMPLE
F_DR = 31400.0
WINDOW = 0.01  # s. Drive, motion and carrier are periodic in it, so every line falls on one bin of 100 Hz
WARM_UP = 4e-4
AMPLITUDE, PHASE = 0.2, np.deg2rad(66.0)  # of the motion at F_DR
SWEEP = 31110.0, 31500.0  # Hz, as in the paper


@dataclass(frozen=True)
class Bench:
    """The circuit on a test bench with a prescribed motion: every voltage over one ``WINDOW``."""

    comb: Capacitance
    circuit: AmdmCircuit
    parts: Array
    stages: Stages
    capacitance: Array


def bench(moving: bool = True, circuit: AmdmCircuit | None = None) -> Bench:
    axis = load("chen2020-driven").axis("x")
    comb, readout = axis.require_capacitance(), axis.require_readout()
    circuit = circuit or match_gain(AmdmCircuit(), comb, 0.15, readout.a_cir, readout.b_cir)
    time = np.arange(-round(WARM_UP * CLOCK), round(WINDOW * CLOCK)) / CLOCK
    turn = np.pi * F_DR * time + PHASE
    angle, rate = (moving * AMPLITUDE * v for v in (np.sin(turn), np.pi * F_DR * np.cos(turn)))
    drive = Sine(F_DR, 30.0, 30.0)(time)
    stages = run_circuit(circuit, comb, angle, rate, drive, CLOCK, float(time[0]))
    window = slice(round(WARM_UP * CLOCK), None)
    settled = Stages(*(getattr(stages, name)[window] for name in ("v_o1", "v_o2", "v_o3", "y")))
    C = capacitance(angle[window], comb.C0, comb.Cb, comb.theta0, comb.theta_th)
    return Bench(comb, circuit, current_components(circuit, comb, angle, rate, drive, time)[:, window], settled, C)


def lines(voltage: Array, least: float = 1e-3) -> dict[tuple[int, int], float]:
    """Lines of a spectrum of at least ``least`` of its strongest: (m, k) -> amplitude at m f_c + k f_dr [V].

    Any other line has the key (-1, its frequency [Hz]).
    """
    spectrum = 2.0 * np.abs(np.fft.rfft(voltage)) / voltage.size
    spectrum[0] /= 2.0
    amplitudes = {}
    for i in np.flatnonzero(spectrum > least * spectrum.max()):
        f = i / WINDOW
        m = round(f / 500e3)
        k = (f - m * 500e3) / F_DR
        amplitudes[(m, round(k)) if abs(k - round(k)) < 1e-6 else (-1, round(f))] = float(spectrum[i])
    return amplitudes


def phase_between(y: Array, C: Array, f: float) -> float:
    """Phase of y against -C at ``f`` [rad]."""
    block = round(y.size)
    observed, true = (block_phasors(v, CLOCK, 0.0, f, block)[1][0] for v in (-y, C))
    return float(np.angle(observed / true))


def carrier_shift(axis: Axis, carrier_volts: float) -> float:
    """Phase shift of the motion at F_DR by the carrier's V_c0^2 / 2 in the mean of V^2 [deg]."""
    plain = sine_drive(F_DR, 30.0, 30.0)
    with_carrier = DriveShape(F_DR, lambda phase: np.sqrt(plain.voltage(phase) ** 2 + carrier_volts**2 / 2.0))
    states = [steady_state(axis, drive) for drive in (plain, with_carrier)]
    return float(np.rad2deg(states[1][1] - states[0][1]))  # type: ignore[index]


def results() -> Results:
    """Entries of ``results.json``; draws figs 4 and 5."""
    still, moving = bench(False), bench()
    axis, circuit, comb = load("chen2020-driven").axis("x"), moving.circuit, moving.comb
    sections = circuit.lpf_hz
    delayed = (*sections, envelope_section(circuit))
    gains = [linear_gain(circuit, comb, a)[0] for a in (0.09, 0.21)]
    low, high = (np.rad2deg(np.angle(lowpass_response(f, sections))) for f in SWEEP)
    upper, lower = (f / np.hypot(f, circuit.hpf_hz) for f in (circuit.carrier_hz + F_DR, circuit.carrier_hz - F_DR))
    observed, true = (lines(v, 1e-9) for v in (moving.stages.y, moving.capacitance))
    passed = [abs(lowpass_response(k * F_DR, delayed)) for k in (1, 2)]
    doubled = (observed[0, 2] / passed[1] / observed[0, 1] * passed[0]) / (true[0, 2] / true[0, 1]) - 1.0
    phase = phase_between(moving.stages.y, moving.capacitance, F_DR)
    ideal = np.angle(lowpass_response(F_DR, delayed))
    leak = 0.5 * np.rad2deg((phase - ideal + np.pi) % (2 * np.pi) - np.pi)
    stray = [k for v in (*moving.parts, moving.stages.v_o1, moving.stages.v_o3) for k in lines(v, 1e-6) if k[0] < 0]
    hpf = 0.5 * (np.rad2deg(np.arctan(F_DR / envelope_section(circuit))))
    slope = hpf * (SWEEP[1] - SWEEP[0]) / F_DR
    draw(still, moving)
    numbers = {
        "lines_outside_the_papers_bands": len(stray),
        "gain_change_0.09_to_0.21_rad": abs(gains[1] / gains[0] - 1.0),
        "second_harmonic_change": doubled,
        "filter_lag_over_sweep_deg_of_motion": 0.5 * (low - high),
        "high_pass_delay_deg_of_motion": hpf,
        "high_pass_delay_over_sweep_deg_of_motion": slope,
        "sidebands_unequal": upper / lower - 1.0,
        "drive_feedthrough_deg_of_motion": abs(leak),
        "carrier_torque_deg_of_motion": abs(carrier_shift(axis, circuit.carrier_volts)),
    }
    return {f"chen2020.circuit.{key}": entry(0.0, value, 1, 0) for key, value in numbers.items()}


def draw(still: Bench, moving: Bench) -> None:
    """Figs 4 and 5: V_o1 at rest and moving, V_o3 and y moving, over the frequency."""
    shown = (
        (still.stages.v_o1, "$V_{o1}$ at rest", 625e3),
        (moving.stages.v_o1, "$V_{o1}$ moving", 625e3),
        (moving.stages.v_o3, "$V_{o3}$ moving", 1.2e6),
        (moving.stages.y, "$y_{cap}$ moving", 625e3),
    )
    with figure("chen2020_fig4_5", 2, 2, (9.0, 5.0)) as axes:
        for drawn, (voltage, title, top) in zip(axes.ravel(), shown, strict=True):
            spectrum = 2.0 * np.abs(np.fft.rfft(voltage)) / voltage.size
            f = np.fft.rfftfreq(voltage.size, 1 / CLOCK)
            drawn.semilogy(f[f < top] / 1e3, spectrum[f < top] + 1e-9, lw=0.6)
            drawn.set(title=title, xlabel="frequency [kHz]", ylabel="amplitude [V]", ylim=(1e-6, None))
